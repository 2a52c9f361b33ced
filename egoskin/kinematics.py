"""Fast forward kinematics of some links of a pytorch-kinematics chain.

The `pytorch_kinematics.Chain` is the description, the public reference and the
oracle of the tests; this module evaluates only the branches that lead to the links
asked for, as a structure of arrays (the batch contiguous, one small array for each
matrix entry), which skips every multiplication by a constant 0 or 1.

Contract: all poses are relative to the root of the chain (the robot's base), whatever
offset the root itself has, so that they depend on the joint positions alone.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import pytorch_kinematics as pk
import torch
from torch import Tensor

from egoskin.compilation import sincos

Entry = Tensor | float
"""One matrix entry: a ``[B]`` tensor, or a constant of the robot."""


def pad_rows(rows: Tensor, multiple: int = 32) -> Tensor:
    """Return row indices padded to a multiple by repeating the first.

    Vectorised functions (``atan2``) round differently in the scalar tail of an array
    than in its body, which goes by two vectors: 32 float32 numbers with AVX-512.
    Subsets of rows are padded, so that a row's result does not depend on which other
    rows happen to be computed with it.

    Args:
        rows: Indices, ``[n]`` int64, n >= 1.
        multiple: Number of elements to pad to a multiple of.

    Returns:
        Indices, ``[ceil(n / multiple) * multiple]``.
    """
    extra = -rows.shape[0] % multiple
    return torch.cat((rows, rows[:1].expand(extra)))


def _mul(a: Entry, b: Entry) -> Entry:
    if not isinstance(a, Tensor):
        a, b = b, a
    if not isinstance(b, Tensor):
        if b == 0.0:
            return 0.0
        if b == 1.0:
            return a
    return a * b


def _add(a: Entry, b: Entry) -> Entry:
    if not isinstance(a, Tensor):
        a, b = b, a
    if not isinstance(b, Tensor) and b == 0.0:
        return a
    return a + b


def _dot(a: Sequence[Entry], b: Sequence[Entry]) -> Entry:
    return _add(_add(_mul(a[0], b[0]), _mul(a[1], b[1])), _mul(a[2], b[2]))


Matrix = list[list[Entry]]
Frame = tuple[Matrix, list[Entry]]
"""Rotation (rows of entries) and position."""


def _matmul(a: Matrix, b: Matrix) -> Matrix:
    columns = list(zip(*b, strict=True))
    return [[_dot(row, column) for column in columns] for row in a]


def _axis_rotation(axis: Sequence[float], s: Tensor, c: Tensor) -> Matrix:
    """Rodrigues' formula: R = c I + s [a]x + (1 - c) a a^T."""
    x, y, z = axis
    skew = [[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]]
    result: Matrix = []
    for i in range(3):
        row: list[Entry] = []
        for j in range(3):
            aa = axis[i] * axis[j]
            # c (delta - a a) + a a + s skew
            entry = _mul(c, float(i == j) - aa)
            row.append(_add(_add(entry, aa), _mul(s, skew[i][j])))
        result.append(row)
    return result


def _shift(frame: Frame, offset: Sequence[Entry]) -> list[Entry]:
    """Return where a point given in a frame is."""
    rotation, position = frame
    return [
        _add(p, _dot(row, offset)) for p, row in zip(position, rotation, strict=True)
    ]


def _compose(frame: Frame, offset: Frame) -> Frame:
    """Return a frame given in another frame."""
    return _matmul(frame[0], offset[0]), _shift(frame, offset[1])


def _constant(transform: pk.Transform3d | None) -> Frame:
    """Rotation and translation of a fixed offset; rounding noise becomes 0 or 1."""
    if transform is None:
        return [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]], [0.0, 0.0, 0.0]
    matrix = transform.get_matrix()[0].double()

    def clean(value: float) -> float:
        nearest = float(round(value))
        return nearest if abs(value - nearest) < 1e-15 else value

    rotation: Matrix = [[clean(v) for v in row[:3]] for row in matrix[:3].tolist()]
    return rotation, [clean(v) for v in matrix[:3, 3].tolist()]


class _Step(NamedTuple):
    """How a frame follows from its parent: a fixed offset, then a joint."""

    parent: int
    offset: Frame
    joint_type: str
    axis: list[float]
    joint: int


class LinkKinematics:
    """Positions and rotations of links relative to the base, from joint positions.

    Joint positions are in the order of ``chain.get_joint_parameter_names()``, [rad] or,
    for a prismatic joint, [m].

    Args:
        chain: Chain of the robot; its root is the base.
        links: Names of the links wanted, in the order of the results.

    Raises:
        ValueError: If a link is not in the chain.
    """

    def __init__(self, chain: pk.Chain, links: Sequence[str]) -> None:
        self.links = tuple(links)
        joint_names = chain.get_joint_parameter_names()
        self.num_joints = len(joint_names)
        self._steps: list[_Step] = []
        slots: dict[str, int] = {}
        root = chain._root  # the public methods return frames by name only

        def visit(frame: pk.Frame, parent: int) -> bool:
            """Append the evaluation of a frame if it leads to a wanted link."""
            mark = len(self._steps)
            slot = parent
            if frame is not root:
                slot = mark + 1
                joint = frame.joint
                fixed = joint.joint_type == "fixed"
                self._steps.append(
                    _Step(
                        parent,
                        _compose(_constant(frame.link.offset), _constant(joint.offset)),
                        joint.joint_type,
                        joint.axis.double().tolist(),
                        -1 if fixed else joint_names.index(joint.name),
                    )
                )
            wanted = frame.name in self.links
            if wanted:
                slots[frame.name] = slot
            below = [visit(child, slot) for child in frame.children]
            if not wanted and not any(below):
                del self._steps[mark:]
                return False
            return True

        visit(root, 0)
        missing = [name for name in self.links if name not in slots]
        if missing:
            raise ValueError(
                f"link {missing[0]!r} is not in the chain; its links are "
                f"{', '.join(chain.get_link_names())}"
            )
        self._slots = [slots[name] for name in self.links]
        # The joints that matter; steps count among them from here on.
        used = {s.joint for s in self._steps if s.joint_type != "fixed"}
        self._joints = sorted(used)
        self._steps = [
            s._replace(joint=self._joints.index(s.joint)) if s.joint in used else s
            for s in self._steps
        ]

        self._turns = _turns(self._steps, len(self._joints))

    def reach(self) -> list[float]:
        """Return how far each link's origin can be from the base [m], at most.

        Infinite behind a prismatic joint.
        """
        farthest = [0.0]
        for step in self._steps:
            sliding = step.joint_type == "prismatic"
            length = math.inf if sliding else math.dist(step.offset[1], (0, 0, 0))
            farthest.append(farthest[step.parent] + length)
        return [farthest[slot] for slot in self._slots]

    def link_frames(self, joint_pos: Tensor) -> list[Frame]:
        """Return (rotation, position) of each link, as matrices of entries.

        Args:
            joint_pos: Joint positions, ``[B, J]``.

        Returns:
            For each link a 3 x 3 nested list and a list of three [m], whose entries
            are ``[B]`` tensors or, where they cannot change, floats.
        """
        return self.frames_from(*self.trig(joint_pos))

    def trig(self, joint_pos: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return (sine, cosine, value) of the U joints that matter, ``[U, B]`` each.

        Args:
            joint_pos: Joint positions, ``[B, J]``.

        Raises:
            ValueError: If J is not the chain's number of joints.
        """
        joints = self._used(joint_pos)
        return *sincos(joints), joints

    def _used(self, joint_pos: Tensor) -> Tensor:
        """Return the positions of the joints that lead to the links, ``[U, B]``."""
        if joint_pos.shape[-1] != self.num_joints:
            raise ValueError(
                f"joint positions must be [B, {self.num_joints}], one column for each "
                f"joint of the chain, got {list(joint_pos.shape)}"
            )
        return joint_pos.t()[self._joints]

    def frames_from(self, sin: Tensor, cos: Tensor, joints: Tensor) -> list[Frame]:
        """Return `link_frames` from what `trig` returns, by sums and products alone.

        Those round alike whoever evaluates them, so this part can be compiled.

        Args:
            sin: Sines of the joint positions, ``[U, B]``.
            cos: Cosines of the joint positions, ``[U, B]``.
            joints: Joint positions, ``[U, B]``.

        Returns:
            As `link_frames`.
        """
        return self._evaluate(_constant(None), sin, cos, joints)

    def _evaluate(
        self, root: Frame, sin: Tensor, cos: Tensor, joints: Tensor
    ) -> list[Frame]:
        """Return the links' frames, given the root's: with any number of rows."""
        frames = [root]
        for step in self._steps:
            rotation, position = frame = _compose(frames[step.parent], step.offset)
            if step.joint_type == "revolute":
                turn = _axis_rotation(step.axis, sin[step.joint], cos[step.joint])
                rotation = _matmul(rotation, turn)
            elif step.joint_type == "prismatic":
                position = _shift(
                    frame, [_mul(joints[step.joint], a) for a in step.axis]
                )
            frames.append((rotation, position))
        return [frames[slot] for slot in self._slots]

    def poses_b(self, joint_pos: Tensor) -> tuple[Tensor, Tensor]:
        """Return link positions ``[B, L, 3]`` [m] and rotations ``[B, L, 3, 3]``.

        Args:
            joint_pos: Joint positions, ``[B, J]``.

        Returns:
            Position and rotation matrix of each link in the base frame.
        """
        rotation, position = self._stacked_frames(joint_pos)
        return position.movedim(-1, 0), rotation.movedim(-1, 0)

    def _stacked_frames(self, joint_pos: Tensor) -> tuple[Tensor, Tensor]:
        """Return rotations ``[L, 3, 3, B]`` and positions ``[L, 3, B]`` of the links.

        Those of `link_frames` to rounding, all frames of one depth in one go: a tenth
        of the calls, and calls are what few rows cost.
        """
        used = self._used(joint_pos)
        # What does not turn turns by 0.
        joints = torch.cat((used, joint_pos.new_zeros(1, len(joint_pos))))
        joints = joints[self._turns.joint][:, None]
        constant, by_cos, by_sin, offset, slide = (
            x.to(joint_pos) for x in self._turns.matrices
        )
        turn = joints[:, None]
        relative = constant + by_cos * turn.cos() + by_sin * turn.sin()
        shift = offset + slide * joints
        rotation = relative.new_zeros(len(self._steps) + 1, 3, 3, len(joint_pos))
        rotation[0] = torch.eye(3)[:, :, None]
        position = rotation.new_zeros(rotation[:, 0].shape)
        for steps, parents in self._turns.levels:
            r, p = rotation[parents], position[parents]
            q = relative[steps]
            rotation[steps + 1] = (
                r[:, :, :1] * q[:, :1]
                + r[:, :, 1:2] * q[:, 1:2]
                + r[:, :, 2:] * q[:, 2:]
            )
            position[steps + 1] = _moved(r, p, shift[steps])
        return rotation[self._slots], position[self._slots]


def _moved(rotation: Tensor, position: Tensor, point: Tensor) -> Tensor:
    """Return R x + p, ``[n, 3, B]``, summed in one order whatever the batch."""
    x, y, z = (rotation[:, :, i] * point[:, i : i + 1] for i in range(3))
    return position + ((x + y) + z)


class _Turns(NamedTuple):
    """The steps as tensors; R = constant + by_cos cos q + by_sin sin q."""

    joint: Tensor
    """Joint of each step, or the number of joints for none, ``[n]``."""
    matrices: tuple[Tensor, ...]
    """Those three ``[n, 3, 3, 1]``; then offset, and way of a slide, ``[n, 3, 1]``."""
    levels: list[tuple[Tensor, Tensor]]
    """Steps of each depth and the slots of their parents, from the root on."""


def _turns(steps: Sequence[_Step], num_joints: int) -> _Turns:
    """Return steps as tensors."""
    one, level = torch.eye(3, dtype=torch.float64), [0]
    parts: list[list[Tensor]] = [[], [], [], [], []]
    for step in steps:
        level.append(level[step.parent] + 1)
        axis = torch.tensor(step.axis, dtype=torch.float64)
        offset, shift = (torch.tensor(x, dtype=torch.float64) for x in step.offset)
        revolute = step.joint_type == "revolute"
        # Rodrigues: a a^T + (1 - a a^T) cos q + [a]x sin q, after the fixed offset.
        along = torch.outer(axis, axis) if revolute else one
        skew = torch.linalg.cross(axis.expand(3, 3), one).t() * float(revolute)
        sliding = offset @ axis * float(step.joint_type == "prismatic")
        terms = (offset @ along, offset @ (one - along), offset @ skew, shift, sliding)
        for part, term in zip(parts, terms, strict=True):
            part.append(term[..., None])
    shapes = [(3, 3)] * 3 + [(3,)] * 2
    depths = range(1, max(level) + 1)
    numbers = [[i for i, d in enumerate(level[1:]) if d == depth] for depth in depths]
    return _Turns(
        torch.tensor(
            [s.joint if s.joint >= 0 else num_joints for s in steps], dtype=torch.int64
        ),
        tuple(
            torch.stack(part) if part else one.new_zeros(0, *shape, 1)
            for part, shape in zip(parts, shapes, strict=True)
        ),
        [
            (torch.tensor(level), torch.tensor([steps[i].parent for i in level]))
            for level in numbers
        ],
    )


def quat_to_matrix(quat: Tensor) -> Tensor:
    """Return the rotation matrix of unit quaternions (w, x, y, z).

    Args:
        quat: Unit quaternions, ``[*B, 4]``.

    Returns:
        Rotation matrices, ``[*B, 3, 3]``.
    """
    return torch.stack(quat_to_entries(quat.unbind(-1)), -1).unflatten(-1, (3, 3))


def quat_to_entries(quat: Sequence[Tensor]) -> tuple[Tensor, ...]:
    """Return the nine entries of `quat_to_matrix`, row by row.

    Args:
        quat: w, x, y, z of unit quaternions, of one shape.
    """
    w, x, y, z = quat
    return (
        1 - 2 * (y * y + z * z),
        2 * (x * y - w * z),
        2 * (x * z + w * y),
        2 * (x * y + w * z),
        1 - 2 * (x * x + z * z),
        2 * (y * z - w * x),
        2 * (x * z - w * y),
        2 * (y * z + w * x),
        1 - 2 * (x * x + y * y),
    )


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
