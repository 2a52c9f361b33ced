"""Environment steps/s of the training loop, layer by layer."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor

from benchmarks.report import Row, show
from egoskin.agents.ppo import PPO, PPOConfig, collect
from egoskin.checkpoint import part
from egoskin.envs.dodgeball import DodgeballEnv
from egoskin.envs.physics import Physics
from egoskin.make import (
    EnvConfig,
    check_num_workers,
    load_env_state,
    make_env,
    save_env_state,
)
from egoskin.policies import PolicySpec
from egoskin.workers import WorkerPool


@dataclass(frozen=True, kw_only=True)
class LoopConfig:
    """Environment steps/s of the training loop, layer by layer.

    Every layer starts from the same recorded state of a training and replays its
    actions (raw also its throws and resets). Ratios to raw are medians over pairs
    measured in turn, so that a busy machine does not bend them.
    """

    num_envs: int = 4096
    """Agents."""
    num_workers: int | None = None
    """Processes; None: the largest divisor of num_envs <= cores."""
    warmup: int = 8
    """Rollouts to train before the recording, so that it is typical."""
    rounds: int = 5
    """How often each layer is measured, in turn."""
    seed: int = 0
    """Seed of the training."""
    env: EnvConfig = field(default_factory=EnvConfig)
    """Robot, task, skin, sensors."""
    ppo: PPOConfig = field(default_factory=PPOConfig)
    """Networks and PPO."""
    json: Path | None = None
    """File to write the rows to."""

    def __post_init__(self) -> None:
        """Raise ValueError for values that cannot be measured."""
        if self.rounds < 1 or self.warmup < 0:
            raise ValueError("rounds must be at least 1 and warmup at least 0")
        check_num_workers(self.num_envs, self.num_workers)


class Recording(Physics):
    """Physics that writes down what is asked of it, to do it again bare."""

    written: list[tuple[str, tuple]]

    def set_target(self, target: Tensor) -> None:
        """Set the targets, and write it down."""
        self.written.append(("set_target", (target,)))
        super().set_target(target)

    def park(self, objects: Tensor) -> None:
        """Park objects; write down those that were in play."""
        fresh = objects & ~self._parked
        self._parked = objects.clone()
        if fresh.any():
            self.written.append(("park", (fresh,)))
        super().park(objects)

    def reset(self, rows: np.ndarray, base_pose: Tensor, joint_pos: Tensor) -> None:
        """Reset rows, and write it down."""
        self.written.append(("reset", (rows, base_pose, joint_pos)))
        super().reset(rows, base_pose, joint_pos)

    def throw(
        self, rows: np.ndarray, objects: np.ndarray, position: Tensor, velocity: Tensor
    ) -> None:
        """Throw, and write it down."""
        self.written.append(("throw", (rows, objects, position, velocity)))
        super().throw(rows, objects, position, velocity)

    def forget(self) -> None:
        """Write down from here on."""
        self.written = []
        self._parked = torch.zeros(self.num_envs, self.num_objects, dtype=torch.bool)


class RecordingEnv(DodgeballEnv):
    """The task on physics that write down what is asked of them."""

    physics_class = Recording


def replay_raw(physics: Physics, written: list[tuple[str, tuple]]) -> None:
    """Do again what was written down, with nothing but MuJoCo's steps."""
    for method, args in written:
        getattr(Physics, method)(physics, *args)
        if method == "set_target":
            physics.step_raw()


def loop(config: LoopConfig) -> list[Row]:
    """Return the rows of the loop benchmark."""
    workers = check_num_workers(config.num_envs, config.num_workers)
    skin = config.env.skin.build(config.env.robot_config)
    pools = {
        name: make_env(
            config.env,
            skin,
            num_envs=config.num_envs,
            num_workers=workers,
            seed=config.seed,
            bare=name == "env",
        )
        for name in ("env", "sensors")
    }
    try:
        return _measure(config, skin, pools, workers)
    finally:
        for pool in pools.values():
            pool.close()


def _measure(
    config: LoopConfig, skin: Any, pools: dict[str, WorkerPool], workers: int
) -> list[Row]:
    env, steps = pools["sensors"], config.ppo.rollout_steps
    torch.manual_seed(config.seed)
    spec = PolicySpec(
        env=config.env,
        skin=skin,
        network=config.ppo.network,
        sizes={k: env.observation_spec[k].shape[-1] for k in config.env.critic_keys},
        num_actions=env.action_spec.shape[-1],
    )
    agent = spec.build_agent()
    ppo = PPO(agent, config.ppo)
    root = env.reset()
    for i in range(config.warmup):
        show(f"warming up: rollout {i + 1}/{config.warmup}")
        rollout, root, _ = collect(env, agent, root, steps)
        ppo.update(rollout)
    start = save_env_state(env, root)
    rollout, _, _ = collect(env, agent, root, steps)
    actions = rollout["action"]
    simulation = part("simulation", start)
    recorder = RecordingEnv(
        config.env.robot_config,
        config.env.task,
        num_envs=config.num_envs,
        seed=config.seed,
        num_threads=workers,
    )
    physics = recorder.physics
    assert isinstance(physics, Recording)
    physics.forget()
    frame = recorder.reset()
    recorder.load_simulation_state(simulation)
    physics.forget()
    for action in actions:
        frame["action"] = action
        _, frame = recorder.step_and_maybe_reset(frame)
    written = physics.written

    def restore(pool: WorkerPool) -> TensorDictBase:
        return load_env_state(pool, start)

    def replay(pool: WorkerPool, root: TensorDictBase) -> None:
        for action in actions.reshape(steps, *root.batch_size, -1):
            root["action"] = action
            _, root = pool.step_and_maybe_reset(root)

    def policy(root: TensorDictBase) -> None:
        collect(env, agent, root, steps)

    def train(root: TensorDictBase) -> None:
        ppo.update(collect(env, agent, root, steps)[0])

    layers: dict[str, tuple[Callable[[], Any], Callable[[Any], None]]] = {
        "raw": (
            lambda: physics.load_state(simulation["physics"]),
            lambda _: replay_raw(physics, written),
        ),
        "env": (lambda: restore(pools["env"]), lambda r: replay(pools["env"], r)),
        "sensors": (lambda: restore(env), lambda r: replay(env, r)),
        "policy": (lambda: restore(env), policy),
        "train_field": (lambda: restore(env), train),
    }
    speeds: dict[str, list[float]] = {name: [] for name in layers}
    frames = steps * config.num_envs
    for i in range(config.rounds):
        for name, (prepare, run) in layers.items():
            show(f"round {i + 1}/{config.rounds}: {name}")
            prepared = prepare()
            begin = time.perf_counter()
            run(prepared)
            speeds[name].append(frames / (time.perf_counter() - begin))
    show("")
    return [
        Row(
            name=name,
            value=statistics.median(values),
            unit="environment steps/s",
            ratio=statistics.median(
                v / raw for v, raw in zip(values, speeds["raw"], strict=True)
            ),
        )
        for name, values in speeds.items()
    ]
