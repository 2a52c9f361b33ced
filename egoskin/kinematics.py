"""Fast forward kinematics of some links of a pytorch-kinematics chain.

The `pytorch_kinematics.Chain` is the description, the public reference and the
oracle of the tests; this module evaluates only the branches that lead to the links
asked for, as a structure of arrays (the batch contiguous, one small array for each
matrix entry), which skips every multiplication by a constant 0 or 1.

Contract: all poses are relative to the root of the chain (the robot's base), whatever
offset the root itself has, so that they depend on the joint positions alone.
"""

from __future__ import annotations

from collections.abc import Sequence

import pytorch_kinematics as pk
import torch
from torch import Tensor

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


def _matmul(a: Matrix, b: Matrix) -> Matrix:
    columns = list(zip(*b, strict=True))
    return [[_dot(row, column) for column in columns] for row in a]


def _axis_rotation(axis: Sequence[float], angle: Tensor) -> Matrix:
    """Rodrigues' formula: R = c I + s [a]x + (1 - c) a a^T."""
    c, s = angle.cos(), angle.sin()
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


def _constant(transform: pk.Transform3d | None) -> tuple[Matrix, list[Entry]]:
    """Rotation and translation of a fixed offset; rounding noise becomes 0 or 1."""
    if transform is None:
        return [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]], [0.0, 0.0, 0.0]
    matrix = transform.get_matrix()[0].double()

    def clean(value: float) -> float:
        nearest = float(round(value))
        return nearest if abs(value - nearest) < 1e-9 else value

    rotation: Matrix = [[clean(v) for v in row[:3]] for row in matrix[:3].tolist()]
    return rotation, [clean(v) for v in matrix[:3, 3].tolist()]


class LinkKinematics:
    """Positions and rotations of links relative to the base, from joint positions.

    Args:
        chain: Chain of the robot; its root is the base.
        links: Names of the links wanted, in the order of the results.

    Raises:
        ValueError: If a link is not in the chain.
    """

    def __init__(self, chain: pk.Chain, links: Sequence[str]) -> None:
        self.links = tuple(links)
        joint_names = chain.get_joint_parameter_names()
        self._steps: list[tuple] = []
        slots: dict[str, int] = {}
        root = chain._root  # the public methods return frames by name only

        def visit(frame: pk.Frame, parent: int) -> bool:
            """Append the evaluation of a frame if it leads to a wanted link."""
            mark = len(self._steps)
            slot = parent
            if frame is not root:
                slot = mark
                joint = frame.joint
                revolute = joint.joint_type == "revolute"
                self._steps.append(
                    (
                        parent,
                        _constant(frame.link.offset),
                        _constant(joint.offset),
                        joint.axis.double().tolist() if revolute else None,
                        joint_names.index(joint.name) if revolute else -1,
                    )
                )
                if joint.joint_type not in ("revolute", "fixed"):
                    raise ValueError(
                        f"joint {joint.name!r} is {joint.joint_type}; only revolute "
                        "and fixed joints are supported"
                    )
            wanted = frame.name in self.links
            if wanted:
                slots[frame.name] = slot
            below = [visit(child, slot) for child in frame.children]
            if not wanted and not any(below):
                del self._steps[mark:]
                return False
            return True

        visit(root, -1)
        missing = [name for name in self.links if name not in slots]
        if missing:
            raise ValueError(
                f"link {missing[0]!r} is not in the chain; its links are "
                f"{', '.join(chain.get_link_names())}"
            )
        self._slots = [slots[name] for name in self.links]

    def link_frames(self, joint_pos: Tensor) -> list[tuple[Matrix, list[Entry]]]:
        """Return (rotation, position) of each link, as matrices of entries.

        Args:
            joint_pos: Joint positions [rad] in the order of the chain, ``[B, J]``.

        Returns:
            For each link a 3 x 3 nested list and a list of three, whose entries are
            ``[B]`` tensors or, where they cannot change, floats.
        """
        joints = joint_pos.t().contiguous()
        frames: list[tuple[Matrix, list[Entry]]] = []
        for parent, link_offset, joint_offset, axis, index in self._steps:
            chained = [frames[parent]] if parent >= 0 else []
            chained += [link_offset, joint_offset]
            rotation, position = chained[0]
            for r, p in chained[1:]:
                position = [_add(position[i], _dot(rotation[i], p)) for i in range(3)]
                rotation = _matmul(rotation, r)
            if axis is not None:
                rotation = _matmul(rotation, _axis_rotation(axis, joints[index]))
            frames.append((rotation, position))
        identity = _constant(None)
        return [frames[slot] if slot >= 0 else identity for slot in self._slots]

    def points_b(
        self, joint_pos: Tensor, offsets: Sequence[Sequence[Sequence[float]]]
    ) -> Tensor:
        """Return points fixed on the links, in the base frame.

        Args:
            joint_pos: Joint positions [rad], ``[B, J]``.
            offsets: For each link the points in its frame [m], n_l x 3.

        Returns:
            Positions [m], ``[3, S, B]`` with S = sum of n_l, link by link: the batch
            is last, as the kernels want it.
        """
        parts: list[list[Tensor]] = [[], [], []]
        batch = joint_pos.shape[0]
        for (rotation, position), local in zip(
            self.link_frames(joint_pos), offsets, strict=True
        ):
            if len(local) == 0:
                continue
            columns = torch.as_tensor(
                local, dtype=joint_pos.dtype, device=joint_pos.device
            ).t()[:, :, None]
            for i in range(3):
                total: Entry = _dot(rotation[i], list(columns))
                total = _add(total, position[i])
                assert isinstance(total, Tensor)
                parts[i].append(total.expand(len(local), batch))
        return torch.stack([torch.cat(part) for part in parts])

    def poses_b(self, joint_pos: Tensor) -> tuple[Tensor, Tensor]:
        """Return link positions ``[B, L, 3]`` [m] and rotations ``[B, L, 3, 3]``.

        Args:
            joint_pos: Joint positions [rad], ``[B, J]``.

        Returns:
            Position and rotation matrix of each link in the base frame.
        """
        batch = joint_pos.shape[0]

        def fill(entry: Entry) -> Tensor:
            if isinstance(entry, Tensor):
                return entry
            return joint_pos.new_full((batch,), entry)

        frames = self.link_frames(joint_pos)
        position = torch.stack(
            [torch.stack([fill(e) for e in p], -1) for _, p in frames], 1
        )
        rotation = torch.stack(
            [
                torch.stack([torch.stack([fill(e) for e in row], -1) for row in r], 1)
                for r, _ in frames
            ],
            1,
        )
        return position, rotation


def quat_to_matrix(quat: Tensor) -> Tensor:
    """Return the rotation matrix of unit quaternions (w, x, y, z).

    Args:
        quat: Unit quaternions, ``[*B, 4]``.

    Returns:
        Rotation matrices, ``[*B, 3, 3]``.
    """
    w, x, y, z = quat.unbind(-1)
    return torch.stack(
        (
            1 - 2 * (y * y + z * z),
            2 * (x * y - w * z),
            2 * (x * z + w * y),
            2 * (x * y + w * z),
            1 - 2 * (x * x + z * z),
            2 * (y * z - w * x),
            2 * (x * z - w * y),
            2 * (y * z + w * x),
            1 - 2 * (x * x + y * y),
        ),
        -1,
    ).unflatten(-1, (3, 3))


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
