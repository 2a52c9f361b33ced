"""What a study costs: a run is tried for a moment, and the rest is multiplication."""

from __future__ import annotations

import dataclasses
import statistics
import tempfile
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path

from egoskin.progress import counted
from egoskin.runs.run import Run, TrainConfig
from egoskin.runs.trainer import open_trainer
from egoskin.study.manifest import Manifest, PlannedRun

# Rollouts that are measured, after one that warms up.
_ROLLOUTS = 3
# Of a policy and a line of metrics with its events [bytes]; a checkpoint of an agent.
_POLICY, _LINE, _CHECKPOINT = 36_000, 1_000, 3_800


@dataclass(frozen=True, kw_only=True)
class Cost:
    """What a study costs."""

    runs: int
    """Runs."""
    frames: int
    """Environment steps of all."""
    per_s: float
    """Environment steps per second and core."""
    disk: float
    """Disk space of all [bytes], of an order of magnitude."""

    @property
    def core_s(self) -> float:
        """Time on one core [s]."""
        return self.frames / self.per_s

    def wall_s(self, cores: int) -> float:
        """Return the time on some cores [s]: whole runs, each on a core of its own."""
        one = self.core_s / self.runs
        return -(-self.runs // cores) * one


def cost(manifest: Manifest, per_s: float) -> Cost:
    """Return what a study costs at a number of environment steps per second and core.

    Disk space grows with the policies and lines of metrics; it is taken from runs of
    the default networks.
    """
    disk = 0.0
    for run in manifest.runs:
        config = run.config
        policies = run.end / config.snapshot_frames + 2
        lines = run.end / config.frames_per_batch
        disk += _POLICY * policies + _LINE * lines + _CHECKPOINT * config.num_envs
    frames = sum(run.end for run in manifest.runs)
    return Cost(runs=len(manifest.runs), frames=frames, per_s=per_s, disk=disk)


@dataclass(frozen=True, kw_only=True)
class Speed:
    """How fast runs are side by side on this machine."""

    cores_per_run: int
    """Workers and learner threads of each."""
    parallel: int
    """Runs side by side."""
    per_s: float
    """Environment steps per second of all together, learning included."""

    def __str__(self) -> str:
        """Return a line of text."""
        return (
            f"{counted(self.parallel, 'run')} side by side on "
            f"{counted(self.cores_per_run, 'core')} each: {self.per_s:,.0f} steps/s"
        )


def measure_all(
    run: PlannedRun, cores: int, tell: Callable[[str], None] = lambda text: None
) -> list[Speed]:
    """Return how fast a run is with 1, 2, 4, ... cores each, the machine full of them.

    Each takes about half a minute; they train in temporary folders.

    Args:
        run: The run.
        cores: Cores that may be used.
        tell: Told what is measured.
    """
    choices = [2**k for k in range(cores.bit_length()) if cores % 2**k == 0]
    fit = [n for n in choices if run.config.num_envs % n == 0]
    return [measure(run, n, cores // n, tell) for n in fit]


def measure(
    run: PlannedRun,
    cores_per_run: int = 1,
    parallel: int = 1,
    tell: Callable[[str], None] = lambda text: None,
) -> Speed:
    """Return how fast some runs are side by side.

    Args:
        run: What each of them runs.
        cores_per_run: Workers and learner threads of each.
        parallel: Runs side by side, each in a process of its own.
        tell: Told what is measured.
    """
    each = f"{counted(cores_per_run, 'core')} each"
    tell(f"measuring {counted(parallel, 'run')} of {run.cell.name} on {each} ...")
    config = dataclasses.replace(
        run.config, num_workers=cores_per_run, learner_threads=cores_per_run
    )
    with ProcessPoolExecutor(parallel, get_context("spawn")) as processes:
        speeds = list(processes.map(_train, [config] * parallel))
    return Speed(cores_per_run=cores_per_run, parallel=parallel, per_s=sum(speeds))


def _train(config: TrainConfig) -> float:
    """Train for some seconds in a temporary folder; return the steps per second."""
    with tempfile.TemporaryDirectory(prefix="egoskin-") as folder:
        config = dataclasses.replace(config, run_dir=Path(folder) / "run")
        with open_trainer(Run.create(config)) as trainer:
            speeds = [
                trainer.iterate()["time/steps_per_s"] for _ in range(_ROLLOUTS + 1)
            ]
    return statistics.median(speeds[1:])
