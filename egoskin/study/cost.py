"""Cost of a study, extrapolated from a short measurement of one run."""

from __future__ import annotations

import dataclasses
import math
import statistics
import tempfile
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path

from egoskin.progress import counted
from egoskin.runs.config import TrainConfig
from egoskin.runs.run import Run
from egoskin.runs.trainer import open_trainer
from egoskin.study.manifest import Manifest, PlannedRun

# Rollouts measured, after one warm-up rollout.
_ROLLOUTS = 3
# Size of a policy, of a line of metrics with its events, and of a checkpoint per
# environment [bytes].
_POLICY, _LINE, _CHECKPOINT = 36_000, 1_000, 3_800


@dataclass(frozen=True, kw_only=True)
class Cost:
    """Cost of a study."""

    runs: int
    """Number of runs."""
    frames: int
    """Environment steps of all runs."""
    per_s: float
    """Environment steps per second and core."""
    disk: float
    """Disk space of all runs [bytes], to an order of magnitude."""

    @property
    def core_s(self) -> float:
        """Time on one core [s]."""
        return self.frames / self.per_s

    def wall_s(self, cores: int) -> float:
        """Return the wall time on a number of cores [s], with one run per core."""
        one = self.core_s / self.runs
        return -(-self.runs // cores) * one


def cost(manifest: Manifest, per_s: float) -> Cost:
    """Return the cost of a study at a number of environment steps per second and core.

    Disk space grows with the number of policies and lines of metrics; their sizes are
    those of the default networks.
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
    """Speed of parallel runs on this machine."""

    cores_per_run: int
    """Workers and learner threads of each run."""
    parallel: int
    """Number of parallel runs."""
    per_s: float
    """Environment steps per second of all runs together, learning included."""

    def __str__(self) -> str:
        """Return a line of text."""
        return (
            f"{counted(self.parallel, 'run')} side by side on "
            f"{counted(self.cores_per_run, 'core')} each: {self.per_s:,.0f} steps/s"
        )


def measure_all(manifest: Manifest, run: PlannedRun, cores: int) -> list[Speed]:
    """Return the speeds with 1, 2, 4, ... cores per run, with all cores in use.

    Each measurement takes about half a minute and trains in temporary folders.

    Args:
        manifest: The study; all its runs can use these numbers of cores.
        run: The run to measure.
        cores: Number of cores to use.
    """
    agents = math.gcd(*(cell.config.num_envs for cell in manifest.cells))
    choices = [2**k for k in range(cores.bit_length()) if cores % 2**k == 0]
    return [measure(run, n, cores // n) for n in choices if agents % n == 0]


def measure(run: PlannedRun, cores_per_run: int = 1, parallel: int = 1) -> Speed:
    """Print what is measured; return the speed of some runs in parallel.

    Args:
        run: The run, the same in each process.
        cores_per_run: Workers and learner threads of each run.
        parallel: Number of parallel runs, each in its own process.
    """
    runs, each = counted(parallel, "run"), counted(cores_per_run, "core")
    print(f"measuring {runs} of {run.cell.name} on {each} each ...", flush=True)
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
