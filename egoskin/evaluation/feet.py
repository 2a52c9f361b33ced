"""Geometry of a robot's feet, and how far they slide on the floor."""

from __future__ import annotations

import math

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor

from egoskin.robots.config import Primitive, RobotConfig
from egoskin.robots.kinematics import LinkKinematics, quat_to_matrix

# A point of a foot this close to the floor counts as in contact [m] (contacts are
# compliant, so zero is too strict).
_ON_FLOOR = 0.005


class Feet:
    """The shapes of the feet, each the hull of 8 corners, rounded by a radius.

    A capsule is the hull of the ends of its axis, a sphere that of its centre.

    Args:
        robot: The robot.
    """

    def __init__(self, robot: RobotConfig) -> None:
        shapes = robot.primitives_on(robot.feet)
        signs = torch.cartesian_prod(*[torch.tensor([-1.0, 1.0])] * 3).double().numpy()
        corners = [
            (signs * _half_extents(shape)) @ shape.rotation.T + shape.position
            for shape in shapes
        ]
        # In the frames of the feet [m], [F, 8, 3].
        self._corners = torch.from_numpy(np.reshape(corners, (-1, 8, 3))).float()
        # From a corner to the lowest point of its rounding [m], [F, 3].
        self._down = torch.zeros(len(shapes), 3)
        for down, shape in zip(self._down, shapes, strict=True):
            down[2] = 0.0 if shape.kind == "box" else -shape.size[0]
        self._kinematics = LinkKinematics(robot.chain, [s.link for s in shapes])

    def poses_w(self, state: TensorDictBase) -> tuple[Tensor, Tensor]:
        """Return the positions [m] and rotations of the feet in the world.

        Their shapes are ``[B, F, 3]`` and ``[B, F, 3, 3]``.
        """
        position, rotation = self._kinematics.poses_b(state["joint_pos"])
        base, turn = state["base_pose"][:, None].split([3, 4], -1)
        turn = quat_to_matrix(turn)
        return base + _times(turn, position), turn @ rotation

    def corners_w(self, position: Tensor, rotation: Tensor) -> Tensor:
        """Return the corners of each foot in the world [m], ``[B, F, 8, 3]``."""
        return position[:, :, None] + _times(rotation[:, :, None], self._corners)

    def slip(self, before: TensorDictBase, after: TensorDictBase) -> Tensor:
        """Return the distance that the lowest point of each foot slides in a step [m].

        Args:
            before: State of ``B`` rows at the start of the step.
            after: State at its end.

        Returns:
            Planar distance, ``[B, F]``; NaN where that point does not stay on the
            floor. A foot that rolls over an edge is not counted as sliding.
        """
        (start, turn), (end, turn_after) = self.poses_w(before), self.poses_w(after)
        corners = self.corners_w(start, turn)
        index = corners[..., 2:].argmin(2, keepdim=True).expand(-1, -1, 1, 3)
        lowest = corners.gather(2, index)[:, :, 0] + self._down
        # The same point of the foot at the end of the step.
        later = end + _times(turn_after, _times(turn.mT, lowest - start))
        stays = (lowest[..., 2] < _ON_FLOOR) & (later[..., 2] < _ON_FLOOR)
        way = (later - lowest)[..., :2].norm(dim=-1)
        return way.where(stays, math.nan)


def _half_extents(shape: Primitive) -> np.ndarray:
    """Return the half extents of a shape without its rounding [m], ``[3]``."""
    if shape.kind == "box":
        return shape.size
    return np.array([0.0, 0.0, shape.size[1] if shape.kind == "capsule" else 0.0])


def _times(matrix: Tensor, vector: Tensor) -> Tensor:
    """Return the products of matrices ``[*B, 3, 3]`` and vectors ``[*B, 3]``."""
    return (matrix * vector[..., None, :]).sum(-1)
