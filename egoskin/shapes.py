"""Object shapes: the MuJoCo geom, the signed distance and the ray hit, side by side.

A shape knows nothing of sensors or tasks. Everything that a new one needs (what is
simulated, what a sensor measures) is in this file. All shapes offer the same:

- ``signed_distance(x, y, z)``: from points to the surface [m], negative inside.
- ``closest_point(x, y, z)``: of the solid, three coordinates [m]; a point inside is its
  own.
- ``ray_interval(px, py, pz, dx, dy, dz)``: where the line through p along d enters and
  leaves the solid [m], signed, measured from p; (inf, -inf) for a miss. The surface
  belongs to the solid. `first_hit` turns it into what a beam measures.
- ``bounding_radius``: of the sphere around the origin that holds the solid [m].
- ``half_height``: how far the solid reaches above and below the origin, along z [m].
- ``add_geom(body, **attributes)``: adds the shape to a MuJoCo specification.

Coordinates are in the frame of the object [m], directions have length 1, all of them
tensors of one floating type (float32 or float64) that broadcast together to ``[*B]``.

A NaN in a point or a direction makes its results NaN, never a miss: comparisons put it
on the branch that computes. Only + - * /, exact square roots, abs, min, max and
comparisons are used, which round in one way: compiled code gives the same bits.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import torch
from torch import Tensor

from egoskin.hints import did_you_mean
from egoskin.rounding import exact_sqrt

# Keeps 0/0 out as a summand or a least value; any length or its square dwarfs it, and
# float32 holds it.
_TINY = 1e-30
# Bisections and Newton steps towards an ellipsoid's closest point: they reach the
# rounding of float64 for semi-axes up to 100 : 1, measured near the inner planes, where
# Newton alone takes 16 steps. Outside, 2 steps fewer would do.
_BISECTIONS, _NEWTON_STEPS = 6, 5

Point = tuple[Tensor, Tensor, Tensor]
Interval = tuple[Tensor, Tensor]


def first_hit(enter: Tensor, leave: Tensor) -> Tensor:
    """Return how far along a beam the solid is met.

    Args:
        enter: Where the beam's line enters the solid [m], ``[*B]``.
        leave: Where it leaves [m], ``[*B]``, both as of ``ray_interval``.

    Returns:
        Distance to the first intersection [m], ``[*B]``: 0 for an origin in the solid,
        inf for a miss and for a solid behind the origin.
    """
    return torch.where(leave < 0, torch.inf, enter.clamp(min=0.0))


@dataclass(frozen=True, kw_only=True)
class Sphere:
    """A ball."""

    radius: float = 0.15
    """Radius [m]."""

    def __post_init__(self) -> None:
        """Raise ValueError for a radius that is not positive and finite."""
        _check_lengths("radius", (self.radius,), 1)

    @property
    def bounding_radius(self) -> float:
        """Radius of the sphere around the origin that holds the solid [m]."""
        return self.radius

    @property
    def half_height(self) -> float:
        """How far the solid reaches above and below the origin [m]."""
        return self.radius

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
        return exact_sqrt(x * x + y * y + z * z) - self.radius

    def closest_point(self, x: Tensor, y: Tensor, z: Tensor) -> Point:
        """Closest point of the solid [m], three ``[*B]``; see the module."""
        # At the centre r / 0 = inf, which the minimum makes 1.
        scale = (self.radius / exact_sqrt(x * x + y * y + z * z)).clamp(max=1.0)
        return x * scale, y * scale, z * scale

    def ray_interval(
        self, px: Tensor, py: Tensor, pz: Tensor, dx: Tensor, dy: Tensor, dz: Tensor
    ) -> Interval:
        """Where lines enter and leave the solid [m], two ``[*B]``; see the module."""
        return _ball_interval(self.radius, (px, py, pz), (dx, dy, dz))


@dataclass(frozen=True, kw_only=True)
class Box:
    """A box, its faces across the axes."""

    half_extents: tuple[float, float, float]
    """Half of each edge [m]."""

    def __post_init__(self) -> None:
        """Raise ValueError for lengths that are not three, positive and finite."""
        _check_lengths("half_extents", self.half_extents, 3)

    @property
    def bounding_radius(self) -> float:
        """Radius of the sphere around the origin that holds the solid [m]."""
        return math.hypot(*self.half_extents)

    @property
    def half_height(self) -> float:
        """How far the solid reaches above and below the origin [m]."""
        return self.half_extents[2]

    def add_geom(self, body: mujoco.MjsBody, **attributes: object) -> mujoco.MjsGeom:
        """Return the shape's geom, added to a body of a MuJoCo specification."""
        return body.add_geom(
            type=mujoco.mjtGeom.mjGEOM_BOX, size=list(self.half_extents), **attributes
        )

    def signed_distance(self, x: Tensor, y: Tensor, z: Tensor) -> Tensor:
        """Signed distance to the surface [m], ``[*B]``; see the module."""
        hx, hy, hz = self.half_extents
        # q = |p| - h; d = |max(q, 0)| + min(max_i q_i, 0)
        qx, qy, qz = x.abs() - hx, y.abs() - hy, z.abs() - hz
        ox, oy, oz = qx.clamp(min=0.0), qy.clamp(min=0.0), qz.clamp(min=0.0)
        inside = qx.maximum(qy).maximum(qz).clamp(max=0.0)
        return exact_sqrt(ox * ox + oy * oy + oz * oz) + inside

    def closest_point(self, x: Tensor, y: Tensor, z: Tensor) -> Point:
        """Closest point of the solid [m], three ``[*B]``; see the module."""
        # Each coordinate is found alone; 0, or NaN, tells it of a NaN in the others.
        total = x + y + z
        mark = total - total
        hx, hy, hz = self.half_extents
        return x.clamp(-hx, hx) + mark, y.clamp(-hy, hy) + mark, z.clamp(-hz, hz) + mark

    def ray_interval(
        self, px: Tensor, py: Tensor, pz: Tensor, dx: Tensor, dy: Tensor, dz: Tensor
    ) -> Interval:
        """Where lines enter and leave the solid [m], two ``[*B]``; see the module."""
        hx, hy, hz = self.half_extents
        sides = _overlap(_slab_interval(hx, px, dx), _slab_interval(hy, py, dy))
        return _overlap(sides, _slab_interval(hz, pz, dz))


@dataclass(frozen=True, kw_only=True)
class Capsule:
    """A cylinder along z with a half ball on either end."""

    radius: float
    """Radius [m]."""
    half_length: float
    """Half the length of the cylinder, without the half balls [m]."""

    def __post_init__(self) -> None:
        """Raise ValueError for lengths that are not positive and finite."""
        _check_lengths("radius", (self.radius,), 1)
        _check_lengths("half_length", (self.half_length,), 1)

    @property
    def bounding_radius(self) -> float:
        """Radius of the sphere around the origin that holds the solid [m]."""
        return self.radius + self.half_length

    @property
    def half_height(self) -> float:
        """How far the solid reaches above and below the origin [m]."""
        return self.radius + self.half_length

    def add_geom(self, body: mujoco.MjsBody, **attributes: object) -> mujoco.MjsGeom:
        """Return the shape's geom, added to a body of a MuJoCo specification."""
        return body.add_geom(
            type=mujoco.mjtGeom.mjGEOM_CAPSULE,
            size=[self.radius, self.half_length, 0],
            **attributes,
        )

    def signed_distance(self, x: Tensor, y: Tensor, z: Tensor) -> Tensor:
        """Signed distance to the surface [m], ``[*B]``; see the module."""
        # d = |p - a| - r, with a the closest point of the axis
        z = z - z.clamp(-self.half_length, self.half_length)
        return exact_sqrt(x * x + y * y + z * z) - self.radius

    def closest_point(self, x: Tensor, y: Tensor, z: Tensor) -> Point:
        """Closest point of the solid [m], three ``[*B]``; see the module."""
        axis = z.clamp(-self.half_length, self.half_length)
        across = z - axis
        length = exact_sqrt(x * x + y * y + across * across)
        scale = (self.radius / length).clamp(max=1.0)
        # Inside, z itself: axis + across may round.
        height = torch.where(length <= self.radius, z, axis + across * scale)
        return x * scale, y * scale, height

    def ray_interval(
        self, px: Tensor, py: Tensor, pz: Tensor, dx: Tensor, dy: Tensor, dz: Tensor
    ) -> Interval:
        """Where lines enter and leave the solid [m], two ``[*B]``; see the module."""
        # A disc in the plane across, met at a slower pace. Along the axis nothing moves
        # there: the pace is kept from 0, and the disc is then met for ever or never.
        pace = exact_sqrt((dx * dx + dy * dy).clamp(min=_TINY))
        disc = _ball_interval(self.radius, (px, py), (dx / pace, dy / pace))
        side = (disc[0] / pace, disc[1] / pace)
        # The solid is convex: the line is in it from the first part met to the last.
        enter, leave = _overlap(side, _slab_interval(self.half_length, pz, dz))
        for height in (pz - self.half_length, pz + self.half_length):
            ball = _ball_interval(self.radius, (px, py, height), (dx, dy, dz))
            enter, leave = enter.minimum(ball[0]), leave.maximum(ball[1])
        return enter, leave


@dataclass(frozen=True, kw_only=True)
class Ellipsoid:
    """An ellipsoid, its axes along the coordinates."""

    semi_axes: tuple[float, float, float]
    """Half of each axis [m]."""

    def __post_init__(self) -> None:
        """Raise ValueError for lengths that are not three, positive and finite."""
        _check_lengths("semi_axes", self.semi_axes, 3)

    @property
    def bounding_radius(self) -> float:
        """Radius of the sphere around the origin that holds the solid [m]."""
        return max(self.semi_axes)

    @property
    def half_height(self) -> float:
        """How far the solid reaches above and below the origin [m]."""
        return self.semi_axes[2]

    def add_geom(self, body: mujoco.MjsBody, **attributes: object) -> mujoco.MjsGeom:
        """Return the shape's geom, added to a body of a MuJoCo specification."""
        return body.add_geom(
            type=mujoco.mjtGeom.mjGEOM_ELLIPSOID,
            size=list(self.semi_axes),
            **attributes,
        )

    def signed_distance(self, x: Tensor, y: Tensor, z: Tensor) -> Tensor:
        """Signed distance to the surface [m], ``[*B]``; see the module.

        Found by iteration. On semi-axes from 0.02 m to 2 m, inside and up to 3 m
        away, in planes and axes too, it is off by at most 1e-6 m in float32 and
        1e-12 m in float64; farther away, by as much of the distance.
        """
        least = min(self.semi_axes) ** 2
        u = self._multiplier(x, y, z)
        s = u - least
        # The dual of min |p - x|^2 with x on the surface, greatest at the root:
        # d^2 = s (sum_i p_i^2 / (a_i^2 + s) - 1). An error of s enters squared, and no
        # direction is needed where that is ill-defined (the centre, inner planes).
        cx, cy, cz = (u + (a * a - least) for a in self.semi_axes)
        squared = s * (x * x / cx + y * y / cy + z * z / cz - 1.0)
        distance = exact_sqrt(squared.clamp(min=0.0))
        return torch.where(s < 0, -distance, distance)

    def closest_point(self, x: Tensor, y: Tensor, z: Tensor) -> Point:
        """Closest point of the solid [m], three ``[*B]``; see the module."""
        least = min(self.semi_axes) ** 2
        u = self._multiplier(x, y, z)
        # x_i = p_i a_i^2 / (a_i^2 + s)
        ax, ay, az = (a * a for a in self.semi_axes)
        inside = u <= least
        return (
            torch.where(inside, x, x * (ax / (u + (ax - least)))),
            torch.where(inside, y, y * (ay / (u + (ay - least)))),
            torch.where(inside, z, z * (az / (u + (az - least)))),
        )

    def _multiplier(self, x: Tensor, y: Tensor, z: Tensor) -> Tensor:
        """Least squared semi-axis plus Lagrange's multiplier of the closest point.

        The surface's closest point to p is x_i = p_i a_i^2 / (a_i^2 + s). It lies on
        the surface if G = sum_i (a_i p_i / (a_i^2 + s))^2 = 1, for one s only with all
        denominators positive. The unknown is u = s + min_i a_i^2, which stays exact
        near the pole at 0.

        Source: Moré and Sorensen, "Computing a trust region step", SIAM J. Sci. Stat.
        Comput. 4(3), 1983: 1 / sqrt(G) is concave and nearly linear.

        Returns:
            u [m^2], ``[*B]``, at least 1e-30.
        """
        least = min(self.semi_axes) ** 2
        ex, ey, ez = (a * a - least for a in self.semi_axes)
        ax, ay, az = self.semi_axes
        wx, wy, wz = ax * x.abs(), ay * y.abs(), az * z.abs()

        def terms(u: Tensor) -> tuple[Point, Point, Tensor]:
            """Return 1 / (u + e), the terms of G and their sum."""
            ix, iy, iz = 1.0 / (u + ex), 1.0 / (u + ey), 1.0 / (u + ez)
            rx, ry, rz = wx * ix, wy * iy, wz * iz
            squares = (rx * rx, ry * ry, rz * rz)
            return (ix, iy, iz), squares, squares[0] + squares[1] + squares[2]

        # The root's bounds: there one term of G alone is 1; there G would be 1 with all
        # e at their least, 0.
        low = (wx - ex).maximum(wy - ey).maximum(wz - ez).clamp(min=_TINY)
        high = exact_sqrt(wx * wx + wy * wy + wz * wz)
        for _ in range(_BISECTIONS):
            # Of the exponents: near inner planes the root is anywhere down to 0.
            middle = exact_sqrt(low * high).clamp(min=_TINY)
            *_, g = terms(middle)
            low = torch.where(g > 1.0, middle, low)
            high = torch.where(g > 1.0, high, middle)
        u = low
        for _ in range(_NEWTON_STEPS):
            # u + (1 - f) / f' with f = G^-1/2, f' = G^-3/2 sum_i G_i / (u + e_i)
            (ix, iy, iz), (gx, gy, gz), g = terms(u)
            slope = (gx * ix + gy * iy + gz * iz).clamp(min=_TINY)
            u = (u + g * (exact_sqrt(g) - 1.0) / slope).clamp(min=_TINY)
        return u

    def ray_interval(
        self, px: Tensor, py: Tensor, pz: Tensor, dx: Tensor, dy: Tensor, dz: Tensor
    ) -> Interval:
        """Where lines enter and leave the solid [m], two ``[*B]``; see the module."""
        # Scaled along the axes, the ellipsoid is the unit ball.
        kx, ky, kz = (1.0 / a for a in self.semi_axes)
        dx, dy, dz = kx * dx, ky * dy, kz * dz
        stretch = exact_sqrt(dx * dx + dy * dy + dz * dz)
        enter, leave = _ball_interval(
            1.0,
            (kx * px, ky * py, kz * pz),
            (dx / stretch, dy / stretch, dz / stretch),
        )
        return enter / stretch, leave / stretch


Shape = Sphere | Box | Capsule | Ellipsoid
"""Any shape; they share the methods that the module lists."""


def shape_of(kind: str, size: Sequence[float]) -> Shape:
    """Return the shape of a MuJoCo geom.

    Args:
        kind: ``sphere``, ``box``, ``capsule`` or ``ellipsoid``.
        size: The geom's size [m], as MuJoCo orders it; what the kind does not use is
            ignored, as MuJoCo does.

    Raises:
        ValueError: If the kind is none of these, or a size is missing, not positive or
            not finite.
    """
    needed = {"sphere": 1, "capsule": 2, "box": 3, "ellipsoid": 3}
    if kind not in needed:
        hint = did_you_mean(kind, needed)
        raise ValueError(f"kind must be one of {', '.join(needed)}, got {kind!r}{hint}")
    sizes = [float(value) for value in size][: needed[kind]]
    if len(sizes) < needed[kind]:
        raise ValueError(f"a {kind} needs {needed[kind]} sizes, got {sizes}")
    if kind == "sphere":
        return Sphere(radius=sizes[0])
    if kind == "capsule":
        return Capsule(radius=sizes[0], half_length=sizes[1])
    if kind == "box":
        return Box(half_extents=(sizes[0], sizes[1], sizes[2]))
    return Ellipsoid(semi_axes=(sizes[0], sizes[1], sizes[2]))


def _check_lengths(name: str, lengths: Sequence[float], count: int) -> None:
    """Raise ValueError unless there are so many lengths, all positive and finite."""
    if len(lengths) != count:
        raise ValueError(f"{name} must hold {count} lengths, got {lengths}")
    if not all(length > 0 and math.isfinite(length) for length in lengths):
        got = lengths[0] if count == 1 else lengths
        raise ValueError(f"{name} must be positive and finite, got {got}")


def _ball_interval(
    radius: float, p: tuple[Tensor, ...], d: tuple[Tensor, ...]
) -> Interval:
    """Where lines enter and leave a ball around the origin, or a disc (in the plane).

    By the perpendicular distance: the discriminant of the textbook's quadratic
    subtracts squares of the distance to the ball, which here never enter.

    Args:
        radius: Radius [m].
        p: Coordinates of a point of each line [m], ``[*B]`` each.
        d: Coordinates of its unit direction, ``[*B]`` each.

    Returns:
        (enter, leave) [m], ``[*B]`` each; (inf, -inf) for a miss.
    """
    # t = -p.d is closest to the centre, at q = p + t d; half a chord: sqrt(r^2 - q^2)
    t = -_dot(p, d)
    q = tuple(pi + t * di for pi, di in zip(p, d, strict=True))
    squared = radius * radius - _dot(q, q)
    half = exact_sqrt(squared)
    # A miss leaves half NaN, and takes neither end from it.
    misses = squared < 0
    return (
        torch.where(misses, torch.inf, t - half),
        torch.where(misses, -torch.inf, t + half),
    )


def _dot(a: tuple[Tensor, ...], b: tuple[Tensor, ...]) -> Tensor:
    """Sum of the products of two or three coordinates, ``[*B]``."""
    total = a[0] * b[0] + a[1] * b[1]
    return total if len(a) == 2 else total + a[2] * b[2]


def _slab_interval(half: float, p: Tensor, d: Tensor) -> Interval:
    """Where lines enter and leave the slab |p| <= half, unordered only by NaN.

    A line along the slab is in it from -inf to inf, or (equal infinities) never.
    """
    # On a face and along it the distance to it is 0: kept from 0 * inf = NaN by a
    # summand that rounds away elsewhere, and that puts the face into the slab.
    inverse = 1.0 / d
    first = (-half - p - _TINY) * inverse
    second = (half - p + _TINY) * inverse
    return first.minimum(second), first.maximum(second)


def _overlap(a: Interval, b: Interval) -> Interval:
    """The part that two intervals share, (inf, -inf) if none."""
    enter, leave = a[0].maximum(b[0]), a[1].minimum(b[1])
    empty = enter > leave
    return (
        torch.where(empty, torch.inf, enter),
        torch.where(empty, -torch.inf, leave),
    )
