"""Verify that training is exact: whatever does not matter changes no bit.

python scripts/verify.py --iterations 3
python scripts/verify.py --iterations 4 --sensor.coverage ray --num-envs 512
"""

from __future__ import annotations

from egoskin.interrupts import end_quietly

if __name__ == "__main__":
    end_quietly()

# isort: split

import csv
import dataclasses
import hashlib
import json
import sys
import tempfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import torch
import tyro

from egoskin.agents.ppo import PPOConfig
from egoskin.checkpoint import load_tensors
from egoskin.cli import check_counts, clear_errors, counted
from egoskin.make import EnvConfig
from egoskin.runs import Run, TrainConfig, parse_config
from egoskin.training import open_trainer, train

# Workers, and the physics threads of each: results depend on neither.
_SPLITS = ((1, 1), (2, 2), (4, 3))
# Divisors of an odd number of agents: rows of a worker that fill no vector.
_ODD_SPLITS = ((1, 1), (3, 1), (5, 2))

# What a training does from some millions of frames on, it does here from the start.
_LATE = PPOConfig(noise_correlation_start=0)


@dataclass(frozen=True, kw_only=True)
class VerifyConfig:
    """Train with different splits and across a resume; exit status 0 if all agree."""

    iterations: int = 6
    """Rollouts to train; a resume is tried after half of them."""
    num_envs: int = 4096
    """Agents, a multiple of 4; an odd number just below is tried as well."""
    learner_threads: int | None = None
    """Threads of the learner; None: one for each core."""
    seed: int = 0
    """Seed of the trainings."""
    env: Annotated[EnvConfig, tyro.conf.arg(name="")] = field(default_factory=EnvConfig)
    """Robot, task, skin, sensors; with corrupted ones, where they can be, as well."""

    def __post_init__(self) -> None:
        """Raise ValueError for sizes that cannot be split."""
        if self.iterations < 2:
            raise ValueError(f"iterations must be at least 2, got {self.iterations}")
        if self.num_envs < 16 or self.num_envs % 4:
            raise ValueError(
                f"num_envs must be a multiple of 4 from 16 on, got {self.num_envs}"
            )
        check_counts(self, "learner_threads")

    @property
    def odd_num_envs(self) -> int:
        """The largest odd multiple of 15 not above ``num_envs``."""
        return (self.num_envs - 15) // 30 * 30 + 15


def run_hash(run: Run) -> str:
    """Return a hash of a run's checkpoint and of its metrics but for times."""
    digest = hashlib.sha256()
    tensors, header = load_tensors(run.checkpoint_path)
    # When and how long is no result; the metrics follow, without times.
    del header["wall_s"], header["starts"], tensors["log/metrics"]
    digest.update(json.dumps(header, sort_keys=True).encode())
    for name in sorted(tensors):
        value = tensors[name].contiguous()
        digest.update(f"{name} {value.dtype} {list(value.shape)}".encode())
        digest.update(value.reshape(-1).view(torch.uint8).numpy().tobytes())
    with open(run.path / "metrics.csv", newline="") as file:
        for row in csv.DictReader(file):
            kept = {k: v for k, v in row.items() if not k.startswith("time/")}
            digest.update(json.dumps(kept).encode())
    return digest.hexdigest()


def whole(config: TrainConfig, num_threads: int) -> str:
    """Return the hash of an uninterrupted run."""
    run = Run.create(config)
    with open_trainer(run, num_threads) as trainer:
        train(trainer)
    return run_hash(run)


def resumed(config: TrainConfig, iterations: int) -> str:
    """Return the hash of a run that lost its last rollout and was resumed."""
    frames = config.frames_per_batch
    run = Run.create(dataclasses.replace(config, total_frames=iterations * frames))
    with open_trainer(run) as trainer:
        train(trainer)
        # Logged, but in no checkpoint: as if the process had been killed now.
        run.log(trainer.iterate())
    end = ["--resume", str(run.path), "--total-frames", str(config.total_frames)]
    run = Run(run.path, parse_config(end))
    with open_trainer(run) as trainer:
        train(trainer)
    return run_hash(run)


def agree(config: TrainConfig, folder: Path, title: str, half: int) -> bool:
    """Print the hash of each way to train; return whether they are equal."""
    odd = config.num_envs % 2
    print(f"{title}, {counted(config.num_envs, 'agent')}", flush=True)
    hashes = []

    def show(what: str, value: str) -> None:
        rows = counted(config.num_envs // workers, "row")
        where = f"{counted(workers, 'worker')} x {rows}"
        print(f"  {value[:32]}  {where}, {what}", flush=True)
        hashes.append(value)

    for workers, threads in _ODD_SPLITS if odd else _SPLITS:
        name = f"{title}-{config.num_envs}-{workers}".replace(" ", "-")
        split = dataclasses.replace(config, num_workers=workers, run_dir=folder / name)
        show(counted(threads, "physics thread"), whole(split, threads))
        if workers == 2:
            again = dataclasses.replace(split, run_dir=folder / f"{name}-resumed")
            show(f"resumed after {counted(half, 'rollout')}", resumed(again, half))
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
                    learner_threads=config.learner_threads,
                    ppo=_LATE,
                )
                frames = config.iterations * base.frames_per_batch
                planned = dataclasses.replace(base, total_frames=frames)
                half = config.iterations // 2
                equal &= agree(planned, Path(folder), title, half)
    if not equal:
        raise SystemExit("NOT equal: training is not exact")
    print("equal: training is exact")


if __name__ == "__main__":
    with clear_errors():
        main(sys.argv[1:])
