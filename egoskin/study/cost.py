"""Cost of a study, extrapolated from a short measurement of one run."""

from __future__ import annotations

import dataclasses
import math
import statistics
import tempfile
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from multiprocessing import active_children, get_context
from pathlib import Path

from egoskin.agents.ppo import NonFiniteError
from egoskin.interrupts import block_terminal_signals, end_with_parent
from egoskin.parallel import WorkerError
from egoskin.progress import counted
from egoskin.runs.config import TrainConfig
from egoskin.runs.run import Run
from egoskin.runs.trainer import open_trainer
from egoskin.study.manifest import Manifest, PlannedRun

WORTH_MEASURING = 50_000_000
"""Environment steps of a study that is long enough to measure its best settings."""
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
        """Return the wall time on a number of cores [s].

        Each run has one core or, in a long study with fewer runs than cores, as many as
        `measure_all` would find if its speed grew with them.
        """
        each = 1
        if self.frames >= WORTH_MEASURING:
            each = max((n for n in shares(cores) if n * self.runs <= cores), default=1)
        rounds = -(-self.runs // (cores // each))
        return rounds * self.core_s / self.runs / each


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

    def of(self, runs: int) -> float:
        """Return the environment steps per second if only some runs are left."""
        return self.per_s * min(1.0, runs / self.parallel)

    def __str__(self) -> str:
        """Return a line of text."""
        return (
            f"{counted(self.parallel, 'run')} side by side on "
            f"{counted(self.cores_per_run, 'core')} each: {self.per_s:,.0f} steps/s"
        )


def shares(cores: int) -> list[int]:
    """Return the numbers of cores per run that are tried: 1, 2, 4, ..."""
    return [2**k for k in range(cores.bit_length()) if cores % 2**k == 0]


def measure_all(manifest: Manifest, run: PlannedRun, cores: int) -> list[Speed]:
    """Return the speeds with 1, 2, 4, ... cores per run, with all cores in use.

    Each measurement takes about half a minute and trains in temporary folders.

    Args:
        manifest: The study; all its runs can use these numbers of cores.
        run: The run to measure.
        cores: Number of cores to use.

    Raises:
        ValueError, OSError, WorkerError: As `measure`.
    """
    agents = math.gcd(*(cell.config.num_envs for cell in manifest.cells))
    return [measure(run, n, cores // n) for n in shares(cores) if agents % n == 0]


def measure(run: PlannedRun, cores_per_run: int = 1, parallel: int = 1) -> Speed:
    """Print what is measured; return the speed of some runs in parallel.

    Args:
        run: The run, the same in each process.
        cores_per_run: Workers and learner threads of each run.
        parallel: Number of parallel runs, each in its own process.

    Raises:
        ValueError: If it cannot be trained.
        OSError: If a file cannot be read or written.
        WorkerError: If a process ends.
    """
    runs, each = counted(parallel, "run"), counted(cores_per_run, "core")
    print(f"measuring {runs} of {run.cell.name} on {each} each ...", flush=True)
    config = dataclasses.replace(
        run.config, num_workers=cores_per_run, learner_threads=cores_per_run
    )
    others = set(active_children())
    with (
        tempfile.TemporaryDirectory(prefix="egoskin-") as folder,
        ProcessPoolExecutor(
            parallel, get_context("spawn"), end_with_parent, (folder,)
        ) as processes,
    ):
        try:
            with block_terminal_signals():
                jobs = [
                    processes.submit(_train, config, Path(folder) / str(i))
                    for i in range(parallel)
                ]
            speeds = [job.result() for job in jobs]
        except BaseException as error:
            # Also on Ctrl-C: they would train on.
            for process in set(active_children()) - others:
                process.kill()
            if not isinstance(error, BrokenProcessPool):
                raise
            raise WorkerError("a process of the measurement was killed") from None
    return Speed(cores_per_run=cores_per_run, parallel=parallel, per_s=sum(speeds))


def _train(config: TrainConfig, folder: Path) -> float:
    """Train for some seconds in a new folder; return the steps per second."""
    config = dataclasses.replace(config, run_dir=folder)
    try:
        with open_trainer(Run.create(config)) as trainer:
            speeds = [
                trainer.iterate()["time/steps_per_s"] for _ in range(_ROLLOUTS + 1)
            ]
    except (ValueError, NonFiniteError) as error:
        # Some of these cannot be sent to another process.
        raise ValueError(str(error)) from None
    return statistics.median(speeds[1:])
