"""Stored files of a finished run: its record, learning curve and evaluation.

config.json                     the resolved configuration
skin.json                       its skin
run.json                        a `Record`: how it was made
metrics.csv                     its metrics, thinned by `thin`
policies/FRAMES.safetensors     the policy
evaluation_FRAMES.json          its results on the throw set of the study
"""

from __future__ import annotations

import csv
import dataclasses
import io
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from egoskin.runs.config import TrainConfig, read_config
from egoskin.runs.run import Run
from egoskin.storage.formats import read_sealed
from egoskin.storage.serialization import from_plain, read_json

EVALUATION = "evaluation_*.json"
"""Pattern of the name of the evaluation of a finished run."""

# Significant digits of stored metrics.
_DIGITS = 6


@dataclass(frozen=True, kw_only=True)
class Record:
    """How a run was made."""

    command: str
    """The command that started it."""
    commit: str
    """Abbreviated commits of its starts; "+" if the working tree had changes."""
    seed: int
    """Its seed."""
    frames: int
    """Environment steps of the stored policy."""
    wall_s: float
    """Wall time of collecting and learning up to there [s]."""
    machine: str
    """Machines it ran on."""


@dataclass(frozen=True, kw_only=True, eq=False)
class StoredRun:
    """The folder of a finished run."""

    config: TrainConfig
    """Its configuration."""
    hashes: dict[str, str]
    """Hashes of its files, by ``SKIN_HASH`` and ``INIT_HASH``; older runs lack some."""
    record: Record
    """How it was made."""
    frames: np.ndarray
    """Environment steps of the learning curve, ``[n]``, increasing."""
    success: np.ndarray
    """Share of episodes that last 3 s, estimated in training, ``[n]``."""
    evaluation: dict[str, Any]
    """Evaluation of its policy."""


def thin(text: str, every: int) -> str:
    """Return a run's metrics with fewer lines and digits.

    Keeps the first line at or after each multiple of ``every``, and the last line.

    Args:
        text: Content of a ``metrics.csv``.
        every: Environment steps between the lines that are kept.
    """
    source = csv.DictReader(io.StringIO(text))
    rows = list(source)
    kept, last = [], -1
    for row in rows:
        block = int(row["frames"]) // every
        if block > last or row is rows[-1]:
            kept.append(row)
        last = block
    out = io.StringIO()
    writer = csv.DictWriter(out, source.fieldnames or (), lineterminator="\n")
    writer.writeheader()
    for row in kept:
        writer.writerow(
            {
                key: value if key == "frames" else f"{float(value):.{_DIGITS}g}"
                for key, value in row.items()
            }
        )
    return out.getvalue()


def record(run: Run, frames: int) -> Record:
    """Return how a run was made.

    Args:
        run: The run.
        frames: Environment steps of the policy that is stored.

    Raises:
        ValueError: If the run has not been started.
    """
    starts = run.starts()
    if not starts:
        raise ValueError(f"{run.path} has not been started: it has no versions.json")
    lines = csv.DictReader(io.StringIO(run.metrics()))
    rows = [row for row in lines if int(row["frames"]) <= frames]
    script, *args = starts[0]["command"]
    commits = [
        "unknown"
        if start["git"] is None
        else start["git"]["commit"][:7] + "+" * start["git"]["changed"]
        for start in starts
    ]
    machines = [
        f"{start['machine']}, {start['cores']} cores, Python {start['python']}, "
        f"torch {start['packages']['torch']}, mujoco {start['packages']['mujoco']}"
        for start in starts
    ]
    # The location of the folder is irrelevant elsewhere. The script is a study's job,
    # another script, or "egoskin train".
    if script.endswith("study/job.py"):
        command = f"python -m egoskin.study.job FOLDER {run.path.name}"
    else:
        if script.endswith(".py"):
            script = f"python scripts/{Path(script).name}"
        command = " ".join([script, *_without(args, "--run-dir")])
    return Record(
        command=command,
        commit=", ".join(dict.fromkeys(commits)),
        seed=run.config.seed,
        frames=frames,
        wall_s=float(rows[-1]["time/wall_s"]) if rows else 0.0,
        machine="; ".join(dict.fromkeys(machines)),
    )


def _without(args: Sequence[str], option: str) -> list[str]:
    """Return arguments without an option and its value, however they are joined."""
    kept, skip = [], False
    for arg in args:
        name, joined, _ = arg.partition("=")
        if skip:
            skip = False
        elif name.replace("_", "-") == option:
            skip = not joined
        else:
            kept.append(arg)
    return kept


def evaluation_path(folder: Path) -> Path:
    """Return the evaluation stored in the folder of a finished run.

    Raises:
        ValueError: If there is none, or several, as after copying from two studies.
    """
    files = sorted(folder.glob(EVALUATION))
    if not files:
        raise ValueError(f"{folder} is incomplete: it has no evaluation")
    if len(files) > 1:
        raise ValueError(
            f"{folder} has {len(files)} evaluations, but only one can be right: "
            + ", ".join(file.name for file in files)
        )
    return files[0]


def load_run(path: Path) -> StoredRun:
    """Return the run stored in a folder.

    Raises:
        ValueError: If it is incomplete, or has several evaluations.
    """
    what = path / "run.json"
    for file in (path / "config.json", what, path / "metrics.csv"):
        if not file.is_file():
            raise ValueError(f"{path} is incomplete: it has no {file.name}")
    evaluation, _ = read_sealed(evaluation_path(path))
    made = from_plain(Record, read_json(what), str(what))
    curve = _curve(path / "metrics.csv", made.frames)
    file = path / "config.json"
    # No note about a missing seal: stored runs are under version control.
    config, hashes = read_config(file, quiet=True)
    return StoredRun(
        config=from_plain(TrainConfig, config, str(file)),
        hashes=hashes,
        record=made,
        frames=curve[:, 0],
        success=curve[:, 1],
        evaluation=evaluation,
    )


def _curve(path: Path, end: int) -> np.ndarray:
    """Return frames and success of the learning curve, ``[n, 2]``.

    Args:
        path: The metrics of a finished run.
        end: Environment steps of its policy.

    Raises:
        ValueError: If they end before: a part of a file may look like a slow run.
    """
    text = path.read_text()
    try:
        rows = [
            (float(row["frames"]), float(row["episode/success"]))
            for row in csv.DictReader(io.StringIO(text))
        ]
        whole = text.endswith("\n") and rows[-1][0] >= end
    except (KeyError, TypeError, ValueError, IndexError):
        whole, rows = False, []
    if not whole:
        raise ValueError(f"{path} is not whole: copy it again")
    curve = np.array(rows)
    # There is no estimate before an episode can have lasted that long.
    return curve[np.isfinite(curve[:, 1])]


def to_json(value: Record) -> str:
    """Return a record as the content of its file."""
    return json.dumps(dataclasses.asdict(value), indent=2) + "\n"
