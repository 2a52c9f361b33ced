"""What the stored runs say: statistics over seeds, tables, and the written report."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from egoskin.results import StoredRun, cells


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
    "standard",
    "seed",
    "frames",
    "throws",
    "success at 3 s",
    "success at 5 s",
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
    trained = run.config.env.standard
    return [
        trained
        if trained == run.judged_on
        else f"{trained}, judged on {run.judged_on}",
        str(run.config.seed),
        f"{run.record.frames / 1e6:.1f} M",
        f"{e['episodes']:,}",
        f"{_percent(success['mean'])} ({_percent(success['low'], '')} to "
        f"{_percent(success['high'], '')})",
        _percent(_lasting(run)),
        f"{survival['mean']:.2f} s",
        _percent(e["avoided"]["first_ball"]),
        _percent(e["avoided"]["later_balls"]),
        _percent(e["ended_by_fall"]),
        metres(_way(run)),
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
        "",
        f"**{_percent(mean(success))}** ({_percent(low, '')} to {_percent(high, '')})",
        _percent(mean(_lasting(run) for run in runs)),
        f"{survival:.2f} s",
        _percent(mean(e["avoided"]["first_ball"] for e in all_of)),
        _percent(mean(e["avoided"]["later_balls"] for e in all_of)),
        _percent(mean(e["ended_by_fall"] for e in all_of)),
        metres(mean(_way(run) for run in runs)),
    ]


def _way(run: StoredRun) -> float | None:
    """Return the mean displacement at 3 s [m], None where it was not measured."""
    at = _at_age(run, 3.0)
    return None if at is None else at["mean"]


def _lasting(run: StoredRun) -> float | None:
    """Return the share of episodes that last 5 s, None where it was not measured."""
    at = _at_age(run, 5.0)
    return None if at is None else at["episodes"] / run.evaluation["episodes"]


def _at_age(run: StoredRun, age: float) -> dict[str, Any] | None:
    """Return the `behaviour.Displacement` at an age [s], None without one."""
    ways = run.evaluation.get("behaviour", {}).get("displacement", ())
    return next((way for way in ways if way["age"] == age), None)


def _row(*columns: str) -> str:
    return f"| {' | '.join(columns)} |"


def _percent(value: float | None, unit: str = " %") -> str:
    return "-" if value is None else f"{100 * value:.1f}{unit}"


def metres(value: float | None) -> str:
    """Return a length [m] as text, a dash for None."""
    return "-" if value is None else f"{value:.2f} m"


_DEFAULT, _OTHER = "The default recipe", "Other recipes"

_HEAD = """# Results

Written by `python scripts/results.py write` from [results](../results/README.md); what
is written by hand is in `results/notes.md`.

Every figure is of the stored policy, mean action, on a bank of standard throws (of the
version of the column *standard*, see [the standard throw](standard-throw.md)), with
95 % intervals for each seed (over throws, not over trainings); over seeds the
interquartile mean and, for the success at 3 s, the interquartile range. *Success* is
the share of episodes without contact or fall up to an age ("-": not measured);
survival is at most 10 s. Balls are *avoided* that land or fly on past the robot while
the episode lasts, of those and the ones that touch it. *Falls* are the share of
episodes ended by a fall within 3 s; the *way* is the mean displacement of the episodes
that last 3 s. The curves are the estimate of success while training, exploration on,
against the simulated time of all agents: interquartile mean and range over the seeds,
as far as all seeds go.
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
