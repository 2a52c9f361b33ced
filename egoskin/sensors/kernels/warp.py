"""The sensors' kernels for CUDA, in Warp: balls, a transparent robot, float32.

Two launches replace some 180 operations of PyTorch: one with a thread for each row,
which places the balls in the frames of the links, and one with a thread for each row
and sensor, which reads them.

Contract: every number has the bits of the PyTorch code on the CPU (except for the sign
of zero). Sums are therefore in its order, and the module is compiled without fused
multiply-add. Warp's CPU device runs the same code; it is meant for tests.
"""

# In a kernel float(0.0) is a variable and 0.0 a constant, and types are values. Type
# checkers know neither its operators nor its overloads.
# ruff: noqa: UP018
# pyright: reportInvalidTypeForm=false, reportGeneralTypeIssues=false
# pyright: reportArgumentType=false, reportAssignmentType=false, reportCallIssue=false
# pyright: reportOperatorIssue=false, reportReturnType=false

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal

import torch
import warp as wp  # pyright: ignore[reportMissingImports]
from torch import Tensor

from egoskin.gpu import launch
from egoskin.robots.warp_kinematics import Chain, filled, place_frames

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

# Types of arrays.
_Ints, _Floats = wp.array(dtype=wp.int32), wp.array(dtype=wp.float32)
_Vectors, _Matrices = wp.array(dtype=wp.vec3), wp.array(dtype=wp.mat33)
_Floats2, _Floats3 = (wp.array(dtype=wp.float32, ndim=n) for n in (2, 3))
_Flags2 = wp.array(dtype=wp.bool, ndim=2)
_Vectors2, _Vectors3 = (wp.array(dtype=wp.vec3, ndim=n) for n in (2, 3))
_Matrices2 = wp.array(dtype=wp.mat33, ndim=2)


@wp.struct
class Tables:
    """`Tables` of kernels.cpp, without the chain; an array is empty if null there."""

    links: wp.int32
    objects: wp.int32
    beams: wp.int32
    reduce: wp.int32
    apart: wp.int32
    frame: _Ints
    link: _Ints
    grid: _Ints
    depth: _Ints
    axes: _Matrices
    offset: _Vectors
    range: _Floats
    radius: _Floats
    squared: _Floats
    bound: _Floats
    cos_half: _Floats
    reach: _Floats
    pyramid: _Floats2
    directions: _Floats3


@wp.func
def _least(a: float, b: float) -> float:
    """Minimum; NaN if either is NaN."""
    if b < a or b != b:
        return b
    return a


@wp.kernel
def _place(
    t: Tables,
    chain: Chain,
    base_pose: _Floats2,
    joint_pos: _Floats2,
    object_pose: _Floats3,
    rotation: _Matrices2,
    position: _Vectors2,
    centre: _Vectors3,
):
    """Write the objects' centres in the links' frames [m], ``[B, O, L]``.

    ``rotation`` and ``position`` hold the frames of all steps meanwhile,
    ``[steps + 1, B]``.
    """
    row = wp.tid()
    place_frames(chain, joint_pos, row, rotation, position)
    # ProximitySensor._poison: NaN if any number is not finite.
    poison = float(0.0)
    for i in range(joint_pos.shape[1]):
        poison += joint_pos[row, i] * 0.0
    for i in range(7):
        poison += base_pose[row, i] * 0.0
    # quat_to_entries; also NaN for a quaternion of 0.
    w = base_pose[row, 3]
    x = base_pose[row, 4]
    y = base_pose[row, 5]
    z = base_pose[row, 6]
    s = 2.0 / (w * w + x * x + y * y + z * z)
    turn = wp.mat33(
        1.0 - s * (y * y + z * z),
        s * (x * y - w * z),
        s * (x * z + w * y),
        s * (x * y + w * z),
        1.0 - s * (x * x + z * z),
        s * (y * z - w * x),
        s * (x * z - w * y),
        s * (y * z + w * x),
        1.0 - s * (x * x + y * y),
    )
    # ProximitySensor.views
    for o in range(t.objects):
        own = float(poison)
        for i in range(7):
            own += object_pose[row, o, i] * 0.0
        away = wp.vec3()
        for i in range(3):
            away[i] = object_pose[row, o, i] + own - base_pose[row, i]
        away = wp.transpose(turn) * away
        for link in range(t.links):
            frame = t.frame[link]
            gap = away - position[frame, row]
            centre[row, o, link] = wp.transpose(rotation[frame, row]) * gap


@wp.kernel
def _read_field(
    t: Tables, centre: _Vectors3, active: _Flags2, out: _Floats3, detected: _Flags2
):
    """Write the distances of `FieldSensor` [m], ``[1 or O, B, S]``."""
    row, sensor = wp.tid()
    nearest = float(wp.inf)
    for o in range(t.objects):
        distance = float(wp.inf)
        if active[row, o]:
            v = centre[row, o, t.link[sensor]] - t.offset[sensor]
            reach = wp.sqrt(wp.dot(v, v))
            distance = reach - t.radius[o]
            if distance < 0.0:
                distance = 0.0
            if t.cos_half.shape[0] > 0:
                along = wp.dot(t.axes[sensor][2], v)
                if along < t.cos_half[sensor] * reach and not distance <= 0.0:
                    distance = wp.inf
            if distance > t.range[sensor]:
                distance = wp.inf
        if distance != wp.inf:
            detected[row, o] = True
        if t.apart != 0:
            out[o, row, sensor] = distance
        nearest = _least(nearest, distance)
    if t.apart == 0:
        out[0, row, sensor] = nearest


@wp.func
def _sees(t: Tables, o: int, sensor: int, c: wp.vec3) -> bool:
    """Whether any beam can hit a ball, as in find_pairs of kernels.cpp.

    Args:
        t: Tables.
        o: Object.
        sensor: Sensor.
        c: Centre of the object in the sensor's frame [m].
    """
    bound = t.bound[o]
    farthest = t.reach[sensor] + bound
    far = wp.dot(c, c) >= farthest * farthest
    # Cosines, then sines.
    x = wp.abs(c[0]) * t.pyramid[sensor, 0] - c[2] * t.pyramid[sensor, 2]
    y = wp.abs(c[1]) * t.pyramid[sensor, 1] - c[2] * t.pyramid[sensor, 3]
    # Also for NaN.
    return not (far or x >= bound or y >= bound or -c[2] >= bound)


@wp.func
def _beam(t: Tables, o: int, sensor: int, p: wp.vec3, d: wp.vec3) -> float:
    """Reading of a beam from ``p`` along ``d`` in the frame of a ball [m]."""
    # _ball_interval and first_hit of egoskin/shapes.py
    along = -wp.dot(p, d)
    q = p + along * d
    inside = t.squared[o] - wp.dot(q, q)
    half = wp.sqrt(inside)
    distance = along - half
    if distance < 0.0:
        distance = 0.0
    if inside < 0.0 or along + half < 0.0:
        distance = wp.inf
    if t.depth.shape[0] > 0 and t.depth[sensor] != 0:
        distance = distance * d[2]
    if distance > t.range[sensor]:
        distance = wp.inf
    return distance


@wp.kernel
def _read_ray(
    t: Tables, centre: _Vectors3, active: _Flags2, out: _Floats3, detected: _Flags2
):
    """Write the hits of `RaySensor` [m], ``[1 or O, B, S K]`` (reduced: ``S``).

    All other readings must already be infinite.
    """
    row, sensor = wp.tid()
    for o in range(t.objects):
        if active[row, o]:
            v = centre[row, o, t.link[sensor]] - t.offset[sensor]
            c = t.axes[sensor] * v
            if _sees(t, o, sensor, c):
                plane = o * t.apart
                grid = t.grid[sensor]
                nearest = float(wp.inf)
                for k in range(t.beams):
                    d = wp.vec3(
                        t.directions[grid, 0, k],
                        t.directions[grid, 1, k],
                        t.directions[grid, 2, k],
                    )
                    distance = _beam(t, o, sensor, -c, d)
                    nearest = _least(nearest, distance)
                    if t.reduce == 0:
                        at = sensor * t.beams + k
                        out[plane, row, at] = _least(out[plane, row, at], distance)
                if nearest != wp.inf:
                    detected[row, o] = True
                if t.reduce != 0:
                    out[plane, row, sensor] = _least(out[plane, row, sensor], nearest)


class WarpKernels:
    """The sensors' kernels on one device.

    Args:
        kind: Coverage of all sensors.
        constants: Entries of `Tables` and `Chain`; missing ones are 0 or empty.
        device: A CUDA device, or the CPU.
    """

    def __init__(
        self,
        kind: Literal["field", "ray"],
        constants: Mapping[str, Any],
        device: torch.device,
    ) -> None:
        self._kernel = _read_field if kind == "field" else _read_ray
        self._tables = filled(Tables, constants, device)
        self._chain = filled(Chain, constants, device)
        self._device, self._sensors = device, constants["sensors"]

    def measure(self, inputs: Sequence[Tensor], out: Tensor, detected: Tensor) -> None:
        """Write readings and detections.

        Args:
            inputs: Base pose, joint positions, object poses, active flags.
            out: Readings [m], contiguous.
            detected: ``[B, O]``, contiguous; must be all False.
        """
        base_pose, joint_pos, object_pose, active = (x.contiguous() for x in inputs)
        rows, objects = active.shape
        tables = self._tables
        frames = len(self._chain.joint) + 1
        rotation = out.new_empty(frames, rows, 3, 3)
        position = out.new_empty(frames, rows, 3)
        centre = out.new_empty(rows, objects, tables.links, 3)
        if self._kernel is _read_ray:
            out.fill_(torch.inf)
        points = wp.from_torch(centre, dtype=wp.vec3)
        self._launch(
            *(_place, rows, self._chain),
            *map(wp.from_torch, (base_pose, joint_pos, object_pose)),
            wp.from_torch(rotation, dtype=wp.mat33),
            wp.from_torch(position, dtype=wp.vec3),
            points,
        )
        # Without `apart` a single plane, of all readings of a row.
        planes = objects if tables.apart else 1
        flat = out.view(planes, rows, out.numel() // max(planes * rows, 1))
        self._launch(
            *(self._kernel, (rows, self._sensors), points),
            *map(wp.from_torch, (active, flat, detected)),
        )

    def hits(self, inputs: Sequence[Tensor]) -> tuple[Tensor, Tensor]:
        """Return the result of `RaySensor.hits`.

        Args:
            inputs: As in `measure`.
        """
        active = inputs[3]
        grid = inputs[0].new_empty(len(active), self._sensors * self._tables.beams)
        self.measure(inputs, grid, torch.zeros_like(active))
        # NaN counts as a hit.
        place = (grid.view(-1) != torch.inf).nonzero()[:, 0]
        return place, grid.view(-1)[place]

    def _launch(self, kernel: wp.Kernel, dim: int | tuple[int, ...], *inputs) -> None:
        launch(kernel, dim, (self._tables, *inputs), self._device)
