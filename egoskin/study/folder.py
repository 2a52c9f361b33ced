"""The folder of a study, which alone determines the state of all its runs.

    manifest.json      definition of the runs, see `egoskin.study.manifest`
    runs/NAME/         a run folder, or a link to an existing one
    results/NAME/      the small files of a finished run, see `egoskin.study.stored`;
                       the evaluation is written last and marks the run as finished
    visibility.json    what each range sees, if it was analysed
    claims/            locks of runs being worked on, see `egoskin.study.claims`
    logs/NAME.log      output of the run's processes
    failed/NAME.json   number of failures, and the last error
    report/            output of `egoskin.study.report`

Contract: ``manifest.json``, ``results/`` and, if there is one, ``visibility.json`` are
all that a report needs.
"""

from __future__ import annotations

import csv
import dataclasses
import io
import os
import shutil
import time
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from egoskin.runs.config import INIT_HASH, read_config
from egoskin.runs.run import Run
from egoskin.storage.files import write_file
from egoskin.storage.formats import content_hash, read_sealed, sealed_json
from egoskin.storage.serialization import read_json, write_json
from egoskin.storage.tensor_file import load_tensors
from egoskin.study.claims import is_claimed, is_locked
from egoskin.study.manifest import EvaluationPlan, Manifest, PlannedRun
from egoskin.study.stored import (
    EVALUATION,
    StoredRun,
    evaluation_path,
    load_run,
    record,
    thin,
    to_json,
)

State = Literal["done", "running", "failed", "stopped", "missing"]
"""State of a run; stopped: it was begun, and no process works on it now."""

START = "--- started"
"""Beginning of the line that each start adds to a log."""

# Approximate maximum number of lines of metrics that are stored of a run.
_LINES = 250
# What an evaluation must share with the plan for its results to be comparable.
_OF_EVALUATION = ("standard", "throw_set", "episodes")
# Size of the end of a log that is searched for its last line [bytes].
_TAIL = 2**16


@dataclass(frozen=True, kw_only=True)
class Failure:
    """Failures of a run."""

    tries: int
    """Number of failures."""
    error: str
    """Its last error."""


@dataclass(frozen=True, kw_only=True)
class RunStatus:
    """Status of a run."""

    run: PlannedRun
    """The run."""
    state: State
    """Its state."""
    frames: int = 0
    """Environment steps done."""
    per_s: float | None = None
    """Environment steps per second of wall time, None if unknown."""
    success: float | None = None
    """Success of a finished run on the throw set."""
    failure: Failure | None = None
    """Its last failure, unless it has finished since."""

    @property
    def tries(self) -> int:
        """Number of failures."""
        return 0 if self.failure is None else self.failure.tries

    @property
    def frames_left(self) -> int:
        """Environment steps left to its end."""
        return self.run.end - self.frames

    @property
    def left_s(self) -> float | None:
        """Time left to its end at that speed [s], None if unknown."""
        if self.state == "done":
            return 0.0
        return self.frames_left / self.per_s if self.per_s else None


@dataclass(frozen=True, kw_only=True, eq=False)
class Result:
    """A finished run."""

    run: PlannedRun
    """The planned run."""
    stored: StoredRun
    """Its stored files."""
    policy_sha256: str
    """Hash of its policy, see `policy_hash`."""


class StudyFolder:
    """The folder of a study.

    Args:
        path: The folder.
    """

    def __init__(self, path: Path) -> None:
        self.path = path

    @property
    def manifest_path(self) -> Path:
        """The manifest."""
        return self.path / "manifest.json"

    @property
    def claims(self) -> Path:
        """Folder of the claims."""
        return self.path / "claims"

    def run_path(self, name: str) -> Path:
        """Run folder of a run."""
        return self.path / "runs" / name

    def result_path(self, name: str) -> Path:
        """Folder of the stored files of a run."""
        return self.path / "results" / name

    def log_path(self, name: str) -> Path:
        """Log of the processes of a run."""
        return self.path / "logs" / f"{name}.log"

    def _failure_path(self, name: str) -> Path:
        return self.path / "failed" / f"{name}.json"

    def manifest(self) -> Manifest:
        """Return the manifest.

        Raises:
            ValueError: If it is missing or invalid.
        """
        return Manifest.load(self.manifest_path)

    def extended(self, manifest: Manifest) -> Manifest:
        """Return a manifest with what the existing one, if any, has in addition.

        Raises:
            ValueError: If it would change the existing manifest.
        """
        if not self.manifest_path.exists():
            return manifest
        return self.manifest().extended(manifest)

    def plan(self, manifest: Manifest) -> Manifest:
        """Write a manifest or extend the existing one; return the result.

        Raises:
            ValueError: If it would change the existing manifest.
        """
        manifest = self.extended(manifest)
        if not self.manifest_path.exists() or manifest != self.manifest():
            self.path.mkdir(parents=True, exist_ok=True)
            manifest.save(self.manifest_path)
        return manifest

    # --- a run ----------------------------------------------------------------------

    def open_run(self, planned: PlannedRun, cores: int = 1) -> Run:
        """Return the run folder of a run, created if missing.

        Only a process that has claimed the run may call this.

        Args:
            planned: The run.
            cores: Its workers and learner threads.

        Raises:
            ValueError: If the existing folder belongs to another run.
        """
        path, config = self.run_path(planned.name), planned.config
        if not path.exists():
            if path.is_symlink():
                raise ValueError(
                    f"{path} is a link to {os.readlink(path)}, which does not exist: "
                    "restore it, or remove the link to train the run again"
                )
            # Renamed when complete: no incomplete folder has the run's name.
            new = path.with_name(f".{planned.name}.new")
            shutil.rmtree(new, ignore_errors=True)
            _check_files(planned, Run.create(dataclasses.replace(config, run_dir=new)))
            os.rename(new, path)
        stored = Run.open(path).config
        if differs := planned.differences(stored):
            raise ValueError(
                f"{path} does not match the manifest: it differs in "
                + ", ".join(differs)
            )
        if stored.total_frames > config.total_frames:
            raise ValueError(
                f"{path} is planned for {stored.total_frames:,} frames, the study for "
                f"{config.total_frames:,}: a longer run is a different run"
            )
        run = Run(
            path,
            dataclasses.replace(config, num_workers=cores, learner_threads=cores),
        )
        run.load_skin()
        _check_files(planned, run)
        return run

    def is_trained(self, planned: PlannedRun) -> bool:
        """Return whether a run has been trained to its end, and its policy exists."""
        path = self.run_path(planned.name)
        run = Run(path, planned.config)
        if not run.policy_path(planned.end).is_file():
            return False
        if run.checkpoint_path.is_file():
            # The policy is written before the checkpoint: it does not prove the end.
            _, header = load_tensors(run.checkpoint_path)
            return header.get("frames", 0) >= planned.end
        return _last_row(path / "metrics.csv").get("frames") == planned.end

    def is_trained_elsewhere(self, name: str) -> bool:
        """Return whether another process trains a run, for example egoskin train."""
        return is_locked(self.run_path(name) / "lock")

    def is_running(self, name: str) -> bool:
        """Return whether any process works on a run, a job of the study or another."""
        return is_claimed(self.claims, name) or self.is_trained_elsewhere(name)

    def is_finished(self, name: str) -> bool:
        """Return whether a run has been trained and evaluated."""
        return any(self.result_path(name).glob(EVALUATION))

    def finish(self, planned: PlannedRun, evaluation: Mapping[str, Any]) -> None:
        """Store the small files of a trained run, and mark it as finished.

        Args:
            planned: The run.
            evaluation: Result of `egoskin.study.evaluation.evaluate_policy`.
        """
        source, end = self.run_path(planned.name), planned.end
        run, folder = Run.open(source), self.result_path(planned.name)
        policy, made = run.policy_path(end), record(run, end)
        (folder / "policies").mkdir(parents=True, exist_ok=True)
        every = max(planned.end // _LINES, 1)
        contents = {
            f"policies/{policy.name}": policy.read_bytes(),
            "metrics.csv": thin(run.metrics(), every).encode(),
            "config.json": (source / "config.json").read_bytes(),
            "skin.json": run.skin_path.read_bytes(),
            "run.json": to_json(made).encode(),
            # Last: it marks the run as finished.
            f"evaluation_{end:012d}.json": sealed_json(
                {
                    "run": planned.name,
                    "policy_sha256": policy_hash(policy),
                    **evaluation,
                }
            ),
        }
        for name, content in contents.items():
            write_file(folder / name, content)
        self._failure_path(planned.name).unlink(missing_ok=True)

    def result(self, planned: PlannedRun, plan: EvaluationPlan | None = None) -> Result:
        """Return a finished run.

        Args:
            planned: The run.
            plan: How it must have been evaluated; None: in any way.

        Raises:
            ValueError: If it is damaged, or not the planned run.
        """
        folder = self.result_path(planned.name)
        stored = load_run(folder)
        differs = planned.differences(stored.config, stored.hashes)
        if plan is not None:
            differs += [
                f"evaluation.{name}"
                for name in _OF_EVALUATION
                if stored.evaluation[name] != getattr(plan, name)
            ]
        if differs:
            raise ValueError(
                f"{folder} does not match the manifest: it differs in "
                + ", ".join(differs)
            )
        file = evaluation_path(folder)
        evaluation = stored.evaluation
        if evaluation["frames"] != planned.end:
            raise ValueError(
                f"{file} evaluates a policy of {evaluation['frames']:,} frames, "
                f"expected {planned.end:,}"
            )
        digest = policy_hash(folder / "policies" / f"{planned.end:012d}.safetensors")
        if digest != evaluation["policy_sha256"]:
            raise ValueError(f"{file} does not belong to the policy stored with it")
        return Result(run=planned, stored=stored, policy_sha256=digest)

    def results(self, manifest: Manifest) -> list[Result]:
        """Return the finished runs, in the manifest's order.

        Raises:
            ValueError: If one is damaged, or not the planned run.
        """
        return [
            self.result(run, manifest.evaluation)
            for run in manifest.runs
            if self.is_finished(run.name)
        ]

    # --- failures -------------------------------------------------------------------

    def failure(self, name: str) -> Failure | None:
        """Return the failures of a run, None if there are none."""
        try:
            content = read_json(self._failure_path(name))
        except FileNotFoundError:
            return None
        return Failure(tries=content["tries"], error=content["error"])

    def note_failure(self, name: str, error: str) -> Failure:
        """Add a failure of a run; return its failures."""
        before = self.failure(name)
        failure = Failure(tries=(before.tries if before else 0) + 1, error=error)
        path = self._failure_path(name)
        path.parent.mkdir(exist_ok=True)
        write_json(path, dataclasses.asdict(failure))
        return failure

    def forget_failures(self, runs: Iterable[PlannedRun]) -> None:
        """Delete the failures of runs, so that they are tried again."""
        for run in runs:
            self._failure_path(run.name).unlink(missing_ok=True)

    def last_error(self, name: str) -> str:
        """Return the last error of a run's latest process, or else its last line.

        Of an error of several lines, as with a worker's traceback, the first and last.
        """
        with suppress(FileNotFoundError), open(self.log_path(name), "rb") as file:
            file.seek(max(0, file.seek(0, os.SEEK_END) - _TAIL))
            text = file.read().decode(errors="replace").rpartition(START)[2]
            lines = [line.strip() for line in text.split("\n")[1:] if line.strip()]
            starts = [i for i, line in enumerate(lines) if line.startswith("error: ")]
            if starts:
                first, *rest = lines[starts[-1] :]
                return ": ".join([first.removeprefix("error: "), *rest[-1:]])
            return lines[-1] if lines else ""
        return ""

    # --- progress -------------------------------------------------------------

    def status(self, runs: Iterable[PlannedRun]) -> list[RunStatus]:
        """Return the status of each of some runs.

        Raises:
            ValueError: If a result is damaged.
        """
        return [self._status(run) for run in runs]

    def _status(self, run: PlannedRun) -> RunStatus:
        if self.is_finished(run.name):
            content, _ = read_sealed(evaluation_path(self.result_path(run.name)))
            success = content["success"]["mean"]
            return RunStatus(run=run, state="done", frames=run.end, success=success)
        row = _last_row(self.run_path(run.name) / "metrics.csv")
        frames, wall = int(row.get("frames", 0)), row.get("time/wall_s", 0.0)
        failure = self.failure(run.name)
        state: State = "missing"
        if self.is_running(run.name):
            state = "running"
        elif failure is not None:
            state = "failed"
        elif self.run_path(run.name).exists():
            state = "stopped"
        return RunStatus(
            run=run,
            state=state,
            frames=frames,
            per_s=frames / wall if wall else None,
            failure=failure,
        )

    def adopt(self, manifest: Manifest, source: Path) -> PlannedRun:
        """Link to an existing run; return the planned run that it matches.

        Raises:
            ValueError: If it matches no run of the study; the text names the
                differences to the closest.
        """
        config = Run.open(source).config
        _, hashes = read_config(source / "config.json")
        differs = {run: run.differences(config, hashes) for run in manifest.runs}
        run = min(manifest.runs, key=lambda run: len(differs[run]))
        if differs[run]:
            raise ValueError(
                f"{source} is not a run of this study; the closest, {run.name}, "
                f"differs in {', '.join(differs[run])}"
            )
        path = self.run_path(run.name)
        if os.path.lexists(path):
            raise ValueError(f"{path} already exists")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.symlink_to(source.resolve(), target_is_directory=True)
        try:
            self.open_run(run)
        except (ValueError, OSError):
            path.unlink()
            raise
        return run


def _check_files(planned: PlannedRun, run: Run) -> None:
    """Raise ValueError unless a run has the skin and initial networks of its cell."""
    cell = planned.cell
    if content_hash(read_json(run.skin_path)) != cell.skin_sha256:
        path = cell.config.env.skin.path
        what = (
            f"{path} has changed: it"
            if path is not None
            else "the placement of sensors in this version of egoskin has changed: it"
        )
        raise ValueError(f"{what} is not the skin of the study's cell {cell.name}")
    _, hashes = read_config(run.path / "config.json")
    if cell.init_sha256 not in (None, hashes.get(INIT_HASH)):
        raise ValueError(
            f"{planned.config.init_from} has changed: it is not what the study's cell "
            f"{cell.name} starts from"
        )


def policy_hash(path: Path) -> str:
    """Return a hash of a policy's weights, skin, sizes and frames, not of its file."""
    # No note about a missing seal: callers compare the hash.
    tensors, header = load_tensors(path, quiet=True)
    spec = header["policy"]
    kept = {k: spec[k] for k in ("skin", "sizes", "num_actions", "frames")}
    return content_hash(kept, tensors)


def _last_row(path: Path) -> dict[str, float]:
    """Return the last complete line of a metrics file, empty if there is none."""
    try:
        with open(path, "rb") as file:
            columns = file.readline().decode().strip().split(",")
            size = file.seek(0, os.SEEK_END)
            file.seek(max(0, size - 2**14))
            lines = file.read().decode(errors="replace").split("\n")
    except OSError:
        return {}
    for line in reversed(lines[:-1]):
        row = next(csv.reader(io.StringIO(line)), [])
        if len(row) == len(columns):
            with suppress(ValueError):
                return dict(zip(columns, map(float, row), strict=True))
    return {}


def now() -> str:
    """Return the time of day, for logs."""
    return time.strftime("%Y-%m-%d %H:%M:%S")
