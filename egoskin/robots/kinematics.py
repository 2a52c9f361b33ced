"""Fast forward kinematics of some links of a pytorch-kinematics chain.

The `pytorch_kinematics.Chain` describes the robot and is the reference in the tests.
This module evaluates only the branches that lead to the requested links, all frames of
one depth at once, with the batch last and contiguous. The C++ code in
``egoskin/sensors/kernels/kernels.cpp`` and, for CUDA, the kernel in
``egoskin/robots/warp_kinematics.py`` evaluate the same `Steps`, bit for bit.

Contract: all poses are relative to the root of the chain (the robot's base), regardless
of the root's own offset, so they depend only on the joint positions.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import pytorch_kinematics as pk
import torch
from torch import Tensor

from egoskin.gpu import uses_warp
from egoskin.gradients import is_differentiated
from egoskin.rounding import sincos

if TYPE_CHECKING:
    from egoskin.robots.warp_kinematics import WarpKinematics


class Steps(NamedTuple):
    """Steps from frame to frame: each is a fixed offset, then a joint.

    A step rotates by ``constant + by_cos cos q + by_sin sin q`` and translates by
    ``shift + slide q``, where q is the position of its joint; float64.
    """

    parent: np.ndarray
    """Frame that each of the n steps starts from, 0 being the base, ``[n]`` int64.
    Step i leads to frame i + 1."""
    joint: np.ndarray
    """Its joint, or -1 for none, ``[n]`` int64."""
    constant: np.ndarray
    """``[n, 3, 3]``."""
    by_cos: np.ndarray
    """``[n, 3, 3]``."""
    by_sin: np.ndarray
    """``[n, 3, 3]``."""
    shift: np.ndarray
    """[m], ``[n, 3]``."""
    slide: np.ndarray
    """Axis of a prismatic joint, else 0, ``[n, 3]``."""


class _Constants(NamedTuple):
    """Constants of `LinkKinematics` for one dtype and device."""

    joint: Tensor
    """Joint of each step."""
    matrices: list[Tensor]
    """Fields of `Steps` from ``constant`` on, with a last dimension for the batch."""
    unit: Tensor
    """Rotation of the base."""
    levels: list[tuple[Tensor, Tensor]]
    """Steps of each depth and the frames they start from, in order of depth."""
    wanted: Tensor
    """Frame of each link."""


class LinkKinematics:
    """Positions and rotations of links relative to the base, from joint positions.

    Joint positions are in the order of ``chain.get_joint_parameter_names()``, [rad] or,
    for a prismatic joint, [m].

    Args:
        chain: Chain of the robot; its root is the base.
        links: Names of the requested links, in the order of the results.

    Raises:
        ValueError: If a link is not in the chain, two links or two joints have the same
            name, or a joint's axis has no direction.
    """

    def __init__(self, chain: pk.Chain, links: Sequence[str]) -> None:
        self.links = tuple(links)
        joint_names = chain.get_joint_parameter_names()
        self.num_joints = len(joint_names)
        joint_index = {str(name): i for i, name in enumerate(joint_names)}
        _check_different("joints", joint_names)
        frames = _frames(chain)
        _check_different("links", [frame.name for frame, _ in frames])
        wanted = {frame.name for frame, _ in frames} & set(self.links)
        # Only frames that lead to a requested link are evaluated.
        needed = [frame.name in wanted for frame, _ in frames]
        for i in range(len(frames) - 1, 0, -1):
            needed[frames[i][1]] |= needed[i]
        steps: list[tuple[int, pk.Frame]] = []
        slot = {0: 0}
        for i, (frame, parent) in enumerate(frames):
            if i > 0 and needed[i]:
                steps.append((slot[parent], frame))
                slot[i] = len(steps)
        slots = {
            frame.name: slot[i]
            for i, (frame, _) in enumerate(frames)
            if frame.name in wanted
        }
        missing = [name for name in self.links if name not in slots]
        if missing:
            raise ValueError(
                f"link {missing[0]!r} is not in the chain; its links are "
                f"{', '.join(chain.get_link_names())}"
            )
        self.frames = np.array([slots[name] for name in self.links], dtype=np.int64)
        """Frame of each link; see `Steps`."""
        columns = [_step(parent, frame, joint_index) for parent, frame in steps]
        shapes = [(), (), (3, 3), (3, 3), (3, 3), (3,), (3,)]
        types = [np.int64] * 2 + [np.float64] * 5
        self.steps = Steps(
            *(
                np.array([c[i] for c in columns], dtype=types[i]).reshape(-1, *shape)
                for i, shape in enumerate(shapes)
            )
        )
        depth = [0]
        for parent in self.steps.parent:
            depth.append(depth[parent] + 1)
        # Steps of each depth, in order of depth.
        self._levels = [
            level
            for d in range(1, max(depth) + 1)
            for level in np.nonzero(np.array(depth[1:]) == d)
        ]
        self._constants: dict[tuple[torch.dtype, torch.device], _Constants] = {}
        self._warp: dict[torch.device, WarpKinematics] = {}

    def __getstate__(self) -> dict[str, Any]:
        """Return the state without what cannot be pickled."""
        return {**vars(self), "_warp": {}}

    def reach(self) -> list[float]:
        """Return an upper bound of each link origin's distance from the base [m].

        Infinite for links after a prismatic joint.
        """
        farthest = [0.0]
        steps = self.steps
        for parent, shift, slide in zip(
            steps.parent, steps.shift, steps.slide, strict=True
        ):
            length = math.inf if slide.any() else float(np.linalg.norm(shift))
            farthest.append(farthest[parent] + length)
        return [farthest[frame] for frame in self.frames]

    def check(self, joint_pos: Tensor) -> None:
        """Raise ValueError unless there is one position for each joint."""
        if joint_pos.shape[-1] != self.num_joints:
            raise ValueError(
                f"joint positions must be [B, {self.num_joints}], one column for each "
                f"joint of the chain, got {list(joint_pos.shape)}"
            )

    def poses_b(self, joint_pos: Tensor) -> tuple[Tensor, Tensor]:
        """Return link positions ``[B, L, 3]`` [m] and rotations ``[B, L, 3, 3]``.

        Args:
            joint_pos: Joint positions, ``[B, J]``.

        Returns:
            Position and rotation matrix of each link in the base frame.
        """
        rotation, position = self.link_frames(joint_pos)
        return position.permute(2, 1, 0), rotation.permute(3, 2, 0, 1)

    def link_frames(self, joint_pos: Tensor) -> tuple[Tensor, Tensor]:
        """Return the links' frames in the base frame, the batch last.

        Args:
            joint_pos: Joint positions, ``[B, J]``.

        Returns:
            Rotations ``[3, 3, L, B]`` and positions [m] ``[3, L, B]``.

        Raises:
            ValueError: If J is not the chain's number of joints.
        """
        self.check(joint_pos)
        own = self._constants_like(joint_pos)
        single = joint_pos.dtype == torch.float32
        if uses_warp(joint_pos) and single and not is_differentiated(joint_pos):
            turned, moved = (
                x[own.wanted] for x in self._on(joint_pos.device).frames(joint_pos)
            )
            return turned.permute(2, 3, 0, 1), moved.permute(2, 0, 1)
        zero = joint_pos.new_zeros(1, len(joint_pos))
        joints = torch.cat((joint_pos.t(), zero))[own.joint]
        sin, cos = (x[:, None, None] for x in sincos(joints))
        constant, by_cos, by_sin, shift, slide = own.matrices
        turn = (constant + by_cos * cos) + by_sin * sin
        way = shift + slide * joints[:, None]
        rotation = joint_pos.new_empty(len(turn) + 1, 3, 3, len(joint_pos))
        position = joint_pos.new_zeros(len(turn) + 1, 3, len(joint_pos))
        rotation[0] = own.unit
        for steps, parents in own.levels:
            # Sums are written out: a library's matrix product may round differently
            # for another batch size.
            x, y, z = rotation[parents].unbind(2)
            t, w = turn[steps], way[steps]
            rotation[steps + 1] = (
                x[:, :, None] * t[:, 0, None]
                + y[:, :, None] * t[:, 1, None]
                + z[:, :, None] * t[:, 2, None]
            )
            shifted = x * w[:, :1] + y * w[:, 1:2] + z * w[:, 2:]
            position[steps + 1] = position[parents] + shifted
        turned, moved = rotation[own.wanted], position[own.wanted]
        return turned.permute(1, 2, 0, 3), moved.transpose(0, 1)

    def _on(self, device: torch.device) -> WarpKinematics:
        """Return the kernel of a device."""
        if device not in self._warp:
            from egoskin.robots.warp_kinematics import WarpKinematics

            self._warp[device] = WarpKinematics(self.steps, device)
        return self._warp[device]

    def _constants_like(self, joint_pos: Tensor) -> _Constants:
        """Return the tables in the dtype and on the device of joint positions."""
        kind = joint_pos.dtype, joint_pos.device
        if kind not in self._constants:
            # They are kept for later calls, which may need gradients.
            with torch.inference_mode(False):
                self._constants[kind] = self._constants_of(*kind)
        return self._constants[kind]

    def _constants_of(self, dtype: torch.dtype, device: torch.device) -> _Constants:
        """Return the tables as tensors."""

        def index(x: np.ndarray) -> Tensor:
            return torch.from_numpy(x).to(device)

        return _Constants(
            # Steps without a joint use the 0 appended to the joint positions.
            joint=index(self.steps.joint % (self.num_joints + 1)),
            matrices=[
                torch.from_numpy(x)[..., None].to(device, dtype) for x in self.steps[2:]
            ],
            unit=torch.eye(3, dtype=dtype, device=device)[..., None],
            levels=[(index(x), index(self.steps.parent[x])) for x in self._levels],
            wanted=index(self.frames),
        )


def _frames(chain: pk.Chain) -> list[tuple[pk.Frame, int]]:
    """Return all frames, each with the index of its parent, depth first."""
    found: list[tuple[pk.Frame, int]] = []
    # The public methods of a chain return frames by name only.
    left = [(chain._root, -1)]
    while left:
        frame, parent = left.pop()
        found.append((frame, parent))
        below = [(child, len(found) - 1) for child in frame.children]
        left += reversed(below)
    return found


def _check_different(what: str, names: Sequence[str]) -> None:
    """Raise ValueError if two names are equal, and thus ambiguous."""
    twice = [name for name, number in Counter(names).items() if number > 1]
    if twice:
        raise ValueError(
            f"two {what} of the chain have the name {twice[0]!r}: give each a unique "
            "name in the robot's file"
        )


def _step(parent: int, frame: pk.Frame, joint_index: Mapping[str, int]) -> tuple:
    """Return the entries of `Steps` for the step to a frame."""
    joint = frame.joint
    offset = _matrix(frame.link.offset) @ _matrix(joint.offset)
    turn, shift = offset[:3, :3], offset[:3, 3]
    along, skew, slide = np.eye(3), np.zeros((3, 3)), np.zeros(3)
    axis = joint.axis.double().numpy()
    if joint.joint_type == "revolute":
        # Rodrigues: a a^T + (1 - a a^T) cos q + [a]x sin q
        along, skew = np.outer(axis, axis), np.cross(np.eye(3), axis)
    elif joint.joint_type == "prismatic":
        slide = turn @ axis
    number = -1 if joint.joint_type == "fixed" else joint_index[str(joint.name)]
    if number >= 0 and not np.isfinite(axis).all():
        raise ValueError(
            f"the axis of joint {joint.name!r} must not be zero, got 0 0 0 in the "
            "robot's file"
        )
    return (
        *(parent, number),
        *(turn @ along, turn @ (np.eye(3) - along), turn @ skew),
        *(shift, slide),
    )


def _matrix(transform: pk.Transform3d | None) -> np.ndarray:
    """Return a fixed offset as a matrix, ``[4, 4]`` float64."""
    if transform is None:
        return np.eye(4)
    return transform.get_matrix()[0].double().numpy()


def quat_to_matrix(quat: Tensor) -> Tensor:
    """Return the rotation matrix of quaternions (w, x, y, z) of any length.

    Args:
        quat: Quaternions, ``[*B, 4]``; zero gives NaN.

    Returns:
        Rotation matrices, ``[*B, 3, 3]``.
    """
    return torch.stack(quat_to_entries(quat.unbind(-1)), -1).unflatten(-1, (3, 3))


def quat_to_entries(quat: Sequence[Tensor]) -> tuple[Tensor, ...]:
    """Return the nine entries of `quat_to_matrix`, row by row.

    Args:
        quat: w, x, y, z of quaternions, of one shape.
    """
    w, x, y, z = quat
    # 2 for a unit quaternion.
    s = 2 / (w * w + x * x + y * y + z * z)
    return (
        1 - s * (y * y + z * z),
        s * (x * y - w * z),
        s * (x * z + w * y),
        s * (x * y + w * z),
        1 - s * (x * x + z * z),
        s * (y * z - w * x),
        s * (x * z - w * y),
        s * (y * z + w * x),
        1 - s * (x * x + y * y),
    )


def axis_vectors(quat: Tensor, axis: int, length: float = 1.0) -> Tensor:
    """Return a vector along one axis, repeated for each quaternion.

    Unlike a tensor made of Python numbers, it is not copied from the host.

    Args:
        quat: ``[*B, 4]``.
        axis: 0, 1 or 2.
        length: Length; negative for the opposite direction.

    Returns:
        ``[*B, 3]``.
    """
    vector = quat.new_zeros(*quat.shape[:-1], 3)
    vector[..., axis] = length
    return vector


def rotate(quat: Tensor, vector: Tensor) -> Tensor:
    """Return vectors rotated by unit quaternions (body to world).

    Args:
        quat: Unit quaternions (w, x, y, z), ``[*B, 4]``.
        vector: Vectors, ``[*B, 3]``.

    Returns:
        R(quat) vector, ``[*B, 3]``.
    """
    # v' = v + 2 w (u x v) + 2 u x (u x v)
    w, u = quat[..., :1], quat[..., 1:]
    t = 2 * torch.linalg.cross(u.expand_as(vector), vector)
    return vector + w * t + torch.linalg.cross(u.expand_as(t), t)


def rotate_inverse(quat: Tensor, vector: Tensor) -> Tensor:
    """Return vectors rotated by the inverse of unit quaternions (world to body).

    Args:
        quat: Unit quaternions (w, x, y, z), ``[*B, 4]``.
        vector: Vectors, ``[*B, 3]``.

    Returns:
        R(quat)^T vector, ``[*B, 3]``.
    """
    w, u = quat[..., :1], quat[..., 1:]
    t = 2 * torch.linalg.cross(u.expand_as(vector), vector)
    return vector - w * t + torch.linalg.cross(u.expand_as(t), t)
