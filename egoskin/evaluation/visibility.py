"""Visibility of a skin, without training: directions, surface, warning time.

A *cell* is a coverage with a range, as in an ablation table. The balls, and when they
count as seen, are defined in `egoskin.evaluation.approaches`.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch
from torch import Tensor

from egoskin.envs.throws import QUARTERS, ThrowConfig, quarter_of
from egoskin.evaluation.approaches import (
    THROW_STEP,
    Progress,
    StandingRobot,
    Trace,
    direction_grid,
    direction_paths,
    farthest,
    pipelines,
    surface_paths,
    throw_paths,
    trace,
    unit_vectors,
)
from egoskin.rng import check_seed
from egoskin.robots.config import RobotConfig
from egoskin.sensors import Skin
from egoskin.sensors.config import SensorConfig
from egoskin.shapes import Sphere

CLEARANCES = (0.05, 0.1, 0.2, 0.5, 1.0, 2.0)
"""Clearances for which the share of directions seen by then is reported [m]."""
BANDS = (0.0, 0.8, 1.2, 1.6, math.inf)
"""Bounds of the bands of contact height above ground [m], from legs to head."""
# Cells see alike if their warnings differ for a smaller share of hits than this.
_ALIKE = 0.05


@dataclass(frozen=True, kw_only=True)
class Cell:
    """A coverage with a range."""

    coverage: str
    """Name of the coverage."""
    range: float
    """Detection range [m]; sensors with a range of their own keep it."""

    def __str__(self) -> str:
        """Name for tables and pictures."""
        return f"{self.coverage} {self.range:g} m"


@dataclass(frozen=True, kw_only=True, eq=False)
class Analysis:
    """Visibility of a skin, for every cell ``C``."""

    cells: tuple[Cell, ...]
    """Coverages and ranges."""
    directions: Trace
    """Straight approaches to the base, in the order of `direction_grid`."""
    surface: Trace
    """Straight approaches along normals of the body's surface."""
    surface_link: tuple[str, ...]
    """Link of each approach in `surface`."""
    throws: Trace
    """Throws."""
    throw_azimuth: Tensor
    """Azimuth that each throw comes from, relative to the heading [rad], ``[n]``."""
    contact_height: Tensor
    """Height of the ball's centre at contact [m], ``[n]``."""
    control_period: float
    """Time between two actions of a policy [s]."""

    @cached_property
    def warning(self) -> Tensor:
        """Time from the first detection to the contact [s], ``[C, hits]``."""
        steps = self.throws.contact - self.throws.first_seen
        return THROW_STEP * steps[:, self.throws.touches].double()

    def comes(self, cell: int) -> Tensor:
        """Return the map's directions from which a ball can come, ``[n]`` bool.

        The ball must be above the floor from the cell's range until contact.
        """
        return self.directions.runway >= self.cells[cell].range

    def clearance_map(self, cell: int) -> np.ndarray:
        """Return the clearance at which a ball is first seen [m], ``[E, A]``.

        0 if never seen, NaN where no ball can come from.
        """
        return _on_grid(self.directions.clearance[cell], self.comes(cell))

    @property
    def reached(self) -> Tensor:
        """Whether a ball can reach the surface point along its normal, ``[n]`` bool."""
        # Rounding may put the contact a step before the last.
        last = self.surface.gap.shape[1] - 1
        return self.surface.touches & (self.surface.contact >= last - 1)

    def differing_share(self) -> np.ndarray:
        """Return the share of hits whose warnings differ by a control step, ``[C, C]``.

        Cells that (almost) never differ give a policy the same time to act; they can
        then differ only in the information that the signal holds about the ball.
        """
        warning = self.warning
        apart = (warning[:, None] - warning).abs() > self.control_period
        return apart.double().mean(-1).numpy()

    def blind_cone(self, cell: int) -> dict[str, float]:
        """Return the widest cone around a blind direction without a seen one [deg].

        It may contain directions from which no ball can come.
        """
        azimuth, elevation = (angle.ravel() for angle in direction_grid())
        vectors = unit_vectors(azimuth, elevation)
        comes, detected = self.comes(cell), self.directions.seen[cell]
        seen = (comes & detected).numpy()
        blind = (comes & ~detected).nonzero()[:, 0].numpy()
        if not len(blind):
            return {"half_angle": 0.0}
        nearest = (vectors[blind] @ vectors[seen].T).max(-1, initial=-1.0)
        widest = int(nearest.argmin())
        return {
            "half_angle": math.degrees(math.acos(nearest[widest])),
            "azimuth": math.degrees(azimuth[blind[widest]]),
            "elevation": math.degrees(elevation[blind[widest]]),
        }

    def report(self) -> dict[str, Any]:
        """Return all results as JSON values (shares in [0, 1], SI units).

        None stands for a share or a time of an empty set.
        """
        hits = int(self.throws.touches.sum())
        return {
            "throws": len(self.throws.contact),
            "hits": hits,
            "control_period": self.control_period,
            "cells": [self._cell(i) for i in range(len(self.cells))],
            "differing_share": self.differing_share().tolist() if hits else None,
        }

    def _cell(self, i: int) -> dict[str, Any]:
        cell, surface = self.cells[i], self.surface
        unseen, reached = ~surface.seen[i], self.reached
        links = np.array(self.surface_link)
        return {
            "coverage": cell.coverage,
            "range": cell.range,
            "directions_seen": self._solid_angle_seen(i, 0.0),
            "directions_seen_by_clearance": {
                f"{clearance:g}": self._solid_angle_seen(i, clearance)
                for clearance in CLEARANCES
                if clearance < cell.range
            },
            "widest_blind_cone_deg": self.blind_cone(i),
            "surface_blind": _share(unseen, reached),
            "surface_blind_by_link": {
                name: _share(unseen, reached & torch.from_numpy(links == name))
                for name in sorted(set(self.surface_link))
            },
            **self._warnings(i),
            "sensors_at_once": self._sensors_at_once(i),
        }

    def _solid_angle_seen(self, i: int, clearance: float) -> float | None:
        """Return the share of directions in which a ball is seen by a clearance [m].

        Only directions of `comes` count; the longer the range, the fewer stay above
        the floor.
        """
        comes = self.comes(i)
        # The solid angle of a map cell is proportional to cos(elevation).
        solid = torch.from_numpy(np.cos(direction_grid()[1])).reshape(-1)[comes]
        if not len(solid):
            return None
        seen = self.directions.seen[i] & (self.directions.clearance[i] >= clearance)
        return float((solid * seen[comes]).sum() / solid.sum())

    def _warnings(self, i: int) -> dict[str, Any]:
        touches = self.throws.touches
        warning, seen = self.warning[i], self.throws.seen[i, touches]

        def group(mask: Tensor) -> dict[str, Any]:
            if not mask.any():
                return {"hits": 0}
            levels = torch.tensor([0.05, 0.5, 0.95], dtype=warning.dtype)
            low, median, high = warning[mask].quantile(levels).tolist()
            return {
                "hits": int(mask.sum()),
                "seen": _share(seen, mask),
                "median": median,
                "5%": low,
                "95%": high,
            }

        quarter = quarter_of(self.throw_azimuth[touches])
        height = self.contact_height[touches]
        return {
            "warning": group(torch.ones_like(seen)),
            "warning_by_azimuth": {
                name: group(quarter == k) for k, name in enumerate(QUARTERS)
            },
            "warning_by_height": {
                f"{low:g}-{high:g}": group((height >= low) & (height < high))
                for low, high in itertools.pairwise(BANDS)
            },
        }

    def _sensors_at_once(self, i: int) -> dict[str, float | None]:
        """Return how many sensors detect a thrown ball at once, while any does.

        A single one locates the ball to within the sensor spacing; if all detect it,
        the ball can only be located from their distances.
        """
        count = self.throws.num_sensors[i][self.throws.touches]
        count = count[count > 0].float()
        if not len(count):
            return {"median": None, "one": None}
        one = (count == 1).double().mean()
        return {"median": float(count.median()), "one": float(one)}


def warning_texts(row: Mapping[str, Any]) -> tuple[str, list[str]]:
    """Return the warning of a cell of `Analysis.report` as text, "-" without hits.

    Args:
        row: The cell.

    Returns:
        Share of hits that are seen before, and 5 %, 50 % and 95 % of the times [ms].
    """
    warning = row["warning"]
    if not warning["hits"]:
        return "-", ["-"] * 3
    times = [f"{1e3 * warning[key]:.0f}" for key in ("5%", "median", "95%")]
    return f"{100 * warning['seen']:.1f} %", times


def alike(
    cells: Sequence[Cell], report: Mapping[str, Any]
) -> Iterator[tuple[Cell, Cell, float]]:
    """Yield the pairs of cells that see alike, and their `Analysis.differing_share`.

    Args:
        cells: The cells of an analysis.
        report: Its `Analysis.report`.
    """
    shares = report["differing_share"] or []
    for a, b in itertools.combinations(range(len(shares)), 2):
        if shares[a][b] < _ALIKE:
            yield cells[a], cells[b], shares[a][b]


def _on_grid(clearance: Tensor, comes: Tensor) -> np.ndarray:
    """Return clearances by direction, ``[E, A]``, NaN where no ball can come from."""
    values = torch.where(comes, clearance, torch.nan)
    return values.reshape(direction_grid()[0].shape).numpy()


def see_directions(
    robot: RobotConfig,
    skin: Skin,
    sensor: SensorConfig,
    ball: Sphere,
    *,
    progress: Progress = lambda what, share: None,
) -> np.ndarray:
    """Return the clearance at which a ball from each direction is first seen [m].

    This is `Analysis.clearance_map` for a single cell, in the default pose. A ball can
    come if it is above the floor from the longest range of all sensors on.

    Args:
        robot: The robot.
        skin: The sensors.
        sensor: Sensor configuration; only coverage, range and occlusion are used.
        ball: The ball.
        progress: Called with the name of the current task and its share done.

    Returns:
        Clearance in the order of `direction_grid`, ``[E, A]``; 0 if never seen, NaN
        where no ball can come from.

    Raises:
        ValueError: If the robot has no collision shapes or some that are no primitives,
            or a sensor has an infinite range.
    """
    body = StandingRobot(robot)
    cells = pipelines(robot, skin, {sensor.coverage: sensor}, sensor.range)
    # A range of the skin takes precedence.
    ranges = cells[sensor.coverage].skin.range
    _check_finite(ranges)
    paths = direction_paths(body, ball, farthest(cells))
    seen = trace(body, paths, skin, cells, [sensor.range], ball, progress=progress)
    longest = float(ranges.max())
    return _on_grid(seen.clearance[0], seen.runway >= longest)


def _check_finite(ranges: np.ndarray) -> None:
    """Raise ValueError if one of the sensors' ranges, ``[S]``, is infinite."""
    if np.isinf(ranges).any():
        raise ValueError(
            f"sensor {int(np.isinf(ranges).argmax())} of the skin has an infinite "
            "range: what it sees is only defined for a finite one"
        )


def _share(flags: Tensor, among: Tensor) -> float | None:
    """Return the share of true flags, None for an empty set (JSON has no NaN)."""
    return float(flags[among].double().mean()) if among.any() else None


def analyse(
    robot: RobotConfig,
    skin: Skin,
    sensors: Mapping[str, SensorConfig],
    ranges: Sequence[float],
    throws: ThrowConfig,
    *,
    num_throws: int = 2000,
    seed: int = 0,
    timestep: float = 1 / 120,
    control_period: float = 1 / 60,
    progress: Progress = lambda what, share: None,
) -> Analysis:
    """Return the visibility of balls that approach a standing robot.

    Args:
        robot: The robot.
        skin: The sensors.
        sensors: Sensor configurations by name; only coverage and occlusion are used.
        ranges: Ranges of sensors that have none of their own [m].
        throws: The throws, of spheres.
        num_throws: Number of throws.
        seed: Seed of the throws and of the points on the surface.
        timestep: Physics time step of the task [s].
        control_period: Time between two actions of a policy [s].
        progress: Called with the name of the current task and its share done.

    Raises:
        ValueError: If there is no coverage, range or throw, a range (also of the skin)
            is not positive and finite, one is repeated, the seed is invalid, the
            throws are not of spheres, the skin is on other links, or the robot has no
            collision shapes or some that are no primitives.
    """
    if not sensors or not ranges:
        raise ValueError("an analysis needs at least one coverage and one range")
    if len(set(ranges)) < len(ranges):
        raise ValueError(f"ranges must be distinct, got {list(ranges)}")
    if not all(0 < r < math.inf for r in ranges):
        raise ValueError(f"ranges must be positive and finite, got {list(ranges)}")
    _check_finite(skin.range)
    check_seed(seed)
    if num_throws < 1:
        raise ValueError(f"num_throws must be at least 1, got {num_throws}")
    body, ball = StandingRobot(robot), throws.balls[0]
    if not isinstance(ball, Sphere):
        raise ValueError(
            f"visibility is analysed for spheres, got shape={throws.shape}"
        )
    skin.check_links(robot.links, robot.name)
    cells = pipelines(robot, skin, sensors, max(ranges))
    far = farthest(cells)

    def follow(what: str, paths: Tensor) -> Trace:
        def show(name: str, share: float) -> None:
            progress(f"{what}, {name}", share)

        return trace(body, paths, skin, cells, ranges, ball, progress=show)

    directions = follow("directions", direction_paths(body, ball, far))
    paths, link = surface_paths(body, ball, far, seed)
    surface = follow("surface", paths)
    paths, azimuth = throw_paths(body, throws, num_throws, seed, timestep)
    thrown = follow("throws", paths)
    at_contact = thrown.contact.clamp(max=paths.shape[1] - 1)
    return Analysis(
        cells=tuple(Cell(coverage=c, range=r) for c in sensors for r in ranges),
        directions=directions,
        surface=surface,
        surface_link=tuple(robot.links[i] for i in link),
        throws=thrown,
        throw_azimuth=azimuth,
        contact_height=paths[torch.arange(num_throws), at_contact, 2],
        control_period=control_period,
    )
