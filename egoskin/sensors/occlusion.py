"""Occlusion of objects by the robot's own body."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from egoskin.robots.config import Primitive
from egoskin.rounding import matvec
from egoskin.shapes import shape_of

# A path is blocked if a longer part of it than this lies inside one primitive [m]. The
# surface that a sensor sits on therefore does not block it, nor do paths that graze a
# round one; a path exactly in a flat face is blocked, as the face belongs to the shape.
_DEPTH = 1e-3
# Sensors less than this below a surface are on it: skin files have six decimals [m].
_ROUNDING = 1e-5
# Margin for rounding when primitives are culled [m].
_SLACK = 1e-3
# Bundles processed at a time, so that temporaries stay in the cache.
_CHUNK = 2**12


class Occluder:
    """The body of a robot as an obstacle to straight paths.

    Paths come in bundles from one sensor to points of one object. Only primitives that
    reach into the cone of a bundle are tested; the result is the same as testing all.

    Args:
        primitives: The robot's body.
        links: Links whose frames are passed to `blocked`, including those of the body.
    """

    def __init__(self, primitives: Sequence[Primitive], links: Sequence[str]) -> None:
        self._link = [links.index(p.link) for p in primitives]
        self._shapes = [shape_of(p.kind, p.size.tolist()) for p in primitives]
        self._centres = [p.position.tolist() for p in primitives]
        self._turns = [p.rotation.T.tolist() for p in primitives]

    def outside(self, link: Tensor, point: Tensor, normal: Tensor) -> Tensor:
        """Return points, moved along their normals out of the primitives of their link.

        A real cover is not exactly the robot's primitives: a sensor inside one of them
        is on the surface above it.

        Args:
            link: Link of each point, ``[S]``.
            point: Points in the frames of their links [m], ``[3, S]``.
            normal: Unit normals in these frames, ``[3, S]``.

        Returns:
            ``[3, S]``; points that are not inside are unchanged.
        """
        before = None
        # Repeated, because a way out of one primitive can end in another.
        while before is None or not torch.equal(point, before):
            before = point
            for i, shape in enumerate(self._shapes):
                start = [p - c for p, c in zip(point, self._centres[i], strict=True)]
                start, way = (matvec(self._turns[i], v) for v in (start, normal))
                inside = shape.signed_distance(*start) < -_ROUNDING
                inside &= link == self._link[i]
                _, leave = shape.ray_interval(*start, *way)
                point = torch.where(inside, point + leave * normal, point)
        return point

    def blocked(
        self,
        frames: tuple[Tensor, Tensor],
        row: Tensor,
        origin: Tensor,
        target: Tensor,
        radius: float,
        bundle: Tensor,
        direction: Sequence[Tensor],
        length: Tensor,
    ) -> Tensor:
        """Return whether straight paths intersect the robot.

        Args:
            frames: Rotations ``[3, 3, L, B]`` and positions [m] ``[3, L, B]`` of the
                links in the base frame.
            row: Row of each bundle, ``[n]``.
            origin: Start of each bundle in the base frame [m], ``[3, n]``.
            target: Vector from there to the centre of the bundle's end points [m],
                ``[3, n]``.
            radius: Largest distance of an end point from that centre [m].
            bundle: Bundle of each path, ``[m]``.
            direction: Unit directions in the base frame, three of ``[m]``.
            length: Lengths of the paths [m], ``[m]``.

        Returns:
            ``[m]`` bool.
        """
        rotation, position = frames
        centres = self._centres_b(rotation, position)
        parts = (row.split(_CHUNK), origin.split(_CHUNK, 1), target.split(_CHUNK, 1))
        near = [
            self._near(centres[..., at], start, way, radius)
            for at, start, way in zip(*parts, strict=True)
        ]
        near = torch.cat(near, 1)[:, bundle]
        row, origin = row[bundle], origin[:, bundle]
        hidden = torch.zeros_like(length, dtype=torch.bool)
        for i, shape in enumerate(self._shapes):
            some = (near[i] & ~hidden).nonzero()[:, 0]
            if not len(some):
                continue
            link, at = self._link[i], row[some]
            # Into the link's frame, then the primitive's: R^T (p - o).
            columns = rotation[:, :, link, at].transpose(0, 1)
            start = matvec(columns, origin[:, some] - position[:, link, at])
            start = [p - c for p, c in zip(start, self._centres[i], strict=True)]
            way = matvec(columns, [d[some] for d in direction])
            start, way = (matvec(self._turns[i], v) for v in (start, way))
            enter, leave = shape.ray_interval(*start, *way)
            inside = torch.minimum(leave, length[some]) - enter.clamp(min=0.0)
            hidden[some] = inside > _DEPTH
        return hidden

    def _centres_b(self, rotation: Tensor, position: Tensor) -> Tensor:
        """Centres of the primitives in the base frame [m], ``[3, P, B]``."""
        x, y, z = rotation.new_tensor(self._centres).t()[..., None]
        # p + R c
        a, b, c = rotation[:, :, self._link].unbind(1)
        return position[:, self._link] + (a * x + b * y + c * z)

    def _near(
        self, centre: Tensor, origin: Tensor, target: Tensor, radius: float
    ) -> Tensor:
        """Which primitives may block a path of each bundle, ``[P, n]`` bool."""
        reach = (target * target).sum(0).sqrt()
        axis = target / reach
        # All paths lie in the cone around the ball of end points. For an origin inside
        # the ball there is no cone: the NaN makes all primitives near.
        sin = radius / reach
        cos = (1 - sin * sin).sqrt()
        x, y, z = centre - origin[:, None]
        along = x * axis[0] + y * axis[1] + z * axis[2]
        x, y, z = x - along * axis[0], y - along * axis[1], z - along * axis[2]
        across = (x * x + y * y + z * z).sqrt()
        # Distance of the primitive's centre from the cone: beside, behind, beyond it.
        gap = torch.maximum(across * cos - along * sin, -along)
        gap = torch.maximum(gap, along - (reach + radius))
        bounds = centre.new_tensor([s.bounding_radius for s in self._shapes])
        return ~(gap > bounds[:, None] + _SLACK)
