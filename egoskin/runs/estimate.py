"""Estimate of the duration of a training on this machine."""

from __future__ import annotations

import time

import torch

from egoskin.make import check_num_workers, make_worker_env
from egoskin.parallel import available_cores
from egoskin.runs.config import TrainConfig
from egoskin.sensors import Skin

# Numbers of agents, of steps per rollout and of rollouts. The first rollout is warm-up;
# in the last ones robots fall, as in training.
_AGENTS, _STEPS, _ROLLOUTS = 256, 12, 3


def estimate_seconds(config: TrainConfig, skin: Skin, frames: int) -> float:
    """Estimate the time for environment steps of a training on this machine [s].

    The environments of a few agents are stepped for a second. So few agents take more
    time per agent than in a worker, by about the time of learning. Training takes
    longer if networks are far larger than the default or if other processes use the
    cores.

    Args:
        config: The training.
        skin: Its skin.
        frames: Number of environment steps.
    """
    agents = min(_AGENTS, config.num_envs)
    threads, times = torch.get_num_threads(), []
    torch.set_num_threads(1)
    try:
        # Random actions drawn here must not change the random state of the training.
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
    workers = min(workers, available_cores())
    return frames * sum(times[1:]) / (agents * _STEPS * len(times[1:]) * workers)
