"""Execute the runs of a study in parallel, each in its own process.

`LocalRunner` uses this machine, `egoskin.study.ray_runner.RayRunner` a Ray cluster.

Contract: no run is executed twice, even if several runners share the folder. When a
runner ends, even by SIGKILL, its runs stop with a checkpoint; a new one resumes them.
"""

from __future__ import annotations

import os
import shlex
import signal
import subprocess
import sys
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from egoskin.parallel import available_cores
from egoskin.progress import can_overwrite, duration
from egoskin.study.folder import START, RunStatus, StudyFolder, now
from egoskin.study.job import CLAIMED, STOPPED, command
from egoskin.study.manifest import Manifest, PlannedRun

# Intervals at which processes are polled, and at which the folder, which may be on a
# shared file system, is searched for runs to do if no process has ended [s].
_POLL, _LOOK = 0.2, 5.0
# Intervals between progress lines: on a terminal, in a file [s].
_SHOW_LIVE, _SHOW_FILE = 2.0, 60.0
# Memory of each run on a cluster [GB]: one with full ray grids has 2.3 GB while it is
# evaluated.
_MEMORY_GB = 3
STOP_TIMEOUT_S = 120.0
"""How long a run may take to stop with a checkpoint [s]."""


@dataclass(frozen=True, kw_only=True)
class Progress:
    """Progress of a whole study."""

    counts: dict[str, int]
    """Number of runs in each state."""
    share: float
    """Share of all environment steps that are done."""
    left_s: float | None
    """Time left at the present speed [s], None if unknown."""

    @classmethod
    def of(cls, status: list[RunStatus], tries: int | None = None) -> Progress:
        """Return the progress for the status of all runs.

        Args:
            status: Status of each run.
            tries: Maximum number of attempts for each run; those that failed as often
                are not counted in the time left. None: there is no maximum.
        """
        counts = {"done": 0, "running": 0, "failed": 0, "stopped": 0, "missing": 0}
        for each in status:
            counts[each.state] += 1
        total = sum(each.run.end for each in status)
        done = sum(each.frames for each in status)
        lost = sum(
            each.frames_left
            for each in status
            if tries and each.state == "failed" and each.tries >= tries
        )
        speeds = [s.per_s for s in status if s.state == "running" and s.per_s]
        # Runs that have just begun are assumed to be as fast as the others.
        speed = sum(speeds) / len(speeds) * counts["running"] if speeds else 0.0
        left = (total - done - lost) / speed if speed else None
        left = 0.0 if counts["done"] == len(status) else left
        return cls(counts=counts, share=done / total, left_s=left)

    def __str__(self) -> str:
        """Return a line of text."""
        counts = ", ".join(f"{n} {k}" for k, n in self.counts.items() if n)
        return f"{counts}; {self.share:.1%} of the frames, ETA {duration(self.left_s)}"


class Runner(ABC):
    """Executes the runs of a study until all are done or have failed too often.

    Args:
        folder: The study.
        runs: Runs to execute; None: all runs of the study.
        parallel: Maximum number of parallel runs; None: as many as there are cores for.
        tries: Maximum number of attempts for each run.
        nice: Niceness of the runs.
        cores_per_run: Workers and learner threads of each run.
        show: Called with a line of text, and whether it is to stay: the progress line
            is replaced by the next line, a failure is not.

    Raises:
        ValueError: If the agents of a run cannot be divided among its cores.
    """

    def __init__(
        self,
        folder: StudyFolder,
        *,
        runs: Sequence[PlannedRun] | None = None,
        parallel: int | None = None,
        tries: int = 3,
        nice: int = 5,
        cores_per_run: int = 1,
        show: Callable[[str, bool], None] = lambda text, stays: None,
    ) -> None:
        self._folder = folder
        self._runs = folder.manifest().runs if runs is None else runs
        for cell in (run.cell for run in self._runs):
            if cell.config.num_envs % cores_per_run:
                raise ValueError(
                    f"--cores-per-run {cores_per_run} must divide num_envs of every "
                    f"cell; that of {cell.name} is {cell.config.num_envs}"
                )
        self._parallel, self._tries, self._nice = parallel, tries, nice
        self._cores, self._show = cores_per_run, show
        self._finished: set[str] = set()
        # When to try a run again that another process has claimed.
        self._again: dict[str, float] = {}

    @abstractmethod
    def _running(self) -> Collection[str]:
        """Return the names of the runs that this runner is executing."""

    @abstractmethod
    def _begin(self, run: PlannedRun) -> None:
        """Start a run."""

    @abstractmethod
    def _ended(self) -> dict[str, tuple[int, str]]:
        """Return (exit status, last error) of the runs that have ended, by name."""

    @abstractmethod
    def _stop(self) -> None:
        """Stop this runner's runs, with checkpoints."""

    def run(self) -> list[RunStatus]:
        """Execute the runs; return the final status of each.

        Raises:
            OSError: If a log or a failure cannot be written.
        """
        for name in ("runs", "results", "claims", "logs", "failed"):
            (self._folder.path / name).mkdir(exist_ok=True)
        interval = _SHOW_LIVE if can_overwrite(sys.stdout) else _SHOW_FILE
        looked = shown = float("-inf")
        try:
            while True:
                if self._reap() or time.monotonic() - looked > _LOOK:
                    open_runs = self._open_runs()
                    if not (open_runs or self._running()):
                        return self._folder.status(self._runs)
                    self._start(open_runs)
                    looked = time.monotonic()
                if time.monotonic() - shown > interval:
                    status = self._folder.status(self._runs)
                    self._show(str(Progress.of(status, self._tries)), False)
                    shown = time.monotonic()
                time.sleep(_POLL)
        finally:
            self._stop()

    def _open_runs(self) -> list[PlannedRun]:
        """Return the runs that are left to do, except this runner's."""
        result = []
        for run in self._runs:
            if run.name in self._finished or run.name in self._running():
                continue
            if self._folder.is_finished(run.name):
                self._finished.add(run.name)
                continue
            failure = self._folder.failure(run.name)
            if failure is None or failure.tries < self._tries:
                result.append(run)
        return result

    def _start(self, open_runs: list[PlannedRun]) -> None:
        for run in open_runs:
            if self._parallel and len(self._running()) >= self._parallel:
                return
            clock = time.monotonic()
            if self._again.get(run.name, clock) > clock:
                continue
            if self._folder.is_running(run.name):
                self._again[run.name] = clock + _LOOK
                continue
            self._begin(run)

    def _reap(self) -> bool:
        """Handle the runs that have ended; return whether there are any."""
        ended = self._ended()
        for name, (status, error) in ended.items():
            if status == CLAIMED:
                self._again[name] = time.monotonic() + _LOOK
            elif status not in (0, STOPPED):
                failure = self._folder.note_failure(name, error)
                self._show(
                    f"{name} failed, try {failure.tries} of {self._tries}: {error}",
                    True,
                )
        return bool(ended)


class LocalRunner(Runner):
    """Runner on this machine, with several runs in parallel."""

    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        if self._parallel is None:
            self._parallel = max(available_cores() // self._cores, 1)
        self._jobs: dict[str, subprocess.Popen[bytes]] = {}

    def _running(self) -> Collection[str]:
        return self._jobs

    def _begin(self, run: PlannedRun) -> None:
        self._jobs[run.name] = start_job(
            self._folder, run.name, self._nice, self._cores
        )

    def _ended(self) -> dict[str, tuple[int, str]]:
        ended = {
            name: job for name, job in self._jobs.items() if job.poll() is not None
        }
        for name in ended:
            del self._jobs[name]
        return {
            name: (job.returncode, how_it_ended(self._folder, name, job.returncode))
            for name, job in ended.items()
        }

    def _stop(self) -> None:
        for job in self._jobs.values():
            job.terminate()
        deadline = time.monotonic() + STOP_TIMEOUT_S
        for job in self._jobs.values():
            end_job(job, deadline - time.monotonic())
        self._jobs.clear()


def start_job(
    folder: StudyFolder, name: str, nice: int, cores: int
) -> subprocess.Popen[bytes]:
    """Start and return the process of a run, which writes to the run's log."""
    with open(folder.log_path(name), "ab") as log:
        log.write(f"{START} {now()}\n".encode())
        log.flush()
        return subprocess.Popen(
            command(folder.path, name, nice, cores),
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=subprocess.STDOUT,
            # A terminal's Ctrl-C reaches only the runner, which passes it on.
            start_new_session=True,
            env={**os.environ, "OMP_NUM_THREADS": "1"},
        )


def end_job(job: subprocess.Popen[bytes], timeout: float) -> None:
    """Wait until a stopping job has ended; kill it after ``timeout`` [s]."""
    try:
        job.wait(max(0.0, timeout))
    except subprocess.TimeoutExpired:
        os.killpg(job.pid, signal.SIGKILL)
        job.wait()


def how_it_ended(folder: StudyFolder, name: str, status: int) -> str:
    """Return the last error of a run whose job ended with an exit status."""
    if status < 0:
        return f"killed by {signal.Signals(-status).name}"
    return folder.last_error(name)


def slurm_script(
    manifest: Manifest, folder: Path, *, cores: int, elements: int, hours: float
) -> str:
    """Return a Slurm job array whose elements share the work on a folder.

    Args:
        manifest: The study.
        folder: Its folder, shared by all nodes.
        cores: Cores of each element, and number of parallel runs.
        elements: Elements of the array.
        hours: Time limit of each element, at which it stops with checkpoints.
    """
    minutes = max(round(60 * hours), 1)
    logs = shlex.quote(str(folder / "logs" / "slurm-%A-%a.log"))
    path = shlex.quote(str(folder))
    # Of this environment, which the nodes need not have activated.
    python = shlex.quote(sys.executable)
    return f"""#!/bin/bash
# Study {manifest.study}: {len(manifest.runs)} runs, shared by all elements.
# An element that reaches its time limit stops with checkpoints; one that is killed
# loses a minute of work. Submit this again until `status` shows that all runs are done.
#SBATCH --job-name=egoskin-{manifest.study}
#SBATCH --array=0-{elements - 1}
#SBATCH --nodes=1
#SBATCH --ntasks=1
#SBATCH --cpus-per-task={cores}
#SBATCH --mem-per-cpu={_MEMORY_GB}G
#SBATCH --time={minutes}
#SBATCH --signal=B:TERM@180
#SBATCH --requeue
#SBATCH --output={logs}
exec {python} -m egoskin study run --dir {path} --parallel "$SLURM_CPUS_PER_TASK"
"""
