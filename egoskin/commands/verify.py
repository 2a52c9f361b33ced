"""Verify that training gives the same bits with different machine settings.

These are the numbers of workers, physics threads and learner threads, compiled or plain
sensor kernels, the interval of checkpoints, and a resume that changes them.

egoskin verify --iterations 3
egoskin verify --iterations 4 --sensor.coverage ray --num-envs 512
"""

from __future__ import annotations

import csv
import dataclasses
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from egoskin.agents.ppo import PPOConfig
from egoskin.make import EnvConfig
from egoskin.progress import counted
from egoskin.runs.config import TrainConfig, parse_config
from egoskin.runs.run import Run
from egoskin.runs.trainer import open_trainer, train
from egoskin.sensors.kernels.compilation import SETTING, can_compile
from egoskin.storage.formats import content_hash
from egoskin.storage.tensor_file import load_tensors


@dataclass(frozen=True, kw_only=True)
class Machine:
    """How a training is computed and saved; results must not depend on it."""

    workers: int
    """Worker processes."""
    physics: int
    """Physics threads of each worker."""
    learner: int
    """Threads of the learner."""
    compiled: bool
    """Whether the sensor kernels are compiled, if possible."""
    every: bool
    """Whether there is a checkpoint after every rollout, or only at the end."""

    def __str__(self) -> str:
        compiled = self.compiled and os.environ.get(SETTING) != "0" and can_compile()
        parts = [
            counted(self.workers, "worker"),
            counted(self.physics, "physics thread"),
            counted(self.learner, "learner thread"),
            f"{'compiled' if compiled else 'plain'} kernels",
            "a checkpoint each rollout" if self.every else "one checkpoint",
        ]
        return ", ".join(parts)

    @property
    def settings(self) -> dict[str, int | float]:
        """Values of the fields of a training configuration."""
        return {
            "num_workers": self.workers,
            "learner_threads": self.learner,
            "checkpoint_interval": 1e-6 if self.every else 1e9,
        }

    @contextmanager
    def kernels(self) -> Iterator[None]:
        """Enable or disable compiled sensor kernels, here and in workers."""
        before = os.environ.get(SETTING)
        if not self.compiled:
            os.environ[SETTING] = "0"
        try:
            yield
        finally:
            os.environ.pop(SETTING, None)
            if before is not None:
                os.environ[SETTING] = before


_MACHINES = (
    Machine(workers=1, physics=1, learner=1, compiled=True, every=False),
    Machine(workers=2, physics=2, learner=4, compiled=False, every=True),
    Machine(workers=4, physics=3, learner=2, compiled=True, every=False),
)
# Divisors of an odd number of agents: a worker's rows do not fill whole vectors.
_ODD_MACHINES = (
    Machine(workers=1, physics=1, learner=2, compiled=False, every=False),
    Machine(workers=3, physics=1, learner=1, compiled=True, every=True),
    Machine(workers=5, physics=2, learner=4, compiled=False, every=False),
)

# Enables from the start what a training normally enables after millions of frames.
_LATE = PPOConfig(noise_correlation_start=0)


@dataclass(frozen=True, kw_only=True)
class VerifyConfig:
    """Train with different splits and across a resume; exit status 0 if all agree."""

    iterations: int = 6
    """Rollouts to train; a resume is tried after half of them."""
    num_envs: int = 4096
    """Agents, a multiple of 4; an odd number just below is tried as well."""
    seed: int = 0
    """Seed of the trainings."""
    env: Annotated[EnvConfig, tyro.conf.arg(name="")] = field(default_factory=EnvConfig)
    """Robot, task, skin, sensors; also tried with corrupted sensors if possible."""

    def __post_init__(self) -> None:
        """Raise ValueError for sizes that cannot be split."""
        if self.iterations < 2:
            raise ValueError(f"iterations must be at least 2, got {self.iterations}")
        if self.num_envs < 16 or self.num_envs % 4:
            raise ValueError(
                f"num_envs must be a multiple of 4, at least 16, got {self.num_envs}"
            )

    @property
    def odd_num_envs(self) -> int:
        """The largest odd multiple of 15 not above ``num_envs``."""
        return (self.num_envs - 15) // 30 * 30 + 15


def run_hash(run: Run) -> str:
    """Return a hash of the values of a run: its checkpoint's tensors and its metrics.

    Configuration, times and the order of fields do not affect it, so that hashes of
    different versions can be compared.
    """
    tensors, header = load_tensors(run.checkpoint_path)
    # The log is a copy of the metrics.
    tensors = {k: v for k, v in tensors.items() if not k.startswith("log/")}
    with open(run.path / "metrics.csv", newline="") as file:
        metrics = [
            {k: v for k, v in row.items() if not k.startswith("time/")}
            for row in csv.DictReader(file)
        ]
    numbers = {key: header[key] for key in ("frames", "learning_rate")}
    return content_hash({**numbers, "metrics": metrics}, tensors)


def whole(config: TrainConfig, machine: Machine) -> str:
    """Return the hash of an uninterrupted run."""
    run = Run.create(dataclasses.replace(config, **machine.settings))
    with machine.kernels(), open_trainer(run, machine.physics) as trainer:
        train(trainer)
    return run_hash(run)


def resumed(config: TrainConfig, half: int, first: Machine, then: Machine) -> str:
    """Return the hash of a run that loses a rollout and resumes with other settings."""
    frames = half * config.frames_per_batch
    run = Run.create(dataclasses.replace(config, total_frames=frames, **first.settings))
    with first.kernels(), open_trainer(run, first.physics) as trainer:
        train(trainer)
        # Logged, but in no checkpoint: as if the process had been killed now.
        run.log(trainer.iterate())
    args = ["--resume", str(run.path), "--total-frames", str(config.total_frames)]
    for name, value in then.settings.items():
        args += [f"--{name.replace('_', '-')}", str(value)]
    run = Run(run.path, parse_config(args))
    with then.kernels(), open_trainer(run, then.physics) as trainer:
        train(trainer)
    return run_hash(run)


def agree(config: TrainConfig, folder: Path, title: str, half: int) -> bool:
    """Print the hash of each way to train; return whether they are equal."""
    machines = _ODD_MACHINES if config.num_envs % 2 else _MACHINES
    print(f"{title}, {counted(config.num_envs, 'agent')}", flush=True)
    hashes = []

    def show(value: str, where: str) -> None:
        print(f"  {value[:32]}  {where}", flush=True)
        hashes.append(value)

    def at(name: object) -> TrainConfig:
        place = f"{title}-{config.num_envs}-{name}".replace(" ", "-")
        return dataclasses.replace(config, run_dir=folder / place)

    for machine in machines:
        show(whole(at(machine.workers), machine), str(machine))
    _, first, then = machines
    rollouts = counted(half, "rollout")
    value = resumed(at("resumed"), half, first, then)
    show(value, f"the second, resumed after {rollouts} as the third")
    return len(set(hashes)) == 1


def main(args: list[str]) -> None:
    """Run the command."""
    config = tyro.cli(VerifyConfig, args=args)
    skins = {"skin as given": config.env}
    sensor = config.env.sensor
    if sensor.uses_skin and sensor.signal != "localization":
        noisy = dataclasses.replace(sensor, corruption="time_of_flight")
        skins["corrupted skin"] = dataclasses.replace(config.env, sensor=noisy)
    equal = True
    with tempfile.TemporaryDirectory(prefix="egoskin-verify-") as folder:
        for title, env in skins.items():
            for num_envs in (config.num_envs, config.odd_num_envs):
                base = TrainConfig(
                    env=env,
                    seed=config.seed,
                    num_envs=num_envs,
                    ppo=_LATE,
                )
                frames = config.iterations * base.frames_per_batch
                planned = dataclasses.replace(base, total_frames=frames)
                half = config.iterations // 2
                equal &= agree(planned, Path(folder), title, half)
    if not equal:
        raise SystemExit("NOT equal: training is not reproducible")
    print("equal: training is reproducible")
