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
    measure: Literal["surface", "centre"] = "surface"
    """Distance to the object's closest point, or to its centre."""

    slant: ClassVar[float] = 1.0
    """How many times its range a sensor may see."""

    def __post_init__(self) -> None:
        """Raise ValueError for an angle that is no cone, or an unknown measure."""
        check_bounds(self)
        _check_choice("measure", self.measure, ("surface", "centre"))


@dataclass(frozen=True, kw_only=True)
class Ray:
    """A grid of beams through a square pyramid about the normal; each its first hit.

    The defaults are the VL53L5CX of the paper: 8 x 8 zones, 63 degrees corner to
    corner.
    """

    grid: Annotated[tuple[int, int], Interval(le=1024)] = (8, 8)
    """Zones along the sensor's y and x: (rows, columns)."""
    fov_deg: Annotated[float, Interval(gt=0, lt=180)] = 63.0
    """Full angle of the field of view [deg]."""
    fov: Literal["diagonal", "axis"] = "diagonal"
    """Whether the angle is measured corner to corner or along each axis."""
    beams: Literal["centres", "edges"] = "centres"
    """Beams through the zones' centres, or spread from edge to edge of the view."""
    sub_beams: Annotated[int, Interval(le=64)] = 1
    """A zone reads the closest of this many squared beams, spread over it evenly."""
    measure: Literal["beam", "depth"] = "beam"
    """Distance along the beam, or its component along the normal."""

    def __post_init__(self) -> None:
        """Raise ValueError for no zones, a view that is no pyramid, unknown words."""
        check_bounds(self)
        _check_choice("fov", self.fov, ("diagonal", "axis"))
        _check_choice("beams", self.beams, ("centres", "edges"))
        _check_choice("measure", self.measure, ("beam", "depth"))
        if len(self.grid) != 2 or not all(map(_is_positive, self.grid)):
            raise ValueError(f"grid must be two positive integers, got {self.grid}")
        if not _is_positive(self.sub_beams):
            raise ValueError(
                f"sub_beams must be a positive integer, got {self.sub_beams}"
            )
        if self.beams == "edges" and (self.sub_beams > 1 or min(self.grid) < 2):
            raise ValueError(
                "beams='edges' needs a grid of at least 2 x 2 and sub_beams=1, got "
                f"grid {self.grid} and sub_beams {self.sub_beams}"
            )
        # NumPy's integers go into no JSON.
        object.__setattr__(self, "grid", tuple(map(int, self.grid)))
        object.__setattr__(self, "sub_beams", int(self.sub_beams))

    @property
    def num_beams(self) -> int:
        """Readings of one sensor ``K``, one for each zone."""
        return self.grid[0] * self.grid[1]

    @property
    def slant(self) -> float:
        """How many times its range a sensor may see: slanted beams have less depth."""
        return 1 / self.directions()[..., 2].min() if self.measure == "depth" else 1.0

    @property
    def half_extent(self) -> float:
        """Tangent of the half angle along each axis."""
        # A square pyramid: corner at tan(h), so sqrt(2) half_extent = tan(h).
        tangent = math.tan(math.radians(self.fov_deg) / 2)
        return tangent / math.sqrt(2) if self.fov == "diagonal" else tangent

    def directions(self) -> np.ndarray:
        """Return unit beam directions in the sensor frame.

        Returns:
            ``[K, M, 3]`` with M = ``sub_beams`` squared beams in each zone. Zones go
            row by row, y and within a row x from negative to positive.
        """

        def spread(zones: int) -> np.ndarray:
            if self.beams == "edges":
                return np.linspace(-1.0, 1.0, zones)[:, None]
            fine = zones * self.sub_beams
            return ((2 * np.arange(fine) + 1) / fine - 1).reshape(zones, -1)

        rows, columns = (self.half_extent * spread(n) for n in self.grid)
        shape = (*rows.shape, *columns.shape)
        y = np.broadcast_to(rows[:, :, None, None], shape)
        x = np.broadcast_to(columns[None, None], shape)
        # [rows, m, columns, m] -> [K, M]
        tangents = np.stack((x, y, np.ones(shape)), -1).transpose(0, 2, 1, 3, 4)
        beams = tangents.reshape(self.num_beams, self.sub_beams**2, 3)
        return beams / np.linalg.norm(beams, axis=-1, keepdims=True)


Coverage = Field | Ray
"""What one sensor sees."""


def _check_choice(name: str, value: str, choices: tuple[str, str]) -> None:
    """Raise ValueError for a word that is none of the choices."""
    if value not in choices:
        raise ValueError(f"{name} must be {' or '.join(choices)}, got {value!r}")


def _is_positive(number: object) -> bool:
    """Whether something is a positive integer, NumPy's too."""
    return isinstance(number, Integral) and int(number) > 0


KINDS: dict[str, type[Field] | type[Ray]] = {"field": Field, "ray": Ray}
"""Kinds of coverage by the name used in configurations and skin files."""
