"""Show what a skin sees, before any training: a picture, a table and JSON.

egoskin visibility --out visibility.png --json visibility.json
egoskin visibility --skin.path skin.json --coverages field ray --ranges 0.5 1
egoskin visibility --occlusion

A robot stands still in its default pose. Balls fly straight at its base from all
directions, straight at every part of its surface, and as thrown in the task. A ball is
seen from the first moment at which any sensor detects it. Cells (a coverage at a range)
that see alike leave a policy the same time to act: in an ablation they can differ only
by their signals.
"""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import tyro

try:
    from matplotlib import colormaps
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
except ImportError:
    print(
        "error: the picture needs matplotlib: `pip install 'egoskin[plot]'`",
        file=sys.stderr,
    )
    raise SystemExit(2) from None

from egoskin.envs.physics import PhysicsConfig
from egoskin.envs.throws import ThrowConfig
from egoskin.evaluation.visibility import Analysis, alike, analyse, warning_texts
from egoskin.progress import can_overwrite, counted, note
from egoskin.robots.own import find_robot
from egoskin.sensors import Field, Ray, Skin
from egoskin.sensors.config import SensorConfig, SkinConfig
from egoskin.storage.files import check_output, write_figure
from egoskin.storage.serialization import to_plain, write_json

PICTURE_SUFFIXES = (".png", ".jpg", ".svg", ".pdf")
BLIND, NOWHERE = "#c1272d", "#e6e6e6"


@dataclass(frozen=True, kw_only=True)
class VisibilityConfig:
    """Show what a skin sees, before any training: a picture, a table and JSON."""

    robot: str = "h1_2"
    """Name of the robot, or path of its folder, Python file, MJCF or URDF."""
    skin: SkinConfig = dataclasses.field(default_factory=SkinConfig)
    """Placement of the sensors; types and ranges in a skin file take precedence."""
    coverages: Annotated[
        tuple[Literal["field", "ray"], ...], tyro.conf.arg(metavar="{field,ray} ...")
    ] = ("field", "ray")
    """Coverages to compare."""
    ranges: tuple[float, ...] = (0.2, 0.5, 1.0, 2.0)
    """Ranges to compare [m]."""
    field: Field = dataclasses.field(default_factory=Field)
    """Field sensors."""
    ray: Ray = dataclasses.field(default_factory=Ray)
    """Ray sensors."""
    occlusion: bool = False
    """Whether the robot's own body hides what lies behind it."""
    throws: ThrowConfig = dataclasses.field(default_factory=ThrowConfig)
    """The balls (only spheres) and how they are thrown."""
    num_throws: int = 2000
    """Number of throws."""
    seed: int = 0
    """Seed of the throws and of the points on the surface."""
    out: Path = Path("visibility.png")
    """Picture to write, .png, .jpg, .svg or .pdf."""
    json: Path = Path("visibility.json")
    """JSON file to write all results to."""

    def __post_init__(self) -> None:
        """Raise ValueError for options without effect."""
        for name, default in (("field", Field()), ("ray", Ray())):
            if name not in self.coverages and getattr(self, name) != default:
                raise ValueError(
                    f"--{name} has no effect without {name} among --coverages"
                )
        for name in ("num_balls", "first_delay", "interval", "lead"):
            if getattr(self.throws, name) != getattr(ThrowConfig, name):
                raise ValueError(
                    f"--throws.{name} has no effect: each ball is thrown alone, at a "
                    "standing robot"
                )


def notes(skin: Skin) -> Iterator[str]:
    """Yield which cells see alike because the skin file sets what they differ in."""
    own = {"range": not np.isnan(skin.range).any(), "type": None not in skin.coverage}
    for what, option in (("range", "--ranges"), ("type", "--coverages")):
        if own[what]:
            yield f"{option} has no effect: the skin sets the {what} of each sensor"


def show_progress(what: str, share: float) -> None:
    """Show the progress of the current stage, on a terminal."""
    if can_overwrite(sys.stdout):
        # The line is cleared at the end.
        text = f"{what} {share:.0%}" if share < 1 else ""
        print(f"\r{text}\x1b[K", end="", flush=True)


def print_table(analysis: Analysis, report: dict[str, Any]) -> None:
    """Print a line for each cell, and which cells see alike."""
    print(
        f"{report['hits']} of {report['throws']} throws hit the standing robot\n"
        f"{'directions':>25}{'blind':>8}{'surface':>9}{'hits':>8}{'warning [ms]':>16}"
        f"{'sensors':>11}\n"
        f"{'cell':15}{'seen':>10}{'cone':>8}{'blind':>9}{'seen':>8}"
        f"{'5 %':>6}{'50 %':>6}{'95 %':>6}{'at once':>9}"
    )
    for cell, row in zip(analysis.cells, report["cells"], strict=True):
        shares = row["directions_seen"], row["surface_blind"]
        seen, blind = ("-" if x is None else f"{100 * x:.1f} %" for x in shares)
        hits, warning = warning_texts(row)
        cone = f"{row['widest_blind_cone_deg']['half_angle']:.0f} deg"
        times = "".join(f"{time:>6}" for time in warning)
        at_once = row["sensors_at_once"]["median"] or 0
        print(
            f"{cell!s:15s}{seen:>10}{cone:>8}{blind:>9}{hits:>8}{times}{at_once:9.0f}"
        )
    for one, other, share in alike(analysis.cells, report):
        print(
            f"{one} and {other} see the same: {share:.1%} of the warnings differ by "
            "more than a control step"
        )


def draw_map(axes: Axes, analysis: Analysis, cell: int, seen: float | None) -> Any:
    """Draw the world map of a cell; return its image, for the colour bar."""
    colours = colormaps["viridis"].with_extremes(bad=NOWHERE, under=BLIND)
    # Negative where nothing is seen before the contact.
    share = analysis.clearance_map(cell) / analysis.cells[cell].range
    share = np.where(share <= 0, -1.0, share)
    image = axes.imshow(
        share,
        origin="lower",
        extent=(-180, 180, -90, 90),
        cmap=colours,
        vmin=0,
        vmax=1,
        interpolation="nearest",
    )
    # From the robot's point of view: its left is on the left.
    axes.set_xlim(180, -180)
    axes.set_xticks([180, 90, 0, -90, -180], ["back", "left", "front", "right", "back"])
    axes.set_yticks([-90, -45, 0, 45, 90])
    axes.axhline(0, color="white", linewidth=0.5, alpha=0.6)
    axes.axvline(0, color="white", linewidth=0.5, alpha=0.6)
    axes.tick_params(labelsize=7, length=2)
    text = "no path" if seen is None else f"{seen:.1%} of directions seen"
    axes.set_title(f"{analysis.cells[cell]}: {text}", fontsize=9)
    axes.set_ylabel("elevation [deg]", fontsize=7)
    return image


def draw_warnings(axes: Axes, analysis: Analysis, ranges: int) -> None:
    """Draw the share of hits with at least a given warning time."""
    palette = colormaps["plasma"](np.linspace(0.0, 0.8, ranges))
    for cell, warning in enumerate(analysis.warning.numpy()):
        time = np.append(0.0, np.sort(warning))
        share = np.linspace(1.0, 0.0, len(time))
        style = ("-", "--", ":")[cell // ranges % 3]
        label = str(analysis.cells[cell])
        axes.step(1e3 * time, share, style, color=palette[cell % ranges], label=label)
    period = 1e3 * analysis.control_period
    axes.axvline(period, color="grey", linewidth=0.8)
    axes.text(period, 1.03, " 1 control step", fontsize=7, color="grey")
    axes.set(xlabel="warning before contact [ms]", ylabel="share of hits with at least")
    axes.set_xlim(left=0)
    axes.set_ylim(0, 1.1)
    axes.legend(fontsize=7, frameon=False, loc="upper right")
    axes.spines[["top", "right"]].set_visible(False)
    axes.set_title("Warning of thrown balls", fontsize=10)


def draw_table(
    axes: Axes, values: np.ndarray, rows: list[str], columns: list[str], title: str
) -> None:
    """Draw shares as a coloured table; NaN stays grey."""
    colours = colormaps["Reds"].with_extremes(bad=NOWHERE)
    axes.imshow(values, cmap=colours, vmin=0, vmax=1, aspect="auto")
    for (i, j), value in np.ndenumerate(values):
        if np.isfinite(value):
            colour = "white" if value > 0.6 else "black"
            text = f"{100 * value:.0f}"
            axes.text(j, i, text, ha="center", va="center", fontsize=6, color=colour)
    axes.set_xticks(range(len(columns)), columns, rotation=45, ha="right", fontsize=7)
    axes.set_yticks(range(len(rows)), rows, fontsize=6.5)
    axes.tick_params(length=0)
    axes.set_title(title, fontsize=10)


def draw(analysis: Analysis, report: dict[str, Any], title: str) -> Figure:
    """Return the picture: maps above, warnings and tables below."""
    names = list(dict.fromkeys(c.coverage for c in analysis.cells))
    ranges = len(analysis.cells) // len(names)
    figure = Figure(figsize=(16, 2.4 * len(names) + 5.6), layout="constrained")
    figure.suptitle(title, fontsize=12)
    heights = [2.2 * len(names), 5.0]
    above, below = figure.subfigures(2, 1, height_ratios=heights, squeeze=False).flat
    maps = above.subplots(len(names), ranges, squeeze=False)
    images = [
        draw_map(axes, analysis, cell, report["cells"][cell]["directions_seen"])
        for cell, axes in enumerate(maps.flat)
    ]
    bar = above.colorbar(images[0], ax=maps, extend="min", shrink=0.9, pad=0.01)
    bar.set_label(
        "clearance when first seen / range\n(red: never; grey: no path)", size=8
    )

    left, middle, right = below.subplots(1, 3, width_ratios=[1.3, 1.2, 1.0])
    draw_warnings(left, analysis, ranges)
    cells = [str(cell) for cell in analysis.cells]
    by_link = [row["surface_blind_by_link"] for row in report["cells"]]
    links = [name for name in by_link[0] if by_link[0][name] is not None]
    blind = np.array([[row[name] for row in by_link] for name in links], dtype=float)
    text = "Surface that a ball reaches unseen [%]"
    draw_table(middle, blind, links, cells, text)
    differs = analysis.differing_share()
    text = "Hits whose warning differs by > 1 control step [%]"
    draw_table(right, differs, cells, cells, text)
    return figure


def main(args: list[str]) -> None:
    """Run the command."""
    config = tyro.cli(VisibilityConfig, args=args, description=__doc__)
    # Check before the analysis, which takes minutes.
    check_output(config.out, "--out", PICTURE_SUFFIXES)
    check_output(config.json, "--json", (".json",))
    robot = find_robot(config.robot)
    skin = config.skin.build(robot)
    for text in notes(skin):
        note(f"note: {text}")
    physics = PhysicsConfig()
    own = {"field": {"field": config.field}, "ray": {"ray": config.ray}}
    analysis = analyse(
        robot,
        skin,
        {
            name: SensorConfig(coverage=name, occlusion=config.occlusion, **own[name])
            for name in config.coverages
        },
        sorted(config.ranges),
        config.throws,
        num_throws=config.num_throws,
        seed=config.seed,
        timestep=physics.timestep,
        control_period=1 / physics.control_hz,
        progress=show_progress,
    )
    report = analysis.report()
    print_table(analysis, report)
    content = {"config": to_plain(config), "sensors": len(skin), **report}
    write_json(config.json, content, allow_nan=False)
    verb = "sees" if len(skin) == 1 else "see"
    title = f"What {counted(len(skin), 'sensor')} on {robot.name} {verb}"
    if config.occlusion:
        title += ", occluded by its body"
    figure = draw(analysis, report, title)
    write_figure(config.out, figure, dpi=110)
    print(f"picture {config.out}, results {config.json}")
