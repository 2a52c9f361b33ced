"""Coverage: the part of space that one sensor sees.

There are two kinds, a field around the sensor and a grid of beams, computed by the
transforms in `egoskin.sensors.field` and `egoskin.sensors.ray`.
"""

from __future__ import annotations

import math
from collections.abc import Sized
from dataclasses import dataclass
from numbers import Integral
from typing import Annotated, ClassVar, Literal

import numpy as np

from egoskin.bounds import Interval, check_bounds


@dataclass(frozen=True, kw_only=True)
class Field:
    """Distance to the closest point of an object, in any direction or within a cone."""

    half_angle_deg: Annotated[float, Interval(gt=0, le=180)] = 180.0
    """Angle from the normal within which the closest point must lie [deg]: 180 is the
    full sphere, 90 the outer hemisphere, less a cone."""

    slant: ClassVar[float] = 1.0
    """Largest distance that a sensor can see, as a multiple of its range."""

    def __post_init__(self) -> None:
        """Raise ValueError for an angle out of bounds."""
        check_bounds(self)


@dataclass(frozen=True, kw_only=True)
class Ray:
    """A grid of beams in a square pyramid around the normal; each reads its first hit.

    The defaults are the paper's, and those of the VL53L5CX: 8 x 8 zones, 63 degrees
    corner to corner. A beam runs through the centre of its zone.
    """

    grid: Annotated[tuple[int, int], Interval(le=1024)] = (8, 8)
    """Zones along the sensor's y and x: (rows, columns)."""
    fov_deg: Annotated[float, Interval(gt=0, lt=180)] = 63.0
    """Diagonal field of view [deg], corner to corner: 2 atan(sqrt(2) tan(a / 2)) for
    an angle a along each axis."""
    measure: Literal["beam", "depth"] = "beam"
    """Distance along the beam, or its component along the normal."""

    def __post_init__(self) -> None:
        """Raise ValueError for invalid values."""
        check_bounds(self)
        pair = isinstance(self.grid, Sized) and len(self.grid) == 2
        if not pair or not all(map(_is_positive, self.grid)):
            raise ValueError(f"grid must be two positive integers, got {self.grid}")
        # NumPy integers cannot be written to JSON.
        object.__setattr__(self, "grid", tuple(map(int, self.grid)))

    @property
    def num_beams(self) -> int:
        """Number of readings of one sensor ``K``, one per zone."""
        return self.grid[0] * self.grid[1]

    @property
    def slant(self) -> float:
        """Largest distance that a sensor can see, as a multiple of its range.

        It exceeds 1 if depth is measured: the depth of a slanted beam is below its
        length.
        """
        return 1 / self.directions()[:, 2].min() if self.measure == "depth" else 1.0

    @property
    def half_extent(self) -> float:
        """Tangent of the half angle along each axis."""
        # A square pyramid: corner at tan(h), so sqrt(2) half_extent = tan(h).
        return math.tan(math.radians(self.fov_deg) / 2) / math.sqrt(2)

    def directions(self) -> np.ndarray:
        """Return unit beam directions in the sensor frame, ``[K, 3]``.

        Zones are ordered row by row, y and within a row x from negative to positive.
        """
        y, x = (self.half_extent * ((2 * np.arange(n) + 1) / n - 1) for n in self.grid)
        y, x = np.meshgrid(y, x, indexing="ij")
        beams = np.stack((x, y, np.ones_like(x)), -1).reshape(-1, 3)
        return beams / np.linalg.norm(beams, axis=-1, keepdims=True)


Coverage = Field | Ray
"""Coverage of one sensor."""


def _is_positive(number: object) -> bool:
    """Whether a value is a positive integer, NumPy's included."""
    return isinstance(number, Integral) and int(number) > 0


KINDS: dict[str, type[Field] | type[Ray]] = {"field": Field, "ray": Ray}
"""Kinds of coverage by the name used in configurations and skin files."""
