"""What a study costs: a run is tried for a moment, and the rest is multiplication."""

from __future__ import annotations

import dataclasses
import statistics
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from egoskin.runs.run import Run
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


def measure(run: PlannedRun, tell: Callable[[str], None] = lambda text: None) -> float:
    """Return the environment steps per second of a run on one core, learning included.

    It trains for some seconds in a temporary folder.
    """
    with tempfile.TemporaryDirectory(prefix="egoskin-") as folder:
        config = dataclasses.replace(run.config, run_dir=Path(folder) / "run")
        tell(f"measuring the speed of {run.cell.name} ...")
        with open_trainer(Run.create(config)) as trainer:
            speeds = [
                trainer.iterate()["time/steps_per_s"] for _ in range(_ROLLOUTS + 1)
            ]
    return statistics.median(speeds[1:])
