"""Object shapes: the MuJoCo geom and the signed distance, side by side.

A shape knows nothing of sensors or tasks. Everything that a new one needs (what is
simulated, what a sensor measures) is in this file.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import mujoco
from torch import Tensor


@dataclass(frozen=True, kw_only=True)
class Sphere:
    """A ball."""

    radius: float = 0.15
    """Radius [m]."""

    def __post_init__(self) -> None:
        """Raise ValueError for a radius that is not positive and finite."""
        if not (self.radius > 0 and math.isfinite(self.radius)):
            raise ValueError(f"radius must be positive and finite, got {self.radius}")

    def add_geom(self, body: mujoco.MjsBody, **attributes: object) -> mujoco.MjsGeom:
        """Return the shape's geom, added to a body of a MuJoCo specification."""
        return body.add_geom(
            type=mujoco.mjtGeom.mjGEOM_SPHERE,
            size=[self.radius, 0, 0],
            **attributes,
        )

    def signed_distance(self, x: Tensor, y: Tensor, z: Tensor) -> Tensor:
        """Signed distance from points to the surface, negative inside.

        Args:
            x: First coordinate of the points in the object frame [m], ``[*B]``.
            y: Second coordinate [m], ``[*B]``.
            z: Third coordinate [m], ``[*B]``.

        Returns:
            Distance [m], ``[*B]``; differentiable except at the centre.
        """
        # d = |p| - r
        return (x * x + y * y + z * z).sqrt() - self.radius
