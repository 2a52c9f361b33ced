"""How long a training will take here, before it starts."""

from __future__ import annotations

import time

import torch

from egoskin.make import check_num_workers, make_worker_env
from egoskin.runs.config import TrainConfig
from egoskin.sensors import Skin

# What is stepped: agents, and rollouts of some steps. The first warms up; in the last
# robots fall, as they do in training.
_AGENTS, _STEPS, _ROLLOUTS = 256, 12, 3


def estimate_seconds(config: TrainConfig, skin: Skin, frames: int) -> float:
    """Return about how long some environment steps of a training take here [s].

    The environments of a few agents are stepped for a second: so few are slower for
    each agent than a worker's, by about what learning takes. Networks far larger than
    the default's, and cores that others use later, make it longer.

    Args:
        config: The training.
        skin: Its skin.
        frames: Environment steps.
    """
    agents = min(_AGENTS, config.num_envs)
    threads, times = torch.get_num_threads(), []
    torch.set_num_threads(1)
    try:
        # Random actions are drawn here, and the training must not notice.
        with torch.random.fork_rng(devices=[]):
            env = make_worker_env(config.env, skin, num_envs=agents, seed=0)
            state = env.reset()
            for _ in range(_ROLLOUTS):
                start = time.perf_counter()
                state = env.rollout(
                    _STEPS,
                    break_when_any_done=False,
                    auto_reset=False,
                    tensordict=state,
                )[:, -1]["next"]
                times.append(time.perf_counter() - start)
    finally:
        torch.set_num_threads(threads)
    workers = check_num_workers(config.num_envs, config.num_workers)
    return frames * sum(times[1:]) / (agents * _STEPS * len(times[1:]) * workers)
