"""Train and evaluate one run of a study, in its own process.

python -m egoskin.study.job FOLDER NAME

The first job of a run claims it, trains it from its last checkpoint to its end,
evaluates its policy and stores the result. A signal, or the end of the parent process
(``--parent``), stops it with a checkpoint. The exit status tells these cases apart.
"""

from __future__ import annotations

import argparse
import os
import sys
import threading
import time
from pathlib import Path
from types import FrameType

from egoskin.agents.ppo import NonFiniteError
from egoskin.interrupts import ENDING, take
from egoskin.parallel import WorkerError
from egoskin.policies.policy import load_policy
from egoskin.progress import ProgressLine
from egoskin.runs.run import RunLockedError
from egoskin.runs.trainer import open_trainer, train
from egoskin.study.claims import claimed
from egoskin.study.evaluation import evaluate_policy
from egoskin.study.folder import StudyFolder, now

FAILED = 1
"""Exit status after an error, which has been written to stderr."""
CLAIMED = 75
"""Exit status if another process works on the run (EX_TEMPFAIL)."""
STOPPED = 76
"""Exit status after a stop, with a checkpoint."""

# Interval between checks that the parent is alive [s].
_LOOK = 1.0


class _StoppedError(Exception):
    """Raised to stop an evaluation."""


class Stop:
    """Request to stop the job, after a signal or when its parent has ended.

    Args:
        parent: Process id of the parent; None: no parent is watched.
    """

    def __init__(self, parent: int | None = None) -> None:
        self.requested = False
        take(self._note, *ENDING)
        if parent is not None:
            args = (parent,)
            threading.Thread(target=self._watch, args=args, daemon=True).start()

    def _note(self, number: int, frame: FrameType | None) -> None:
        self.requested = True

    def _watch(self, parent: int) -> None:
        while os.getppid() == parent:
            time.sleep(_LOOK)
        self.requested = True

    def check(self, step: int, running: int) -> None:
        """Raise _StoppedError if a stop is requested; called as ``on_step``."""
        if self.requested:
            raise _StoppedError


def work(folder: StudyFolder, name: str, stop: Stop, cores: int = 1) -> int:
    """Train and evaluate a run, skipping what is done; return the exit status.

    Args:
        folder: The study.
        name: Name of the run.
        stop: Request to stop.
        cores: Workers and learner threads; results do not depend on them.

    Raises:
        ValueError: If its folder belongs to another run or is damaged.
        OSError: If a file cannot be written.
        WorkerError: If a worker process ends.
        NonFiniteError: If an update is not finite.
    """
    manifest = folder.manifest()
    planned = manifest.run(name)
    # Not a failure: if the claim is lost, another host works on the run.
    with claimed(folder.claims, name, lost=lambda: os._exit(CLAIMED)) as mine:
        if not mine:
            return CLAIMED
        if folder.is_finished(name):
            return 0
        print(f"{now()} {name}", flush=True)
        run = folder.open_run(planned, cores)
        if folder.is_trained_elsewhere(name):
            return CLAIMED
        if not folder.is_trained(planned):
            try:
                with open_trainer(run) as trainer:
                    line = ProgressLine(trainer.frames, planned.end)
                    train(trainer, lambda: stop.requested, line.update)
            except RunLockedError:
                # It was free a moment ago.
                return CLAIMED
            if trainer.frames < planned.end:
                return STOPPED
        print(f"{now()} evaluate on {manifest.evaluation.episodes} throws", flush=True)
        try:
            policy = load_policy(run.policy_path(planned.end))
            result = evaluate_policy(policy, manifest.evaluation, stop.check, cores)
        except _StoppedError:
            return STOPPED
        folder.finish(planned, result)
        print(f"{now()} finished", flush=True)
        return 0


def command(folder: Path, name: str, nice: int, cores: int) -> list[str]:
    """Return the command that starts a run's job as a child of this process."""
    module = [sys.executable, "-m", "egoskin.study.job"]
    options = ["--parent", str(os.getpid()), "--nice", str(nice)]
    options += ["--cores", str(cores)]
    return [*module, str(folder), name, *options]


def main() -> int:
    """Run the command."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("name")
    parser.add_argument("--parent", type=int)
    parser.add_argument("--nice", type=int, default=0)
    parser.add_argument("--cores", type=int, default=1)
    args = parser.parse_args()
    os.nice(args.nice)
    try:
        stop = Stop(args.parent)
        return work(StudyFolder(args.folder), args.name, stop, args.cores)
    except (ValueError, OSError, WorkerError, NonFiniteError) as error:
        print(f"error: {error}", file=sys.stderr)
        return FAILED


if __name__ == "__main__":
    raise SystemExit(main())
