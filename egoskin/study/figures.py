"""Figures of a study, as PNG and SVG, with units and colour-blind safe colours."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from egoskin.storage.files import write_figure
from egoskin.study.differences import Difference
from egoskin.study.findings import MARGIN, SAME, Judged
from egoskin.study.folder import Result
from egoskin.study.manifest import Manifest
from egoskin.study.metrics import Metric, frames_to, has_learnt
from egoskin.study.statistics import ALPHA, Effect, Table, contrast, spread

# Colours of Okabe and Ito, which are colour-blind safe, and markers.
_STYLES = {
    "localization": ("#0072B2", "o"),
    "proximity": ("#D55E00", "s"),
    "binary": ("#009E73", "^"),
    "closeness": ("#CC79A7", "D"),
}
_OTHERS = ("#E69F00", "#56B4E9", "#CC79A7", "#0072B2", "#D55E00", "#009E73")
# Line styles of the first, second, ... cells that have the same of these colours.
_LINES = ("-", "--", ":", "-.")
_BLIND = "#555555"
# Label and colour of robots without a skin, by coverage.
_UNSKINNED = {"none": ("blind", _BLIND), "oracle": ("oracle", "#000000")}
# Largest change of a line by leaving out points [pixels].
_SIMPLIFY = 0.3
# Factor between the ranges at which two signals of the same range are drawn.
_SHIFT = 1.04
_VERDICTS = {"confirmed": "#0072B2", "refuted": "#D55E00", "undecided": "#888888"}
_GEOMETRIES = {
    ("field", "none"): "field",
    ("ray", "none"): "ray, all beams",
    ("ray", "min"): "ray, closest beam",
}
RAYS = tuple(name for (coverage, _), name in _GEOMETRIES.items() if coverage == "ray")
"""Names of the geometries of rays, that of all beams first."""
# Fields that place a cell in the paper's grid.
_GRID = {f"env.sensor.{name}" for name in ("coverage", "signal", "range", "reduce")}


@dataclass(frozen=True)
class Place:
    """Position of a cell in the paper's grid."""

    geometry: str
    """Coverage and, for rays, the reduction of their beams."""
    signal: str
    """Signal."""
    range: float
    """Range [m]."""


def places(manifest: Manifest) -> dict[str, Place]:
    """Return the positions of the cells that differ only in the paper's fields.

    Localization is the same with all beams and with the closest beam: one cell serves
    for both.
    """
    found = {}
    for cell in manifest.cells:
        sensor = cell.config.env.sensor
        key = (sensor.coverage, sensor.reduce)
        if set(manifest.overrides(cell)) <= _GRID and key in _GEOMETRIES:
            place = Place(_GEOMETRIES[key], sensor.signal, sensor.range)
            found[cell.name] = place
    return found


def _geometry(name: str, grid: Mapping[str, Place]) -> dict[tuple[str, float], str]:
    """Return the cells of a geometry by signal and range."""
    return {
        (place.signal, place.range): cell
        for cell, place in grid.items()
        if place.geometry == name
        or (place.signal == "localization" and {place.geometry, name} <= set(RAYS))
    }


def _unskinned(manifest: Manifest) -> dict[str, tuple[str, str]]:
    """Return label and colour of the cells without a skin, by name.

    Only of those that differ only in the paper's fields.
    """
    return {
        cell.name: style
        for coverage, style in _UNSKINNED.items()
        for cell in manifest.cells
        if cell.config.env.sensor.coverage == coverage
        and set(manifest.overrides(cell)) <= _GRID
    }


def save(figure: Figure, folder: Path, name: str) -> None:
    """Write a figure as PNG and SVG; equal figures give equal bytes."""
    with mpl.rc_context({"svg.hashsalt": name, "svg.fonttype": "path"}):
        png, svg = folder / f"{name}.png", folder / f"{name}.svg"
        write_figure(png, figure, dpi=130, metadata={"Software": None})
        write_figure(svg, figure, metadata={"Date": None})


def _plain(axes: Axes) -> None:
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(axis="y", linewidth=0.4, alpha=0.5)


def success_by_range(
    manifest: Manifest, table: Table, seen: Sequence[Mapping[str, Any]] = ()
) -> Figure | None:
    """Draw the paper's figure, success against range; return None without its cells.

    One line per signal and one panel per geometry: interquartile mean (hollow: one
    seed), interquartile range as a bar, and each seed as a dot. Signals are shifted by
    a few per cent of the range, to be told apart. Below it: the warning time.

    Args:
        manifest: The study.
        table: Success at 3 s [%].
        seen: Cells of a report of `egoskin.evaluation.visibility`; empty: without the
            warning time.
    """
    grid = on_axis(manifest, table)
    names = [
        n for n in _GEOMETRIES.values() if n in {p.geometry for p in grid.values()}
    ]
    if not names:
        return None
    below = [_warnings(name, seen) for name in names]
    height, rows = (6.0, (5, 3)) if any(below) else (4.0, (1,))
    figure = Figure(figsize=(1.2 + 3.5 * len(names), height), layout="constrained")
    panels, *lower = figure.subplots(
        len(rows),
        len(names),
        sharex="col",
        sharey="row",
        squeeze=False,
        height_ratios=rows,
    )
    for axes, name in zip(panels, names, strict=True):
        cells = _geometry(name, grid)
        for number, (signal, style) in enumerate(_STYLES.items()):
            by_range = {
                r: list(table[cells[s, r]].values())
                for s, r in sorted(cells)
                if s == signal
            }
            if by_range:
                _draw_signal(axes, by_range, style, _SHIFT ** (number - 1), signal)
        for cell, (label, colour) in _unskinned(manifest).items():
            if table.get(cell):
                own = spread(list(table[cell].values()))
                axes.axhline(own.iqm, color=colour, linestyle="--", label=label)
                axes.axhspan(own.low, own.high, color=colour, alpha=0.15, linewidth=0)
        ticks = sorted({p.range for p in grid.values()}.union(*below))
        axes.set_xscale("log")
        axes.set_xticks(ticks, [f"{t:g}" for t in ticks], minor=False)
        axes.xaxis.minorticks_off()
        axes.set(title=name, ylim=(0, 100), xlim=(ticks[0] / 1.15, ticks[-1] * 1.15))
        _plain(axes)
    panels[0].set_ylabel("success: untouched for 3 s [%]")
    for row in lower:
        for axes, times in zip(row, below, strict=True):
            _draw_warnings(axes, times)
        row[0].set_ylabel("warning time [ms]")
    for axes in (lower or [panels])[-1]:
        axes.set_xlabel("detection range [m]")
    _legend_above(figure, panels)
    return figure


def on_axis(manifest: Manifest, table: Table) -> dict[str, Place]:
    """Return the positions of the cells of `success_by_range` that have values.

    Its axis is logarithmic and finite.
    """
    return {
        name: place
        for name, place in places(manifest).items()
        if table.get(name) and math.isfinite(place.range)
    }


def metric_by_cell(
    manifest: Manifest, metric: Metric, table: Table, found: Sequence[Difference]
) -> Figure | None:
    """Draw a metric of each cell and its difference to the first; None for one cell.

    Args:
        manifest: The study.
        metric: The metric.
        table: Its values.
        found: The differences; cells without one have only their values.
    """
    names = [cell.name for cell in manifest.cells if table.get(cell.name)]
    if len(names) < 2:
        return None
    labels = ["\n".join(textwrap.wrap(name, 40)) for name in names]
    lines = sum(label.count("\n") + 1 for label in labels)
    figure = Figure(figsize=(10.5, 0.8 + 0.3 * lines), layout="constrained")
    left, right = figure.subplots(1, 2, sharey=True)
    for y, name in enumerate(names):
        values = list(table[name].values())
        own, colour = spread(values), _STYLES["localization"][0]
        whole: dict[str, Any] = {"clip_on": False, "zorder": 3, "color": colour}
        if own.seeds == 1:
            left.plot(own.iqm, y, "o", mfc="white", **whole)
        else:
            left.hlines(y, own.low, own.high, color=colour, linewidth=6, alpha=0.4)
            left.plot(own.iqm, y, "o", **whole)
            left.plot(values, [y] * own.seeds, ".k", markersize=3, clip_on=False)
    for each in found:
        differs = each.effect.error > 0 and each.p_value <= ALPHA
        colour = _VERDICTS["refuted" if differs else "undecided"]
        _draw_effect(right, names.index(each.cell), each.effect, colour)
    right.axvline(0, color="black", linewidth=0.8)
    left.set_xlabel(f"{metric.label} [{metric.unit}]")
    left.set_xlim(*((0, 100) if metric.unit == "%" else (0, None)))
    right.set_xlabel(f"difference to {labels[0]} [{metric.difference_unit}]")
    left.set_yticks(range(len(names)), labels, fontsize=8)
    left.set_ylim(len(names) - 0.4, -0.6)
    for axes in (left, right):
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(axis="x", linewidth=0.4, alpha=0.5)
    right.tick_params(axis="y", length=0)
    return figure


def _draw_signal(
    axes: Axes,
    by_range: Mapping[float, Sequence[float]],
    style: tuple[str, str],
    shift: float,
    label: str,
) -> None:
    """Draw the success of a signal against range, from the values of its seeds."""
    colour, mark = style
    x = [reach * shift for reach in by_range]
    all_seeds = [spread(values) for values in by_range.values()]
    mean = [s.iqm for s in all_seeds]
    # Not cut at the axis at 0.
    whole: dict[str, Any] = {"clip_on": False, "zorder": 3}
    line = {"color": colour, "label": label, "linewidth": 2}
    axes.plot(x, mean, marker=mark, **line, **whole)
    for at, own, values in zip(x, all_seeds, by_range.values(), strict=True):
        if own.seeds == 1:
            axes.plot(at, own.iqm, mark, color=colour, mfc="white", **whole)
        else:
            axes.vlines(at, own.low, own.high, color=colour, linewidth=6, alpha=0.4)
            dot = {"color": "black", "markersize": 3}
            axes.plot([at] * own.seeds, values, ".", **dot, **whole)


def _warnings(
    geometry: str, seen: Sequence[Mapping[str, Any]]
) -> dict[float, tuple[float, float, float]]:
    """Return 5 %, 50 % and 95 % of the warning times of a geometry [ms], by range."""
    (coverage,) = {c for (c, _), name in _GEOMETRIES.items() if name == geometry}
    return {
        row["range"]: tuple(1e3 * row["warning"][k] for k in ("5%", "median", "95%"))
        for row in sorted(seen, key=lambda row: row["range"])
        if row["coverage"] == coverage and row["warning"]["hits"]
    }


def _draw_warnings(
    axes: Axes, times: Mapping[float, tuple[float, float, float]]
) -> None:
    low, median, high = np.array(list(times.values())).reshape(-1, 3).T
    axes.plot(list(times), median, ".-", color=_BLIND)
    axes.fill_between(list(times), low, high, color=_BLIND, alpha=0.18, linewidth=0)
    axes.set_ylim(bottom=0)
    _plain(axes)


def _legend_above(figure: Figure, panels: Iterable[Axes]) -> None:
    """Draw one legend for all panels, signals first."""
    handles: dict[str, Any] = {}
    for axes in panels:
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            handles.setdefault(label, handle)
    labels = [
        *(s for s in _STYLES if s in handles),
        *(h for h in handles if h not in _STYLES),
    ]
    figure.legend(
        [handles[label] for label in labels],
        labels,
        loc="outside upper center",
        # An entry is up to 1.5 inches wide.
        ncols=min(len(handles), 5, int(figure.get_figwidth() / 1.5)),
        frameon=False,
        fontsize=9,
    )


def learning_curves(manifest: Manifest, results: Sequence[Result]) -> Figure | None:
    """Draw success in training against frames: each seed thin, their mean thick.

    Rows are geometries, columns are ranges; all other cells share a panel in an extra
    row.
    """
    by_cell: dict[str, list[Result]] = {}
    for result in results:
        if len(result.stored.frames):
            by_cell.setdefault(result.run.cell.name, []).append(result)
    if not by_cell:
        return None
    grid = {k: v for k, v in places(manifest).items() if k in by_cell}
    bare = {cell: colour for cell, (_, colour) in _unskinned(manifest).items()}
    others = [name for name in by_cell if name not in grid and name not in bare]
    lines = {
        name: _LINES[i // len(_OTHERS) % len(_LINES)] for i, name in enumerate(others)
    }
    rows = [n for n in _GEOMETRIES.values() if n in {p.geometry for p in grid.values()}]
    ranges = sorted({p.range for p in grid.values()})
    panels: list[list[tuple[str, dict[str, str]]]] = [
        [
            (
                f"{row}, {reach:g} m",
                {
                    cell: _STYLES[signal][0]
                    for (signal, r), cell in _geometry(row, grid).items()
                    if r == reach
                },
            )
            for reach in ranges
        ]
        for row in rows
    ]
    if others or not panels:
        colours = {n: _OTHERS[i % len(_OTHERS)] for i, n in enumerate(others)}
        panels.append([("other cells" if panels else "all cells", colours)])
    width = max(map(len, panels))
    figure = Figure(
        figsize=(1.0 + 3.0 * max(width, 2), 0.6 + 2.3 * len(panels)),
        layout="constrained",
    )
    axes_grid = figure.subplots(
        len(panels), width, sharex=True, sharey=True, squeeze=False
    )
    for axes, panel in zip(
        axes_grid.flat,
        (p for row in panels for p in row + [None] * (width - len(row))),
        strict=True,
    ):
        if panel is None:
            axes.set_visible(False)
            continue
        title, cells = panel
        for name, colour in {**cells, **bare}.items():
            if name in by_cell:
                label = grid[name].signal if name in grid else name
                _draw_curves(axes, by_cell[name], colour, lines.get(name, "-"), label)
        axes.set_title(title, fontsize=10)
        axes.set_ylim(0, 100)
        _plain(axes)
    for column in axes_grid.T:
        # Shared axes have their numbers in the last row, which may be hidden here.
        lowest = [axes for axes in column if axes.get_visible()][-1]
        lowest.tick_params(labelbottom=True)
    _legend_above(figure, axes_grid.flat)
    figure.supxlabel("environment steps [millions]", fontsize=10)
    figure.supylabel("success at 3 s in training [%]", fontsize=10)
    return figure


@mpl.rc_context({"path.simplify_threshold": _SIMPLIFY})
def _draw_curves(
    axes: Axes, results: Sequence[Result], colour: str, line: str, label: str
) -> None:
    """Draw the learning curves of a cell."""
    first = max(r.stored.frames[0] for r in results)
    last = min(r.stored.frames[-1] for r in results)
    for result in results if len(results) > 1 else ():
        frames, success = result.stored.frames, 100 * result.stored.success
        axes.plot(frames / 1e6, success, line, color=colour, linewidth=0.6, alpha=0.6)
    x = np.array([f for f in results[0].stored.frames if first <= f <= last])
    if len(x):
        mean = np.mean(
            [np.interp(x, r.stored.frames, r.stored.success) for r in results], 0
        )
        axes.plot(x / 1e6, 100 * mean, line, color=colour, linewidth=2, label=label)


def _draw_effect(axes: Axes, y: float, effect: Effect, colour: str) -> None:
    """Draw an estimate with its 90 % (thick) and 95 % (thin) interval."""
    if effect.error > 0:
        for level, width in ((0.95, 1.0), (0.9, 3.0)):
            axes.plot(effect.interval(level), [y, y], color=colour, linewidth=width)
    face = colour if effect.error > 0 else "white"
    axes.plot(effect.mean, y, "o", color=colour, markerfacecolor=face, markersize=5)
    axes.text(
        1.01,
        y,
        f"n = {effect.seeds}",
        transform=axes.get_yaxis_transform(),
        fontsize=7,
        va="center",
    )


def forest(judged: Sequence[Judged]) -> Figure:
    """Draw the claimed region and the estimated effect of each claim."""
    rows = sum(len(j.claims) + 1 for j in judged)
    figure = Figure(figsize=(10.5, 0.8 + 0.24 * rows), layout="constrained")
    axes = figure.subplots()
    y, ticks, labels = 0.0, [], []
    for each in judged:
        colour = _VERDICTS[each.verdict]
        mark = " (stand-in)" * bool(each.finding.stand_in)
        title = f"{each.finding.label}  {each.finding.text}{mark}: {each.verdict}"
        axes.text(
            *(-99, y, title),
            fontsize=8.5,
            weight="bold",
            color=colour,
            va="center",
            # Above the line at 0.
            bbox={"facecolor": "white", "edgecolor": "none", "pad": 1.0},
        )
        y += 1
        for claim in each.claims:
            low, high = np.clip(
                [claim.claim.region.low, claim.claim.region.high], -100, 100
            )
            axes.barh(y, high - low, left=low, height=0.9, color="#E9E3B4", linewidth=0)
            if claim.effect is None:
                text = " a cell has no run"
                axes.text(0, y, text, fontsize=7, color="#888888", va="center")
            else:
                _draw_effect(axes, y, claim.effect, colour)
            ticks.append(y)
            labels.append(claim.claim.name)
            y += 1
    axes.axvline(0, color="black", linewidth=0.8)
    axes.set_yticks(ticks, labels, fontsize=7)
    axes.set_xlim(-100, 100)
    axes.set_ylim(y - 0.3, -0.7)
    axes.set_xlabel("effect [percentage points]")
    axes.spines[["top", "right", "left"]].set_visible(False)
    axes.tick_params(axis="y", length=0)
    return figure


def equivalence(manifest: Manifest, table: Table) -> Figure | None:
    """Draw which signals of a geometry and range are equivalent; None without pairs.

    A pair is equivalent if its 90 % interval lies within the margin, and different if
    its 95 % interval does not contain 0.
    """
    grid = {k: v for k, v in places(manifest).items() if table.get(k)}
    pairs = []
    for name in _GEOMETRIES.values():
        cells = _geometry(name, grid)
        for one, other in (
            ("proximity", "localization"),
            ("binary", "localization"),
            ("binary", "proximity"),
        ):
            for reach in sorted({r for _, r in cells}):
                if (one, reach) in cells and (other, reach) in cells:
                    weights = {cells[one, reach]: 1.0, cells[other, reach]: -1.0}
                    effect = contrast(weights, table)
                    assert effect is not None
                    pairs.append((f"{name}, {reach:g} m: {one} - {other}", effect))
    if not pairs:
        return None
    figure = Figure(figsize=(9.5, 1.3 + 0.25 * len(pairs)), layout="constrained")
    axes = figure.subplots()
    axes.axvspan(-MARGIN, MARGIN, color="#E9E3B4", linewidth=0)
    axes.axvline(0, color="black", linewidth=0.8)
    kinds = {
        "equivalent within 5 points": "#0072B2",
        "different": "#D55E00",
        "undecided": "#888888",
    }
    for y, (_, effect) in enumerate(pairs):
        low, high = effect.interval()
        kind = "undecided"
        if SAME.p_inside(effect) <= ALPHA:
            kind = "equivalent within 5 points"
        elif effect.error > 0 and (low > 0 or high < 0):
            kind = "different"
        _draw_effect(axes, y, effect, kinds[kind])
    for kind, colour in kinds.items():
        axes.plot([], [], "o-", color=colour, label=kind, markersize=5)
    figure.legend(loc="outside upper center", ncols=3, frameon=False, fontsize=9)
    axes.set_yticks(range(len(pairs)), [name for name, _ in pairs], fontsize=8)
    axes.set_ylim(len(pairs) - 0.4, -0.6)
    reach = max(
        [abs(e.mean) for _, e in pairs]
        + [min(max(map(abs, e.interval())), 100) for _, e in pairs if e.error > 0]
    )
    axes.set_xlim(-1.1 * reach - MARGIN, 1.1 * reach + MARGIN)
    axes.set_xlabel("difference in success at 3 s [percentage points]")
    axes.spines[["top", "right", "left"]].set_visible(False)
    axes.tick_params(axis="y", length=0)
    return figure


def sample_efficiency(manifest: Manifest, results: Sequence[Result]) -> Figure | None:
    """Draw the frames to 50 % and 90 % of a run's final success, by cell and seed."""
    grid = places(manifest)
    rows: list[tuple[str, str, list[float], list[float], list[float]]] = []
    for cell in manifest.cells:
        own = [r for r in results if r.run.cell == cell]
        half, most = ([frames_to(r, s) / 1e6 for r in own] for s in (0.5, 0.9))
        if own:
            signal = grid[cell.name].signal if cell.name in grid else ""
            colour = _STYLES.get(signal, (_BLIND, ""))[0]
            # Runs that have not learnt are drawn at their end.
            lost = [r.run.end / 1e6 for r in own if not has_learnt(r)]
            rows.append((cell.name, colour, half, most, lost))
    if not rows:
        return None
    rows.sort(key=lambda row: spread(row[3]).iqm)
    figure = Figure(figsize=(8.5, 1.2 + 0.26 * len(rows)), layout="constrained")
    axes = figure.subplots()
    for y, (_, colour, half, most, lost) in enumerate(rows):
        axes.plot(lost, [y] * len(lost), "x", color=colour, markersize=7)
        if len(lost) == len(most):
            continue
        ends = [spread(half).iqm, spread(most).iqm]
        axes.plot(ends, [y, y], color=colour, linewidth=2)
        axes.plot(ends[0], y, "o", color=colour, markerfacecolor="white", markersize=6)
        axes.plot(ends[1], y, "o", color=colour, markersize=6)
        axes.plot(most, [y] * len(most), "|", color=colour, markersize=9)
    for signal, (colour, _) in _STYLES.items():
        if colour in {row[1] for row in rows}:
            axes.plot([], [], "o-", color=colour, label=signal)
    axes.plot([], [], "o", color="black", markerfacecolor="white", label="50 %")
    axes.plot([], [], "o", color="black", label="90 % (bars: seeds)")
    if any(row[4] for row in rows):
        axes.plot([], [], "x", color="black", label="not learnt (< 5 %)")
    figure.legend(loc="outside upper center", ncols=3, frameon=False, fontsize=9)
    axes.set_yticks(range(len(rows)), [row[0] for row in rows], fontsize=8)
    axes.set_ylim(len(rows) - 0.4, -0.6)
    axes.set_xlim(left=0)
    axes.set_xlabel("environment steps to 50 and 90 % of final success [millions]")
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(axis="x", linewidth=0.4, alpha=0.5)
    return figure
