"""Warp's kernels before, between and after the physics steps of a control step.

With them a control step consists of launches of Warp only, and is a single CUDA graph.
Each has a thread for each row.
"""

# In a kernel float(0.0) is a variable and 0.0 a constant, and types are values. Type
# checkers do not know its operators.
# ruff: noqa: UP018
# pyright: reportInvalidTypeForm=false, reportGeneralTypeIssues=false
# pyright: reportArgumentType=false, reportOperatorIssue=false

from __future__ import annotations

from typing import Any

import mujoco_warp as mjw  # pyright: ignore[reportMissingImports]
import warp as wp  # pyright: ignore[reportMissingImports]

from egoskin.envs.physics.contract import Scene
from egoskin.envs.physics.model import MAX_SPEED, PARKING

wp.set_module_options({"enable_backward": False})

_Flags, _Floats, _Ints = (wp.array(dtype=t) for t in (wp.bool, wp.float32, wp.int32))
_Flags2 = wp.array(dtype=wp.bool, ndim=2)
_Floats2 = wp.array(dtype=wp.float32, ndim=2)
_Ranges2 = wp.array(dtype=wp.vec2, ndim=2)

# Buffer overflows that invalidate the simulation of a row.
_LOST = int(
    mjw.OverflowType.NEFC
    | mjw.OverflowType.NJMAX_NNZ
    | mjw.OverflowType.BROADPHASE
    | mjw.OverflowType.NARROWPHASE
    | mjw.OverflowType.CCD
    | mjw.OverflowType.CONTACT_MATCH
)


@wp.struct
class Outcome:
    """What a control step results in, apart from the state; ``B`` rows."""

    objects: wp.int32
    """Number of objects."""
    feet: wp.int32
    """Number of feet."""
    positions: wp.int32
    """Number of the robot's entries in qpos."""
    velocities: wp.int32
    """Number of the robot's entries in qvel."""
    substeps: wp.int32
    """Physics steps."""
    found: _Flags2
    """Which contact sensors found a contact, ``[B, S]``."""
    fallen: _Flags
    """As in `StepResult`, ``[B]``; so are the next three."""
    power: _Floats
    saturation: _Floats
    diverged: _Flags
    overflowed: _Ints
    """Whether contacts were lost since this was reset, ``[1]``."""


def outcome_of(scene: Scene, data: mjw.Data) -> Outcome:
    """Return an outcome with new arrays on the current device.

    Args:
        scene: The scene.
        data: Its simulations.
    """
    rows, sensors = data.sensordata.shape
    out, joints = Outcome(), len(scene.robot.joints)
    out.objects, out.feet = len(scene.objects), len(scene.robot.feet)
    out.positions, out.velocities = 7 + joints, 6 + joints
    out.substeps = scene.config.substeps
    out.found = wp.zeros((rows, sensors), dtype=wp.bool)
    out.fallen, out.diverged = (wp.zeros(rows, dtype=wp.bool) for _ in range(2))
    out.power, out.saturation = (wp.zeros(rows, dtype=wp.float32) for _ in range(2))
    out.overflowed = wp.zeros(1, dtype=wp.int32)
    return out


@wp.kernel
def begin(
    out: Outcome, active: _Flags2, qpos: _Floats2, qvel: _Floats2, overflow: _Ints
):
    """Park the objects that are not in play, and clear the outcome."""
    row = wp.tid()
    for o in range(out.objects):
        if not active[row, o]:
            for i in range(3):
                qpos[row, out.positions + 3 * o + i] = 0.0
                qvel[row, out.velocities + 3 * o + i] = 0.0
            qpos[row, out.positions + 3 * o + 2] = wp.static(float(PARKING[2]))
    for i in range(out.found.shape[1]):
        out.found[row, i] = False
    out.fallen[row] = False
    out.power[row] = 0.0
    out.saturation[row] = 0.0
    overflow[row] = 0


@wp.kernel
def observe(
    out: Outcome, counts: _Floats2, torque: _Floats2, limit: _Ranges2, qvel: _Floats2
):
    """Add what a physics step reports: contacts, and torques of the joints."""
    row = wp.tid()
    for i in range(counts.shape[1]):
        if counts[row, i] > 0.0:
            out.found[row, i] = True
    # Fallen: the floor has more contacts with the robot than with its feet.
    floor = out.objects + 1
    standing = float(0.0)
    for i in range(out.feet):
        standing += counts[row, floor + 1 + i]
    if counts[row, floor] > standing:
        out.fallen[row] = True
    joints = torque.shape[1]
    power = float(0.0)
    limited = float(0.0)
    for j in range(joints):
        power += wp.abs(torque[row, j] * qvel[row, 6 + j])
        # A model that is the same in all rows has a single one.
        if wp.abs(torque[row, j]) >= limit[row % limit.shape[0], j][1]:
            limited += 1.0
    out.power[row] = out.power[row] + power / float(out.substeps)
    out.saturation[row] = out.saturation[row] + limited / float(joints * out.substeps)


@wp.kernel
def hold(out: Outcome, held: _Floats2, qpos: _Floats2, qvel: _Floats2):
    """Put the robot back into the pose that it is held in."""
    row = wp.tid()
    for i in range(out.positions):
        qpos[row, i] = held[row, i]
    for i in range(out.velocities):
        qvel[row, i] = 0.0


@wp.kernel
def end(out: Outcome, qpos: _Floats2, qvel: _Floats2, overflow: _Ints):
    """Find the rows that diverged, and contacts that were lost."""
    row = wp.tid()
    sound = bool(True)
    for i in range(out.velocities):
        # The comparison is also False for NaN.
        if not wp.abs(qvel[row, i]) < wp.static(MAX_SPEED):
            sound = False
    for i in range(qpos.shape[1]):
        if not wp.isfinite(qpos[row, i]):
            sound = False
    lost = (overflow[row] & wp.static(_LOST)) != 0
    out.diverged[row] = lost or not sound
    # Diverged robots may have any number of contacts, which is not reported.
    if lost and sound:
        out.overflowed[0] = 1


def launch(kernel: Any, out: Outcome, *inputs: wp.array) -> None:
    """Launch one of the kernels for all rows, on the current device."""
    wp.launch(kernel, len(out.fallen), [out, *inputs])
