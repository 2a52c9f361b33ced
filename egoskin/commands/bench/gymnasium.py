"""Speed of the environment's Gymnasium interfaces."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from operator import truediv
from pathlib import Path
from typing import Annotated

import gymnasium
import numpy as np
import torch

from egoskin.bounds import COUNT, check_bounds
from egoskin.commands.bench.report import Row, median_row, show
from egoskin.gym import ENV_ID
from egoskin.make import EnvConfig, check_num_workers, make_env


@dataclass(frozen=True, kw_only=True)
class GymnasiumBench:
    """Environment steps/s of the Gymnasium interfaces and the TorchRL environment.

    Robots get zero actions, fall and are reset; nothing is trained.
    """

    num_envs: int = 1024
    """Robots of the vector interface and of the TorchRL environment."""
    num_workers: int | None = None
    """Processes; None: the largest divisor of num_envs <= cores."""
    steps: Annotated[int, COUNT] = 64
    """Control steps in each measurement."""
    rounds: Annotated[int, COUNT] = 5
    """How often each interface is measured, in turn."""
    json: Path | None = None
    """File to write the rows to."""

    def __post_init__(self) -> None:
        """Raise ValueError for invalid values."""
        check_bounds(self)
        check_num_workers(self.num_envs, self.num_workers)


def gymnasium_rows(config: GymnasiumBench) -> list[Row]:
    """Return the rows of the Gymnasium benchmark; ratios are to the TorchRL row."""
    number = config.num_envs
    own = make_env(EnvConfig(), num_envs=number, seed=0, num_workers=config.num_workers)
    vector = gymnasium.make_vec(ENV_ID, number, num_workers=config.num_workers)
    single = gymnasium.make(ENV_ID)
    joints = own.action_spec.shape[-1]
    actions = np.zeros((number, joints), dtype=np.float32)

    def step_own() -> None:
        root = own.reset()
        for _ in range(config.steps):
            root["action"] = torch.zeros(*root.batch_size, joints)
            _, root = own.step_and_maybe_reset(root)

    def step_vector() -> None:
        vector.reset()
        for _ in range(config.steps):
            vector.step(actions)

    def step_single() -> None:
        single.reset()
        for _ in range(config.steps):
            _, _, terminated, truncated, _ = single.step(actions[0])
            if terminated or truncated:
                single.reset()

    forms: dict[str, tuple[Callable[[], None], int]] = {
        "torchrl": (step_own, number),
        "gymnasium_vector": (step_vector, number),
        "gymnasium_single": (step_single, 1),
    }
    speeds: dict[str, list[float]] = {name: [] for name in forms}
    try:
        for run, _ in forms.values():
            run()
        for i in range(config.rounds):
            for name, (run, rows) in forms.items():
                show(f"round {i + 1}/{config.rounds}: {name}")
                begin = time.perf_counter()
                run()
                spent = time.perf_counter() - begin
                speeds[name].append(rows * config.steps / spent)
    finally:
        own.close()
        vector.close()
    show("")
    base = speeds["torchrl"]
    return [
        median_row(name, each, map(truediv, each, base), "environment steps/s")
        for name, each in speeds.items()
    ]
