"""Object shapes: MuJoCo geom, signed distance and ray intersection of each shape.

Shapes do not depend on sensors or tasks: the simulation of a shape and its measurement
by sensors are both here. All shapes have the same methods:

- ``signed_distance(x, y, z)``: distance from points to the surface [m], negative
  inside.
- ``closest_point(x, y, z)``: closest point of the solid, three coordinates [m]; for a
  point inside, the point itself.
- ``ray_interval(px, py, pz, dx, dy, dz)``: where the line through p along d enters and
  leaves the solid [m], signed, measured from p; (inf, -inf) for a miss. The surface
  belongs to the solid. `first_hit` converts it to the measurement of a beam.
- ``bounding_radius``: radius of the sphere around the origin that contains the solid
  [m].
- ``half_height``: extent of the solid above and below the origin, along z [m].
- ``add_geom(body, **attributes)``: adds the shape to a MuJoCo specification.

Sensors need only the first four (`Solid`), so an object may also be of a class of your
own.

Coordinates are in the object frame [m] and directions have length 1. All are tensors of
one floating type (float32 or float64) that broadcast together to ``[*B]``.

A NaN in a point or a direction gives NaN results, never a miss: comparisons send NaN to
the branch that computes. Only + - * /, exact square roots, abs, min, max and
comparisons are used. Their rounding is unique, so compiled code gives the same bits.
"""

from __future__ import annotations

import math
from collections.abc import Sequence, Sized
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import mujoco
import torch
from torch import Tensor

from egoskin.gradients import is_differentiated
from egoskin.hints import did_you_mean
from egoskin.rounding import exact_sqrt

# Avoids 0/0, as a summand or a lower bound. It is negligible against any length or its
# square, and representable in float32.
_TINY = 1e-30
# Bisections and Newton steps for the closest point of an ellipsoid. They reach float64
# rounding for semi-axes up to 100 : 1, measured near the inner planes, where Newton
# alone takes 16 steps. Outside the solid, 2 steps fewer would be enough.
_BISECTIONS, _NEWTON_STEPS = 6, 5

Point = tuple[Tensor, Tensor, Tensor]
Interval = tuple[Tensor, Tensor]


@runtime_checkable
class Solid(Protocol):
    """What sensors need of an object; the module docstring defines the methods."""

    @property
    def bounding_radius(self) -> float:
        """Radius of the sphere around the origin that contains the solid [m]."""
        ...

    def signed_distance(self, x: Tensor, y: Tensor, z: Tensor) -> Tensor:
        """Return the signed distance to the surface [m], ``[*B]``."""
        ...

    def closest_point(self, x: Tensor, y: Tensor, z: Tensor) -> Point:
        """Return the closest point of the solid [m], three ``[*B]``."""
        ...

    def ray_interval(
        self, px: Tensor, py: Tensor, pz: Tensor, dx: Tensor, dy: Tensor, dz: Tensor
    ) -> Interval:
        """Return where lines enter and leave [m], two ``[*B]``."""
        ...


def first_hit(enter: Tensor, leave: Tensor) -> Tensor:
    """Return the distance along a beam to its first intersection with the solid.

    Args:
        enter: Where the beam's line enters the solid [m], ``[*B]``.
        leave: Where it leaves [m], ``[*B]``; both as returned by ``ray_interval``.

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
        """Radius of the sphere around the origin that contains the solid [m]."""
        return self.radius

    @property
    def half_height(self) -> float:
        """Extent of the solid above and below the origin, along z [m]."""
        return self.radius

    def add_geom(self, body: mujoco.MjsBody, **attributes: object) -> mujoco.MjsGeom:
        """Return the shape's geom, added to a body of a MuJoCo specification."""
        return body.add_geom(
            type=mujoco.mjtGeom.mjGEOM_SPHERE,
            size=[self.radius, 0, 0],
            **attributes,
        )

    def signed_distance(self, x: Tensor, y: Tensor, z: Tensor) -> Tensor:
        """Return the signed distance from points to the surface, negative inside.

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
        """Return the closest point of the solid [m], three ``[*B]``; see the module."""
        # At the centre r / 0 = inf, which is clamped to 1.
        scale = (self.radius / exact_sqrt(x * x + y * y + z * z)).clamp(max=1.0)
        return x * scale, y * scale, z * scale

    def ray_interval(
        self, px: Tensor, py: Tensor, pz: Tensor, dx: Tensor, dy: Tensor, dz: Tensor
    ) -> Interval:
        """Return where lines enter and leave [m], two ``[*B]``; see the module."""
        return _ball_interval(self.radius, (px, py, pz), (dx, dy, dz))


@dataclass(frozen=True, kw_only=True)
class Box:
    """An axis-aligned box."""

    half_extents: tuple[float, float, float]
    """Half of each edge [m]."""

    def __post_init__(self) -> None:
        """Raise ValueError unless there are three positive, finite lengths."""
        _check_lengths("half_extents", self.half_extents, 3)

    @property
    def bounding_radius(self) -> float:
        """Radius of the sphere around the origin that contains the solid [m]."""
        return math.hypot(*self.half_extents)

    @property
    def half_height(self) -> float:
        """Extent of the solid above and below the origin, along z [m]."""
        return self.half_extents[2]

    def add_geom(self, body: mujoco.MjsBody, **attributes: object) -> mujoco.MjsGeom:
        """Return the shape's geom, added to a body of a MuJoCo specification."""
        return body.add_geom(
            type=mujoco.mjtGeom.mjGEOM_BOX, size=list(self.half_extents), **attributes
        )

    def signed_distance(self, x: Tensor, y: Tensor, z: Tensor) -> Tensor:
        """Return the signed distance to the surface [m], ``[*B]``; see the module."""
        hx, hy, hz = self.half_extents
        # q = |p| - h; d = |max(q, 0)| + min(max_i q_i, 0)
        qx, qy, qz = x.abs() - hx, y.abs() - hy, z.abs() - hz
        ox, oy, oz = qx.clamp(min=0.0), qy.clamp(min=0.0), qz.clamp(min=0.0)
        inside = qx.maximum(qy).maximum(qz).clamp(max=0.0)
        return exact_sqrt(ox * ox + oy * oy + oz * oz) + inside

    def closest_point(self, x: Tensor, y: Tensor, z: Tensor) -> Point:
        """Return the closest point of the solid [m], three ``[*B]``; see the module."""
        # Coordinates are computed separately; the mark (0 or NaN) spreads a NaN to all.
        total = x + y + z
        mark = total - total
        hx, hy, hz = self.half_extents
        return x.clamp(-hx, hx) + mark, y.clamp(-hy, hy) + mark, z.clamp(-hz, hz) + mark

    def ray_interval(
        self, px: Tensor, py: Tensor, pz: Tensor, dx: Tensor, dy: Tensor, dz: Tensor
    ) -> Interval:
        """Return where lines enter and leave [m], two ``[*B]``; see the module."""
        hx, hy, hz = self.half_extents
        sides = _overlap(_slab_interval(hx, px, dx), _slab_interval(hy, py, dy))
        return _overlap(sides, _slab_interval(hz, pz, dz))


@dataclass(frozen=True, kw_only=True)
class Capsule:
    """A cylinder along z with a hemisphere at each end."""

    radius: float
    """Radius [m]."""
    half_length: float
    """Half the length of the cylinder, without the hemispheres [m]."""

    def __post_init__(self) -> None:
        """Raise ValueError for lengths that are not positive and finite."""
        _check_lengths("radius", (self.radius,), 1)
        _check_lengths("half_length", (self.half_length,), 1)

    @property
    def bounding_radius(self) -> float:
        """Radius of the sphere around the origin that contains the solid [m]."""
        return self.radius + self.half_length

    @property
    def half_height(self) -> float:
        """Extent of the solid above and below the origin, along z [m]."""
        return self.radius + self.half_length

    def add_geom(self, body: mujoco.MjsBody, **attributes: object) -> mujoco.MjsGeom:
        """Return the shape's geom, added to a body of a MuJoCo specification."""
        return body.add_geom(
            type=mujoco.mjtGeom.mjGEOM_CAPSULE,
            size=[self.radius, self.half_length, 0],
            **attributes,
        )

    def signed_distance(self, x: Tensor, y: Tensor, z: Tensor) -> Tensor:
        """Return the signed distance to the surface [m], ``[*B]``; see the module."""
        # d = |p - a| - r, where a is the closest point on the axis
        z = z - z.clamp(-self.half_length, self.half_length)
        return exact_sqrt(x * x + y * y + z * z) - self.radius

    def closest_point(self, x: Tensor, y: Tensor, z: Tensor) -> Point:
        """Return the closest point of the solid [m], three ``[*B]``; see the module."""
        axis = z.clamp(-self.half_length, self.half_length)
        across = z - axis
        length = exact_sqrt(x * x + y * y + across * across)
        scale = (self.radius / length).clamp(max=1.0)
        # Inside, z itself, because axis + across may be rounded.
        height = torch.where(length <= self.radius, z, axis + across * scale)
        return x * scale, y * scale, height

    def ray_interval(
        self, px: Tensor, py: Tensor, pz: Tensor, dx: Tensor, dy: Tensor, dz: Tensor
    ) -> Interval:
        """Return where lines enter and leave [m], two ``[*B]``; see the module."""
        # Projected onto the xy plane, the cylinder is a disc and the line moves at a
        # lower speed, the pace. For a line along the axis the pace is 0; it is kept
        # positive, and the line is then always or never inside the disc.
        pace = exact_sqrt((dx * dx + dy * dy).clamp(min=_TINY))
        side = _ball_interval(self.radius, (px, py), (dx / pace, dy / pace), pace)
        # The solid is convex: the line is inside from its first entry to its last exit.
        enter, leave = _overlap(side, _slab_interval(self.half_length, pz, dz))
        for height in (pz - self.half_length, pz + self.half_length):
            ball = _ball_interval(self.radius, (px, py, height), (dx, dy, dz))
            enter, leave = enter.minimum(ball[0]), leave.maximum(ball[1])
        return enter, leave


@dataclass(frozen=True, kw_only=True)
class Ellipsoid:
    """An axis-aligned ellipsoid."""

    semi_axes: tuple[float, float, float]
    """Half of each axis [m]."""

    def __post_init__(self) -> None:
        """Raise ValueError unless there are three positive, finite lengths."""
        _check_lengths("semi_axes", self.semi_axes, 3)

    @property
    def bounding_radius(self) -> float:
        """Radius of the sphere around the origin that contains the solid [m]."""
        return max(self.semi_axes)

    @property
    def half_height(self) -> float:
        """Extent of the solid above and below the origin, along z [m]."""
        return self.semi_axes[2]

    def add_geom(self, body: mujoco.MjsBody, **attributes: object) -> mujoco.MjsGeom:
        """Return the shape's geom, added to a body of a MuJoCo specification."""
        return body.add_geom(
            type=mujoco.mjtGeom.mjGEOM_ELLIPSOID,
            size=list(self.semi_axes),
            **attributes,
        )

    def signed_distance(self, x: Tensor, y: Tensor, z: Tensor) -> Tensor:
        """Return the signed distance to the surface [m], ``[*B]``; see the module.

        Computed by iteration. For semi-axes from 0.02 m to 2 m and points inside or up
        to 3 m away, also in symmetry planes and on axes, the error is at most 1e-6 m in
        float32 and 1e-12 m in float64; farther away, at most that fraction of the
        distance. Inside, derivatives are 0.
        """
        least = min(self.semi_axes) ** 2
        if any(map(is_differentiated, (x, y, z))):
            # Inside, near the inner planes, the multiplier's derivative overflows.
            fixed = x.detach(), y.detach(), z.detach()
            inside = self._multiplier(*fixed) < least
            x, y, z = (
                torch.where(inside, q, p) for p, q in zip((x, y, z), fixed, strict=True)
            )
        u = self._multiplier(x, y, z)
        s = u - least
        # The dual of min |p - x|^2 with x on the surface, which is maximal at the root:
        # d^2 = s (sum_i p_i^2 / (a_i^2 + s) - 1). The error of s enters squared, and no
        # direction is needed, which is ill-defined at the centre and inner planes.
        cx, cy, cz = (u + (a * a - least) for a in self.semi_axes)
        squared = s * (x * x / cx + y * y / cy + z * z / cz - 1.0)
        distance = exact_sqrt(squared.clamp(min=0.0))
        return torch.where(s < 0, -distance, distance)

    def closest_point(self, x: Tensor, y: Tensor, z: Tensor) -> Point:
        """Return the closest point of the solid [m], three ``[*B]``; see the module."""
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
        """Return the shifted Lagrange multiplier u of the closest point.

        The surface's closest point to p is x_i = p_i a_i^2 / (a_i^2 + s). It lies on
        the surface if G = sum_i (a_i p_i / (a_i^2 + s))^2 = 1, which holds for only one
        s with all denominators positive. The unknown is u = s + min_i a_i^2, which
        stays exact near the pole at 0.

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

        # Bounds of the root. Low: the largest u at which a single term of G is 1. High:
        # the u at which G would be 1 if all e were 0, their minimum.
        low = (wx - ex).maximum(wy - ey).maximum(wz - ez).clamp(min=_TINY)
        high = exact_sqrt(wx * wx + wy * wy + wz * wz)
        for _ in range(_BISECTIONS):
            # Bisects exponents: near inner planes the root may be arbitrarily small.
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
        """Return where lines enter and leave [m], two ``[*B]``; see the module."""
        # Scaled along the axes, the ellipsoid is the unit ball.
        kx, ky, kz = (1.0 / a for a in self.semi_axes)
        dx, dy, dz = kx * dx, ky * dy, kz * dz
        stretch = exact_sqrt(dx * dx + dy * dy + dz * dz)
        return _ball_interval(
            1.0,
            (kx * px, ky * py, kz * pz),
            (dx / stretch, dy / stretch, dz / stretch),
            stretch,
        )


Shape = Sphere | Box | Capsule | Ellipsoid
"""Any shape; all have the methods listed in the module docstring."""
NUM_SIZES = {"sphere": 1, "capsule": 2, "box": 3, "ellipsoid": 3}
"""Number of sizes of each kind of shape, as MuJoCo counts them."""


def shape_of(kind: str, size: Sequence[float]) -> Shape:
    """Return the shape of a MuJoCo geom.

    Args:
        kind: ``sphere``, ``box``, ``capsule`` or ``ellipsoid``.
        size: Size of the geom [m], in MuJoCo's order; values that the kind does not
            use are ignored, as in MuJoCo.

    Raises:
        ValueError: If the kind is unknown, or a size is missing, not positive or not
            finite.
    """
    if kind not in NUM_SIZES:
        hint, kinds = did_you_mean(kind, NUM_SIZES), ", ".join(NUM_SIZES)
        raise ValueError(f"kind must be one of {kinds}, got {kind!r}{hint}")
    needed = NUM_SIZES[kind]
    sizes = [float(value) for value in size][:needed]
    if len(sizes) < needed:
        raise ValueError(f"a {kind} needs {needed} sizes, got {sizes}")
    if kind == "sphere":
        return Sphere(radius=sizes[0])
    if kind == "capsule":
        return Capsule(radius=sizes[0], half_length=sizes[1])
    if kind == "box":
        return Box(half_extents=(sizes[0], sizes[1], sizes[2]))
    return Ellipsoid(semi_axes=(sizes[0], sizes[1], sizes[2]))


def _check_lengths(name: str, lengths: Sequence[float], count: int) -> None:
    """Raise ValueError unless there are ``count`` positive, finite lengths."""
    if not isinstance(lengths, Sized) or len(lengths) != count:
        raise ValueError(f"{name} must hold {count} lengths, got {lengths}")
    if not all(length > 0 and math.isfinite(length) for length in lengths):
        got = lengths[0] if count == 1 else lengths
        raise ValueError(f"{name} must be positive and finite, got {got}")


def _ball_interval(
    radius: float,
    p: tuple[Tensor, ...],
    d: tuple[Tensor, ...],
    pace: Tensor | None = None,
) -> Interval:
    """Return where lines enter and leave a ball (3D) or disc (2D) around the origin.

    Uses the perpendicular distance. The textbook discriminant would subtract squares of
    the distance to the ball, which loses precision far away.

    Args:
        radius: Radius [m].
        p: Coordinates of a point of each line [m], ``[*B]`` each.
        d: Coordinates of its unit direction, ``[*B]`` each.
        pace: Divisor of the results, positive, ``[*B]``; None for 1.

    Returns:
        (enter, leave) [m], ``[*B]`` each; (inf, -inf) for a miss.
    """
    # t = -p.d is closest to the centre, at q = p + t d; half a chord: sqrt(r^2 - q^2)
    t = -_dot(p, d)
    q = tuple(pi + t * di for pi, di in zip(p, d, strict=True))
    squared = radius * radius - _dot(q, q)
    misses = squared < 0
    # Not used for a miss, but finite: the gradient of NaN or infinity would be NaN.
    half = exact_sqrt(squared.masked_fill(misses, 1.0))
    enter, leave = t - half, t + half
    if pace is not None:
        enter, leave = enter / pace, leave / pace
    return (
        torch.where(misses, torch.inf, enter),
        torch.where(misses, -torch.inf, leave),
    )


def _dot(a: tuple[Tensor, ...], b: tuple[Tensor, ...]) -> Tensor:
    """Return the dot product of two or three coordinates, ``[*B]``."""
    total = a[0] * b[0] + a[1] * b[1]
    return total if len(a) == 2 else total + a[2] * b[2]


def _slab_interval(half: float, p: Tensor, d: Tensor) -> Interval:
    """Return where lines enter and leave the slab |p| <= half, in order unless NaN.

    For a line parallel to the slab this is -inf to inf if it is inside, and two equal
    infinities if not.
    """
    # For a line within a face, 0 * inf = NaN is avoided by a summand that is rounded
    # away in all other cases. It also makes the face belong to the slab.
    low, high, inverse = -half - p - _TINY, half - p + _TINY, 1.0 / d
    first, second = low * inverse, high * inverse
    if is_differentiated(first):
        # The infinite ends of a parallel line are constant, not of gradient 0 * inf.
        parallel = d == 0
        inverse = 1.0 / d.masked_fill(parallel, 1.0)
        first = torch.where(parallel, first.detach(), low * inverse)
        second = torch.where(parallel, second.detach(), high * inverse)
    return first.minimum(second), first.maximum(second)


def _overlap(a: Interval, b: Interval) -> Interval:
    """Return the intersection of two intervals, (inf, -inf) if it is empty."""
    enter, leave = a[0].maximum(b[0]), a[1].minimum(b[1])
    empty = enter > leave
    return (
        torch.where(empty, torch.inf, enter),
        torch.where(empty, -torch.inf, leave),
    )
