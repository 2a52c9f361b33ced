"""The runs behind the documented figures: what is stored of each, and what they say.

    results/NAME/config.json                     the resolved configuration
    results/NAME/run.json                        a `Record`: how it was made
    results/NAME/metrics.csv                     thinned, see `thin`
    results/NAME/policies/FRAMES.safetensors     the policy
    results/NAME/evaluation_FRAMES.json          an `Evaluation` on the standard throw,
                                                 with its behaviour and bank_seed
    results/notes.md                             written by hand, for the report

Contract: runs that differ in nothing but their seed are seeds of one cell.
"""

from __future__ import annotations

import csv
import dataclasses
import io
import json
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_args

import numpy as np

from egoskin.envs.dodgeball import DodgeballConfig
from egoskin.envs.standards import Standard, training_task
from egoskin.make import EnvConfig
from egoskin.runs.config import MACHINE_FIELDS, SKIN_HASH, TrainConfig
from egoskin.runs.run import Run
from egoskin.storage.formats import migrate, read_sealed
from egoskin.storage.serialization import (
    changed_fields,
    from_plain,
    read_json,
    to_plain,
)

# Environment steps between the stored lines of metrics (about 250 in the paper's 1000
# epochs), and their significant digits.
_THIN_FRAMES, _DIGITS = 2**18, 6
# What makes no other recipe of a run; and what names a cell.
_NO_RECIPE = MACHINE_FIELDS | {"seed", "total_frames", "device"}
# What tells most comes first in tables and pictures.
_COVERAGES = ("oracle", "field", "ray", "none")
_SIGNALS = ("localization", "proximity", "closeness", "binary")
_CELL = {"env.sensor.coverage", "env.sensor.signal", "env.sensor.range"}


@dataclass(frozen=True, kw_only=True)
class Record:
    """How a run was made."""

    command: str
    """The command that started it."""
    commit: str
    """Commits of its starts, abbreviated; "+" where the tree was changed."""
    seed: int
    """Its seed."""
    frames: int
    """Environment steps of the stored policy."""
    wall_s: float
    """Time that collecting and learning took up to there [s]."""
    machine: str
    """Machines it ran on."""


@dataclass(frozen=True, kw_only=True, eq=False)
class StoredRun:
    """A run folder of the results."""

    name: str
    """Name of the folder."""
    config: TrainConfig
    """Its configuration."""
    retired: dict[str, Any]
    """What it used of options that are no more."""
    record: Record
    """How it was made."""
    frames: np.ndarray
    """Environment steps of the learning curve, ``[n]``, rising."""
    success: np.ndarray
    """Share of episodes that last 3 s, estimated in training, ``[n]``."""
    evaluation: dict[str, Any]
    """Figures of the stored policy, as evaluate.py writes them."""

    @property
    def judged_on(self) -> Standard:
        """Version of the standard throw that it was evaluated on."""
        return self.evaluation.get("standard", "1")

    @property
    def cell(self) -> str:
        """What the actor is given."""
        own = [x for x in self._changes() if x.startswith("env.sensor.")]
        return ", ".join([_words(self.config), *_short(own)])

    @property
    def recipe(self) -> str:
        """What else differs from the default, "" if nothing does."""
        retired = [f"{name}={value}" for name, value in self.retired.items()]
        own = [x for x in self._changes() if not x.startswith("env.sensor.")]
        return ", ".join(retired + _short(own))

    def _changes(self) -> list[str]:
        """Return "field=value" of all that differs from the default and matters."""
        default, own = to_plain(_default(self.config)), to_plain(self.config)
        names = changed_fields(default, own)
        return [
            f"{name}={_at(own, name)}"
            for name in names
            if name not in _NO_RECIPE | _CELL
        ]


def _default(config: TrainConfig) -> TrainConfig:
    """Return the default recipe on the nearest version of the standard throw."""

    def on(version: Standard) -> TrainConfig:
        task = training_task(version, DodgeballConfig())
        return TrainConfig(env=EnvConfig(task=task))

    def distance(default: TrainConfig) -> int:
        return len(changed_fields(to_plain(default), to_plain(config)))

    return min(map(on, get_args(Standard)), key=distance)


def _words(config: TrainConfig) -> str:
    """Return the sensor's label as words, "field proximity, 2 m"."""
    sensor = config.env.sensor
    if not sensor.uses_skin:
        return sensor.label()
    reach = "any range" if math.isinf(sensor.range) else f"{sensor.range:g} m"
    return f"{sensor.coverage} {sensor.signal}, {reach}"


def _short(changes: Sequence[str]) -> list[str]:
    return [x.removeprefix("env.") for x in changes]


def _at(content: Any, name: str) -> Any:
    """Return the plain value at a dotted name."""
    for key in name.split("."):
        content = content[key]
    return content


def thin(text: str, every: int = _THIN_FRAMES) -> str:
    """Return a run's metrics with fewer lines and digits.

    Kept are the first line at or past each multiple of some environment steps and the
    last one.

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
        ValueError: If the folder does not say.
    """
    starts = run.starts()
    if not starts:
        raise ValueError(f"{run.path} has not been started: it has no versions.json")
    lines = csv.DictReader(io.StringIO(run.metrics()))
    rows = [row for row in lines if int(row["frames"]) <= frames]
    script, *args = starts[0]["command"]
    # Where a run's folder was is of no interest anywhere else.
    args = _without(args, "--run-dir")
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
    # A script's path, or "egoskin train".
    called = f"python scripts/{Path(script).name}" if script.endswith(".py") else script
    return Record(
        command=" ".join([called, *args]),
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


def same_but_length(one: TrainConfig, two: TrainConfig) -> bool:
    """Return whether two configurations are those of one run, or of its longer self."""
    names = changed_fields(to_plain(one), to_plain(two))
    return set(names) <= MACHINE_FIELDS | {"total_frames"}


def load_runs(folder: Path) -> list[StoredRun]:
    """Return the stored runs by name.

    Raises:
        ValueError: If there is none, or one is not whole.
    """
    paths = sorted(path.parent for path in folder.glob("*/config.json"))
    if not paths:
        raise ValueError(f"{folder} holds no runs (scripts/results.py add RUN)")
    return [load_run(path) for path in paths]


def load_run(path: Path) -> StoredRun:
    """Return the run stored in a folder.

    Raises:
        ValueError: If it is not whole.
    """
    what = path / "run.json"
    evaluations = sorted(path.glob("evaluation_*.json"))
    for file in (path / "config.json", what, path / "metrics.csv"):
        if not file.is_file():
            raise ValueError(f"{path} is not whole: it has no {file.name}")
    if not evaluations:
        raise ValueError(f"{path} is not whole: it has no evaluation")
    with open(path / "metrics.csv", newline="") as source:
        rows = list(csv.DictReader(source))
    curve = np.array(
        [(float(r["frames"]), float(r["episode/success"])) for r in rows]
    ).reshape(-1, 2)
    # No estimate before an episode could have lasted so long.
    curve = curve[np.isfinite(curve[:, 1])]
    # Stored runs are under version control, with a seal or without.
    content, number = read_sealed(path / "config.json", quiet=True)
    content.pop(SKIN_HASH, None)
    content, retired = migrate(content, number)
    return StoredRun(
        name=path.name,
        config=from_plain(TrainConfig, content, str(path / "config.json")),
        retired=retired,
        record=from_plain(Record, read_json(what), str(what)),
        frames=curve[:, 0],
        success=curve[:, 1],
        evaluation=read_json(evaluations[-1]),
    )


def cells(runs: Iterable[StoredRun]) -> dict[tuple[str, str], list[StoredRun]]:
    """Return the runs by (recipe, cell), the default recipe first, seeds in order."""
    result: dict[tuple[str, str], list[StoredRun]] = {}
    for run in sorted(runs, key=_order):
        result.setdefault((run.recipe, run.cell), []).append(run)
    return result


def _order(run: StoredRun) -> tuple[Any, ...]:
    sensor = run.config.env.sensor
    return (
        run.recipe,
        _COVERAGES.index(sensor.coverage),
        _SIGNALS.index(sensor.signal),
        -sensor.range,
        run.cell,
        run.config.seed,
        run.name,
    )


def to_json(value: Record) -> str:
    """Return a record as the content of its file."""
    return json.dumps(dataclasses.asdict(value), indent=2) + "\n"
