"""Coverage: which part of space one sensor sees, as data.

Two kinds: a field around the sensor, and a grid of beams. Transforms that compute
them are `egoskin.sensors.field` and `egoskin.sensors.ray`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from numbers import Integral
from typing import Annotated, ClassVar, Literal

import numpy as np

from egoskin.bounds import Interval, check_bounds


@dataclass(frozen=True, kw_only=True)
class Field:
    """The closest point of an object around the sensor, whatever its direction."""

    half_angle_deg: Annotated[float, Interval(gt=0, le=180)] = 180.0
    """Angle from the normal within which the closest point must lie [deg]: 180 all
    around, 90 the outer hemisphere, less a cone."""

    slant: ClassVar[float] = 1.0
    """How many times its range a sensor may see."""

    def __post_init__(self) -> None:
        """Raise ValueError for an angle that is no cone."""
        check_bounds(self)


@dataclass(frozen=True, kw_only=True)
class Ray:
    """A grid of beams through a square pyramid about the normal; each its first hit.

    The defaults are the VL53L5CX of the paper: 8 x 8 zones, 63 degrees corner to
    corner. A beam runs through the centre of its zone.
    """

    grid: Annotated[tuple[int, int], Interval(le=1024)] = (8, 8)
    """Zones along the sensor's y and x: (rows, columns)."""
    fov_deg: Annotated[float, Interval(gt=0, lt=180)] = 63.0
    """Full angle of the view from corner to corner [deg]; a view of an angle a along
    each axis has 2 atan(sqrt(2) tan(a / 2))."""
    measure: Literal["beam", "depth"] = "beam"
    """Distance along the beam, or its component along the normal."""

    def __post_init__(self) -> None:
        """Raise ValueError for no zones, a view that is no pyramid, unknown words."""
        check_bounds(self)
        if self.measure not in ("beam", "depth"):
            raise ValueError(f"measure must be beam or depth, got {self.measure!r}")
        if len(self.grid) != 2 or not all(map(_is_positive, self.grid)):
            raise ValueError(f"grid must be two positive integers, got {self.grid}")
        # NumPy's integers go into no JSON.
        object.__setattr__(self, "grid", tuple(map(int, self.grid)))

    @property
    def num_beams(self) -> int:
        """Readings of one sensor ``K``, one for each zone."""
        return self.grid[0] * self.grid[1]

    @property
    def slant(self) -> float:
        """How many times its range a sensor may see: slanted beams have less depth."""
        return 1 / self.directions()[:, 2].min() if self.measure == "depth" else 1.0

    @property
    def half_extent(self) -> float:
        """Tangent of the half angle along each axis."""
        # A square pyramid: corner at tan(h), so sqrt(2) half_extent = tan(h).
        return math.tan(math.radians(self.fov_deg) / 2) / math.sqrt(2)

    def directions(self) -> np.ndarray:
        """Return unit beam directions in the sensor frame, ``[K, 3]``.

        Zones go row by row, y and within a row x from negative to positive.
        """
        y, x = (self.half_extent * ((2 * np.arange(n) + 1) / n - 1) for n in self.grid)
        y, x = np.meshgrid(y, x, indexing="ij")
        beams = np.stack((x, y, np.ones_like(x)), -1).reshape(-1, 3)
        return beams / np.linalg.norm(beams, axis=-1, keepdims=True)


Coverage = Field | Ray
"""What one sensor sees."""


def _is_positive(number: object) -> bool:
    """Whether something is a positive integer, NumPy's too."""
    return isinstance(number, Integral) and int(number) > 0


KINDS: dict[str, type[Field] | type[Ray]] = {"field": Field, "ray": Ray}
"""Kinds of coverage by the name used in configurations and skin files."""
