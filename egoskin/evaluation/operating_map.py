"""Operating map: success against speed, interval, height and direction of throws.

Each property is varied alone, beyond its training range; speed and interval are also
varied together. Everything else is as in the task.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from tensordict.nn import TensorDictModuleBase
from torch import nn

from egoskin.envs.balls import PASSED_DISTANCE
from egoskin.envs.throws import ThrowConfig
from egoskin.evaluation.throw_set import Estimate, play_throws, summarize
from egoskin.make import EnvConfig
from egoskin.sensors import Skin

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Half width of the box aimed at when the height is fixed [m].
_HALF_WIDTH = 0.15
# Half width of the sector around each direction [deg].
_SECTOR = 22.5


@dataclass(frozen=True, kw_only=True)
class Point:
    """Results for throws that differ from the task's in one or two properties."""

    values: tuple[float, ...]
    """Values of these properties."""
    success: Estimate
    """Share of episodes without contact, see `throw_set.Evaluation`."""
    avoided: float | None
    """Balls avoided per ball that arrived, over all balls; None if none arrived."""


@dataclass(frozen=True, kw_only=True)
class Line:
    """Success against one or two properties of the throws."""

    names: tuple[str, ...]
    """Names of the properties, with units."""
    trained: tuple[tuple[float, float] | None, ...]
    """Training range of each property; None if there is none to show."""
    points: list[Point]
    """Points; the second property varies fastest."""


@dataclass(frozen=True)
class _Property:
    """A property of the throws."""

    name: str
    """Its name, with unit."""
    fields: Callable[[float], dict[str, Any]]
    """Function that returns the fields of `ThrowConfig` for a value."""
    trained: str | None = None
    """Field that holds the training range; None if there is none to show."""


_SPEED = _Property("speed of the ball [m/s]", lambda x: {"speed": (x, x)}, "speed")
_INTERVAL = _Property(
    "time between throws [s]", lambda x: {"interval": (x, x)}, "interval"
)
_HEIGHT = _Property(
    "height aimed at [m]",
    lambda x: {"aim": "box", "box_half_width": _HALF_WIDTH, "box_height": (x, x)},
)
_DIRECTION = _Property(
    "direction it comes from, left positive [deg]",
    lambda x: {"azimuth_deg": (x - _SECTOR, x + _SECTOR)},
)
# Values of the properties that are varied, alone or together.
_MAPS: tuple[dict[_Property, tuple[float, ...]], ...] = (
    {_SPEED: (2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 10.0, 12.0)},
    {_INTERVAL: (0.5, 0.75, 1.0, 1.25, 1.5, 2.0, 3.0)},
    {_HEIGHT: (0.3, 0.5, 0.7, 0.9, 1.1, 1.3, 1.5)},
    {_DIRECTION: (-180.0, -135.0, -90.0, -45.0, 0.0, 45.0, 90.0, 135.0)},
    {_SPEED: (3.0, 4.0, 6.0, 8.0, 10.0), _INTERVAL: (0.5, 1.0, 1.5, 2.0, 3.0)},
)


def check_map(config: EnvConfig) -> None:
    """Raise ValueError for an oracle actor, whose observation fixes the ball count."""
    if config.sensor.coverage == "oracle":
        raise ValueError(
            "an operating map may need more balls than the "
            f"{config.task.throws.num_balls} that an oracle observes: "
            "oracles are not supported"
        )


def _with_enough_balls(throws: ThrowConfig) -> ThrowConfig:
    """Return throws with enough balls that each has passed before its next throw."""
    # Distance to the base, and from there to where the ball counts as passed.
    way = math.hypot(throws.distance[1], throws.height[1]) + PASSED_DISTANCE
    number = math.ceil(way / throws.speed[0] / throws.interval[0])
    return dataclasses.replace(throws, num_balls=max(throws.num_balls, number))


def operating_map(
    policy: nn.Module | TensorDictModuleBase | None,
    config: EnvConfig,
    skin: Skin,
    *,
    throw_set: int,
    episodes: int,
    num_workers: int | None = None,
    mask: Sequence[str] = (),
    trained: ThrowConfig | None = None,
    on_point: Callable[[int, int], None] | None = None,
) -> list[Line]:
    """Return the results of a policy on throws within and beyond its training range.

    Args:
        policy: Writes ``action`` into a TensorDict; None is the zero action.
        config: Robot, task, sensors.
        skin: The skin.
        throw_set: Seed of the throws.
        episodes: Episodes per point.
        num_workers: Processes; the result does not depend on it.
        mask: Links (or shell patterns) whose sensors detect nothing, or
            `egoskin.sensors.MASK_ALL`.
        trained: Throws of the training, for `Line.trained`; None: those of ``config``.
        on_point: Called with (points done, total points).

    Returns:
        Success against speed, interval, height, direction, and speed with interval.

    Raises:
        ValueError: If the policy's observation depends on the number of balls.
    """
    check_map(config)
    trained = trained or config.task.throws
    # The last property varies fastest.
    grids = [list(itertools.product(*varied.values())) for varied in _MAPS]
    total, done = sum(map(len, grids)), 0
    lines = []
    for varied, grid in zip(_MAPS, grids, strict=True):
        points = []
        for values in grid:
            fields: dict[str, Any] = {}
            for what, value in zip(varied, values, strict=True):
                fields |= what.fields(value)
            throws = dataclasses.replace(config.task.throws, **fields)
            throws = _with_enough_balls(throws)
            task = dataclasses.replace(config.task, throws=throws)
            played = play_throws(
                policy,
                dataclasses.replace(config, task=task),
                skin,
                throw_set=throw_set,
                episodes=episodes,
                num_workers=num_workers,
                mask=mask,
            )
            arrived = float(played.arrived.sum())
            points.append(
                Point(
                    values=values,
                    success=summarize(played, played, task).success,
                    avoided=float(played.avoided.sum()) / arrived if arrived else None,
                )
            )
            done += 1
            if on_point is not None:
                on_point(done, total)
        lines.append(
            Line(
                names=tuple(what.name for what in varied),
                trained=tuple(
                    None if what.trained is None else getattr(trained, what.trained)
                    for what in varied
                ),
                points=points,
            )
        )
    return lines


def draw_map(lines: Sequence[Line], title: str, success_age_s: float) -> Figure:
    """Return the figure of an operating map; needs matplotlib.

    Args:
        lines: Result of `operating_map`.
        title: Title of the figure.
        success_age_s: Age at which the success counts [s].
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(13, 7.5), layout="constrained")
    figure.suptitle(title)
    axes = figure.subplots(2, 3).flatten()
    for axis, line in zip(axes, lines, strict=False):
        if len(line.names) == 1:
            _draw_line(axis, line, success_age_s)
        else:
            _draw_grid(axis, line)
    for axis in axes[len(lines) :]:
        axis.axis("off")
    handles, labels = axes[0].get_legend_handles_labels()
    axes[-1].legend(handles, labels, loc="center", frameon=False)
    return figure


def _draw_line(axis: Axes, line: Line, age: float) -> None:
    x = [point.values[0] for point in line.points]
    success = [point.success for point in line.points]
    if line.trained[0] is not None:
        axis.axvspan(*line.trained[0], color="0.92", label="trained on")
    axis.fill_between(
        x,
        [100 * s.low for s in success],
        [100 * s.high for s in success],
        color="#0072b2",
        alpha=0.2,
        lw=0,
        label="95 % interval",
    )
    axis.plot(
        x,
        [100 * s.mean for s in success],
        "o-",
        color="#0072b2",
        label=f"success (untouched for {age:g} s)",
    )
    axis.plot(
        x,
        [
            100 * p.avoided if p.avoided is not None else float("nan")
            for p in line.points
        ],
        "s--",
        color="#d55e00",
        label="balls avoided",
    )
    axis.set(xlabel=line.names[0], ylabel="[%]", ylim=(0, 100))
    axis.grid(alpha=0.3)


def _draw_grid(axis: Axes, line: Line) -> None:
    first, second = (sorted({p.values[i] for p in line.points}) for i in range(2))
    share: dict[Any, float] = {p.values: 100 * p.success.mean for p in line.points}
    values = [[share[a, b] for a in first] for b in second]
    axis.imshow(values, origin="lower", aspect="auto", cmap="viridis", vmin=0, vmax=100)
    for row, y in enumerate(values):
        for column, value in enumerate(y):
            colour = "white" if value < 60 else "black"
            axis.text(
                column, row, f"{value:.0f}", ha="center", va="center", color=colour
            )
    axis.set_xticks(range(len(first)), [f"{v:g}" for v in first])
    axis.set_yticks(range(len(second)), [f"{v:g}" for v in second])
    axis.set(xlabel=line.names[0], ylabel=line.names[1], title="success [%]")
