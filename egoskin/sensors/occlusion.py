"""Occlusion: what the robot's own body hides from its sensors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from egoskin.kinematics import Frame
from egoskin.robots import Primitive
from egoskin.shapes import shape_of

# A path is blocked if more than this of it lies inside one primitive [m]: a sensor on
# the surface is not blocked by the point it sits on, nor is a path along the surface.
_DEPTH = 1e-3


class Occluder:
    """The body of a robot as an obstacle to straight paths.

    Args:
        primitives: The robot's body.
    """

    def __init__(self, primitives: Sequence[Primitive]) -> None:
        self.links = tuple(dict.fromkeys(p.link for p in primitives))
        self._parts = [
            (
                p.link,
                shape_of(p.kind, p.size.tolist()),
                p.position.tolist(),
                p.rotation.T.tolist(),
            )
            for p in primitives
        ]

    def blocked(
        self,
        frames: Mapping[str, Frame],
        origin: Sequence[Tensor],
        direction: Sequence[Tensor],
        length: Tensor,
    ) -> Tensor:
        """Return whether straight paths run through the robot.

        Args:
            frames: Frames of ``links`` in the base frame, of each path's row.
            origin: Start of each path in the base frame [m], three of ``[n]``.
            direction: Unit directions in the base frame, three of ``[n, K]``.
            length: Lengths of the paths [m], ``[n, K]``.

        Returns:
            ``[n, K]`` bool.
        """
        hidden = torch.zeros_like(length, dtype=torch.bool)
        for link, shape, centre, turn in self._parts:
            rotation, position = frames[link]
            # Into the link's frame, then the primitive's: R^T (p - o).
            columns = [
                [e[:, None] if isinstance(e, Tensor) else e for e in c]
                for c in zip(*rotation, strict=True)
            ]
            away = [(o - p)[:, None] for o, p in zip(origin, position, strict=True)]
            start = _turned(columns, away)
            start = [p - c for p, c in zip(start, centre, strict=True)]
            start, way = (
                _turned(turn, start),
                _turned(turn, _turned(columns, direction)),
            )
            enter, leave = shape.ray_interval(*start, *way)
            inside = torch.minimum(leave, length) - enter.clamp(min=0.0)
            hidden |= inside > _DEPTH
        return hidden


def _turned(rows: Sequence, vector: Sequence[Tensor]) -> list[Tensor]:
    """The product of a matrix, row by row, with a vector."""
    x, y, z = vector
    return [a * x + b * y + c * z for a, b, c in rows]
