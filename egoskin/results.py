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
from typing import Any

import numpy as np

from egoskin.cli import changed_fields, from_plain, read_json, to_plain
from egoskin.runs import Run, TrainConfig

# Environment steps between the stored lines of metrics (about 250 in the paper's 1000
# epochs), and their significant digits.
_THIN_FRAMES, _DIGITS = 2**18, 6
# How a run was called and where, which changes no result; and what names a cell.
_NO_RECIPE = {
    "seed",
    "total_frames",
    "num_workers",
    "device",
    "learner_threads",
    "run_dir",
    "snapshot_frames",
    "checkpoint_interval",
    "compile_kernels",
    "resume",
}
# What tells most comes first in tables and pictures.
_COVERAGES = ("oracle", "field", "ray", "none")
_SIGNALS = ("localization", "proximity", "closeness", "binary")
_CELL = {"env.sensor.coverage", "env.sensor.signal", "env.sensor.range"}
# Options of stored runs that are no more, and their values without effect: steps over
# which what of a ball touches grew, the price of the distance from the start (from
# "drift_start" on), and the speed of the balls (from "slow_start", 0.4 of it, on).
_RETIRED = {"core_frames": [0, 0], "drift_frames": [0, 0], "slow_start_frames": 0}


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
        default, own = to_plain(TrainConfig()), to_plain(self.config)
        names = changed_fields(default, own)
        return [
            f"{name}={_at(own, name)}"
            for name in names
            if name not in _NO_RECIPE | _CELL
        ]


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


def interquartile_mean(values: Sequence[float] | np.ndarray) -> float:
    """Return the mean without the top and bottom 25 %.

    Of a number of values that 4 does not divide, the values at the bounds count in
    part: of three, the outer ones by a quarter each.
    """
    x, n = np.sort(np.asarray(values, dtype=float)), len(values)
    index = np.arange(n)
    weight = np.minimum(index + 1, 0.75 * n) - np.maximum(index, 0.25 * n)
    weight = weight.clip(min=0)
    return float((weight * x).sum() / weight.sum())


def interquartile_range(values: Sequence[float] | np.ndarray) -> tuple[float, float]:
    """Return the quantiles at 25 % and 75 %, interpolated between values."""
    low, high = np.quantile(np.asarray(values, dtype=float), [0.25, 0.75])
    return float(low), float(high)


def thin(text: str) -> str:
    """Return a run's metrics with fewer lines and digits.

    Kept are the first line at or past each multiple of 2**18 environment steps and
    the last one.

    Args:
        text: Content of a ``metrics.csv``.
    """
    rows = list(csv.DictReader(io.StringIO(text)))
    kept, last = [], -1
    for row in rows:
        block = int(row["frames"]) // _THIN_FRAMES
        if block > last or row is rows[-1]:
            kept.append(row)
        last = block
    out = io.StringIO()
    writer = csv.DictWriter(out, list(rows[0]), lineterminator="\n")
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
    file = run.path / "versions.json"
    if not file.is_file():
        raise ValueError(f"{run.path} has not been started: it has no versions.json")
    starts = read_json(file)
    with open(run.path / "metrics.csv", newline="") as source:
        rows = [r for r in csv.DictReader(source) if int(r["frames"]) <= frames]
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
    return Record(
        command=" ".join(["python", f"scripts/{Path(script).name}", *args]),
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
    return set(names) <= _NO_RECIPE - {"seed"}


def load_runs(folder: Path) -> list[StoredRun]:
    """Return the stored runs by name.

    Raises:
        ValueError: If there is none, or one is not whole.
    """
    paths = sorted(path.parent for path in folder.glob("*/config.json"))
    if not paths:
        raise ValueError(f"{folder} holds no runs (scripts/results.py add RUN)")
    return [_load(path) for path in paths]


def _load(path: Path) -> StoredRun:
    """Return the run stored in a folder."""
    what = path / "run.json"
    evaluations = sorted(path.glob("evaluation_*.json"))
    for file in (what, path / "metrics.csv"):
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
    content = read_json(path / "config.json")
    content.pop("drift_start", None)
    content.pop("slow_start", None)
    used = {name: content.pop(name, off) for name, off in _RETIRED.items()}
    retired = {name: used[name] for name in used if used[name] != _RETIRED[name]}
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


@dataclass(frozen=True, kw_only=True, eq=False)
class Curve:
    """The learning curve of a cell over its seeds, as far as all of them go."""

    hours: np.ndarray
    """Simulated time of all agents [h], ``[n]``."""
    mean: np.ndarray
    """Interquartile mean of the success, ``[n]``."""
    low: np.ndarray
    """Its quantile at 25 %, ``[n]``."""
    high: np.ndarray
    """Its quantile at 75 %, ``[n]``."""


def curve(runs: Sequence[StoredRun]) -> Curve:
    """Return the learning curve of the seeds of a cell, empty if a seed has none."""
    frames = runs[0].frames
    for run in runs:
        # No seed is drawn beyond what is known of it.
        first, last = (*run.frames[:1], *run.frames[-1:]) or (math.inf, -math.inf)
        frames = frames[(frames >= first) & (frames <= last)]
    success = np.zeros((len(runs), len(frames)))
    if len(frames):
        success[:] = [np.interp(frames, run.frames, run.success) for run in runs]
    ranges = [interquartile_range(column) for column in success.T]
    hz = runs[0].config.env.task.physics.control_hz
    return Curve(
        hours=frames / hz / 3600,
        mean=np.array([interquartile_mean(column) for column in success.T]),
        low=np.array([low for low, _ in ranges]),
        high=np.array([high for _, high in ranges]),
    )


_COLUMNS = (
    "seed",
    "frames",
    "throws",
    "success at 3 s",
    "survival",
    "first balls avoided",
    "later balls avoided",
    "falls",
    "way at 3 s",
)


def table(runs_of_cell: dict[str, list[StoredRun]]) -> str:
    """Return the figures of cells as a Markdown table, a line for each seed."""
    lines = [_row("cell", *_COLUMNS), "|" + "---|" * (1 + len(_COLUMNS))]
    for name, runs in runs_of_cell.items():
        for run in runs:
            lines.append(_row(name, *_figures(run)))
        if len(runs) > 1:
            lines.append(_row(f"**{name}**, {len(runs)} seeds", *_over_seeds(runs)))
    return "\n".join(lines)


def _figures(run: StoredRun) -> list[str]:
    """Return the columns of one run."""
    e = run.evaluation
    success, survival = e["success"], e["survival_time"]
    return [
        str(run.config.seed),
        f"{run.record.frames / 1e6:.1f} M",
        f"{e['episodes']:,}",
        f"{_percent(success['mean'])} ({_percent(success['low'], '')} to "
        f"{_percent(success['high'], '')})",
        f"{survival['mean']:.2f} s",
        _percent(e["avoided"]["first_ball"]),
        _percent(e["avoided"]["later_balls"]),
        _percent(e["ended_by_fall"]),
        _metres(_way(run)),
    ]


def _over_seeds(runs: Sequence[StoredRun]) -> list[str]:
    """Return the columns of a cell: interquartile mean, and range of the success."""

    def mean(values: Iterable[float | None]) -> float | None:
        there = [x for x in values if x is not None]
        return interquartile_mean(there) if there else None

    all_of = [run.evaluation for run in runs]
    success = [e["success"]["mean"] for e in all_of]
    low, high = interquartile_range(success)
    survival = mean(e["survival_time"]["mean"] for e in all_of)
    return [
        "",
        "",
        "",
        f"**{_percent(mean(success))}** ({_percent(low, '')} to {_percent(high, '')})",
        f"{survival:.2f} s",
        _percent(mean(e["avoided"]["first_ball"] for e in all_of)),
        _percent(mean(e["avoided"]["later_balls"] for e in all_of)),
        _percent(mean(e["ended_by_fall"] for e in all_of)),
        _metres(mean(_way(run) for run in runs)),
    ]


def _way(run: StoredRun) -> float | None:
    """Return the mean displacement at 3 s [m], None where it was not measured."""
    for way in run.evaluation.get("behaviour", {}).get("displacement", ()):
        if way["age"] == 3.0:
            return way["mean"]
    return None


def _row(*columns: str) -> str:
    return f"| {' | '.join(columns)} |"


def _percent(value: float | None, unit: str = " %") -> str:
    return "-" if value is None else f"{100 * value:.1f}{unit}"


def _metres(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f} m"


_DEFAULT, _OTHER = "The default recipe", "Other recipes"

_HEAD = """# Results

Written by `python scripts/results.py write` from [results](../results/README.md); what
is written by hand is in `results/notes.md`.

Every figure is of the stored policy, mean action, on a bank of standard throws, with
95 % intervals for each seed (over throws, not over trainings); over seeds the
interquartile mean and, for the success, the interquartile range. Survival is at most
10 s. Balls are *avoided* that land or fly on past the robot while the episode lasts, of
those and the ones that touch it. *Falls* are the share of episodes ended by a fall
within 3 s; the *way* is the mean displacement of the episodes that last 3 s. The curves
are the estimate of success while training, exploration on, against the simulated time
of all agents: interquartile mean and range over the seeds, as far as all seeds go.
"""


def report(runs: Sequence[StoredRun], pictures: dict[str, str], notes: str) -> str:
    """Return the report in Markdown.

    Args:
        runs: The stored runs.
        pictures: File of the learning curves of each section, by its title.
        notes: What is written by hand, "" for nothing.
    """

    def section(title: str) -> list[str]:
        group = sections(runs).get(title)
        if group is None:
            return []
        picture = f"![Learning curves]({pictures[title]})"
        return [f"## {title}\n\n{picture}\n", table(group) + "\n"]

    rigid = max(run.evaluation["rigid_success"] for run in runs)
    parts = [
        _HEAD,
        *section(_DEFAULT),
        "The robot held rigid in its default pose succeeds in at most "
        f"{_percent(rigid)} of the throws of these banks.\n",
    ]
    if notes:
        parts.append(notes.strip() + "\n")
    if others := section(_OTHER):
        names = recipe_names(runs).items()
        parts += [*others, "What of them is not the default:\n"]
        parts += [f"* recipe {name}: `{recipe}`" for recipe, name in names]
        parts.append("")
    parts.append("## The runs\n")
    lines = [
        _row("run", "command", "commit", "seed", "frames", "wall time", "machine"),
        "|" + "---|" * 7,
    ]
    for run in runs:
        own = run.record
        lines.append(
            _row(
                f"`{run.name}`",
                f"`{own.command}`",
                own.commit,
                str(own.seed),
                f"{own.frames:,} of {run.config.total_frames:,}",
                f"{own.wall_s / 3600:.2f} h",
                own.machine,
            )
        )
    return "\n".join([*parts, *lines]) + "\n"


def recipe_names(runs: Sequence[StoredRun]) -> dict[str, str]:
    """Return a short name for each recipe that is not the default: A, B, ..."""
    recipes = dict.fromkeys(recipe for recipe, _ in cells(runs) if recipe)
    return {recipe: _letters(i) for i, recipe in enumerate(recipes)}


def _letters(number: int) -> str:
    """Return A to Z, then AA to AZ, and so on."""
    more, last = divmod(number, 26)
    return (_letters(more - 1) if more else "") + chr(ord("A") + last)


def sections(runs: Sequence[StoredRun]) -> dict[str, dict[str, list[StoredRun]]]:
    """Return the cells of the report by the title of their section."""
    names = recipe_names(runs)
    result: dict[str, dict[str, list[StoredRun]]] = {}
    for (recipe, cell), group in cells(runs).items():
        title = _OTHER if recipe else _DEFAULT
        name = f"{cell}; recipe {names[recipe]}" if recipe else cell
        result.setdefault(title, {})[name] = group
    return result


def to_json(value: Record) -> str:
    """Return a record as the content of its file."""
    return json.dumps(dataclasses.asdict(value), indent=2) + "\n"
