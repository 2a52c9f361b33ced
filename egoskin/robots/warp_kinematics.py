"""`LinkKinematics` as a kernel of Warp, for CUDA: float32, without derivatives.

Contract: every number has the bits of the PyTorch code on the CPU (except for the sign
of zero). Sums are therefore in its order, and a module with these functions is compiled
without fused multiply-add. Warp's CPU device runs the same code; it is meant for tests.
"""

# In a kernel float(0.0) is a variable and 0.0 a constant, and types are values. Type
# checkers know neither its operators nor its overloads.
# ruff: noqa: UP018
# pyright: reportInvalidTypeForm=false, reportGeneralTypeIssues=false
# pyright: reportArgumentType=false, reportAssignmentType=false, reportCallIssue=false
# pyright: reportOperatorIssue=false, reportReturnType=false

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
import warp as wp  # pyright: ignore[reportMissingImports]
from torch import Tensor

from egoskin.gpu import init_warp, launch
from egoskin.robots.kinematics import Steps
from egoskin.rounding import HIGH, LOW, MIDDLE

init_warp()
wp.set_module_options({"enable_backward": False, "fuse_fp": False})

_Ints = wp.array(dtype=wp.int32)
_Vectors, _Matrices = wp.array(dtype=wp.vec3), wp.array(dtype=wp.mat33)
_Floats2 = wp.array(dtype=wp.float32, ndim=2)
_Vectors2, _Matrices2 = (wp.array(dtype=t, ndim=2) for t in (wp.vec3, wp.mat33))


@wp.struct
class Chain:
    """The fields of `Steps`, of ``n`` steps."""

    parent: _Ints
    joint: _Ints
    constant: _Matrices
    by_cos: _Matrices
    by_sin: _Matrices
    shift: _Vectors
    slide: _Vectors


# Taylor coefficients of `egoskin.rounding.sincos` in float32, the last term first.
_SINE = [(-1) ** i / math.factorial(2 * i + 1) for i in range(4, 0, -1)]
_COSINE = [(-1) ** (i + 1) / math.factorial(2 * i + 2) for i in range(4, 0, -1)]


@wp.func
def _sincos(x: float) -> wp.vec2:
    """(Sine, cosine), as `egoskin.rounding.sincos`."""
    n = wp.rint(x * wp.static(2.0 / math.pi))
    r = ((x - n * wp.static(HIGH)) - n * wp.static(MIDDLE)) - n * wp.static(LOW)
    z = r * r
    s = float(0.0)
    c = float(0.0)
    for i in range(4):
        s = (s + wp.static(_SINE[i])) * z
        c = (c + wp.static(_COSINE[i])) * z
    s = r + r * s
    c = 1.0 + z * (c - 0.5)
    half = wp.floor(n * 0.5)
    sign = 1.0 - 2.0 * (half - 2.0 * wp.floor(half * 0.5))
    if n - 2.0 * half > 0.5:
        return wp.vec2(c * sign, -s * sign)
    return wp.vec2(s * sign, c * sign)


@wp.func
def _product(a: wp.mat33, b: wp.mat33) -> wp.mat33:
    """A b. Warp's own product of two matrices uses fused multiply-add."""
    return wp.matrix_from_cols(
        a * wp.vec3(b[0, 0], b[1, 0], b[2, 0]),
        a * wp.vec3(b[0, 1], b[1, 1], b[2, 1]),
        a * wp.vec3(b[0, 2], b[1, 2], b[2, 2]),
    )


@wp.func
def place_frames(
    chain: Chain,
    joint_pos: _Floats2,
    row: int,
    rotation: _Matrices2,
    position: _Vectors2,
):
    """Write the frames of a row in the base frame; see `Steps`.

    Args:
        chain: The steps.
        joint_pos: Joint positions, ``[B, J]``.
        row: The row.
        rotation: Rotations, ``[n + 1, B]``.
        position: Positions [m], ``[n + 1, B]``.
    """
    rotation[0, row] = wp.identity(3, dtype=float)
    position[0, row] = wp.vec3()
    for step in range(chain.joint.shape[0]):
        q = float(0.0)
        if chain.joint[step] >= 0:
            q = joint_pos[row, chain.joint[step]]
        turned = _sincos(q)
        turn = chain.constant[step] + chain.by_cos[step] * turned[1]
        turn = turn + chain.by_sin[step] * turned[0]
        way = chain.shift[step] + chain.slide[step] * q
        start = chain.parent[step]
        r = rotation[start, row]
        rotation[step + 1, row] = _product(r, turn)
        position[step + 1, row] = position[start, row] + r * way


@wp.kernel
def _place_all(
    chain: Chain, joint_pos: _Floats2, rotation: _Matrices2, position: _Vectors2
):
    """Write the frames of all rows."""
    place_frames(chain, joint_pos, wp.tid(), rotation, position)


def filled(kind: wp.Struct, values: Mapping[str, Any], device: torch.device) -> Any:
    """Return an instance of a struct.

    Args:
        kind: A struct of integers and arrays.
        values: Its values by name; missing ones are 0 or empty.
        device: Device of the arrays.
    """
    struct, on = kind(), wp.device_from_torch(device)
    for name, variable in kind.vars.items():
        value, array = values.get(name), variable.type
        if not isinstance(array, wp.array):
            value = int(value or 0)
        elif value is None:
            value = wp.empty((0,) * array.ndim, dtype=array.dtype, device=on)
        else:
            # The numbers of each entry after the array's own dimensions.
            entry = {wp.vec3: (3,), wp.mat33: (3, 3)}.get(array.dtype, ())
            shape = (*np.shape(value)[: array.ndim - 1], -1, *entry)
            value = wp.array(np.reshape(value, shape), dtype=array.dtype, device=on)
        setattr(struct, name, value)
    # The arrays were copied on Warp's stream; kernels run on PyTorch's.
    wp.synchronize_device(on)
    return struct


class WarpKinematics:
    """Frames of a chain on one device.

    Args:
        steps: The steps of the chain.
        device: A CUDA device, or the CPU.
    """

    def __init__(self, steps: Steps, device: torch.device) -> None:
        self._chain, self._device = filled(Chain, steps._asdict(), device), device

    def frames(self, joint_pos: Tensor) -> tuple[Tensor, Tensor]:
        """Return all frames, in the base frame.

        Args:
            joint_pos: Joint positions, ``[B, J]`` float32.

        Returns:
            Rotations ``[n + 1, B, 3, 3]`` and positions [m] ``[n + 1, B, 3]``.
        """
        shape = len(self._chain.joint) + 1, len(joint_pos)
        rotation = joint_pos.new_empty(*shape, 3, 3)
        position = joint_pos.new_empty(*shape, 3)
        inputs = (
            self._chain,
            wp.from_torch(joint_pos.contiguous()),
            wp.from_torch(rotation, dtype=wp.mat33),
            wp.from_torch(position, dtype=wp.vec3),
        )
        launch(_place_all, len(joint_pos), inputs, self._device)
        return rotation, position
