"""Proprioception, the critic's privileged observation and the oracle's signal."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import torch
from tensordict import NestedKey
from torch import Tensor

from egoskin.robots.kinematics import axis_vectors, rotate_inverse
from egoskin.transform import RowTransform

# Approaches: longest prediction [s], largest offset reported along an axis [m], and
# time scale of the nearness [s].
_LONGEST_APPROACH, _FARTHEST_PASS, _SOON = 2.0, 3.0, 0.3


class Proprioception(RowTransform):
    """Base angular velocity, joint positions and velocities, gravity.

    Reads ``base_pose``, ``base_ang_vel_b``, ``joint_pos``, ``joint_vel`` and optionally
    ``previous_action``; writes ``observation [*B, 6 + 2 J]``: angular velocity [rad/s]
    3, q - q_default [rad] J, joint velocities [rad/s] J, unit gravity in the base frame
    3; then, if it is read, the previous action J.

    Args:
        default_joint_pos: Default pose [rad], ``[J]``.
        in_keys: Keys of the inputs, in the order above; the fifth is optional.
        out_keys: Key of the observation.
    """

    _NUM_IN, _NUM_OUT = (4, 5), (1, 1)
    _default: Tensor
    STATE_KEYS = ("base_pose", "base_ang_vel_b", "joint_pos", "joint_vel")
    """The required inputs."""

    def __init__(
        self,
        default_joint_pos: Tensor,
        in_keys: Sequence[NestedKey] = STATE_KEYS,
        out_keys: Sequence[NestedKey] = ("observation",),
    ) -> None:
        super().__init__(in_keys, out_keys)
        self.register_buffer("_default", default_joint_pos, persistent=False)

    def compute(self, *inputs: Tensor) -> tuple[Tensor, ...]:
        """Return the observation, ``[B, 6 + 2 J]`` or ``[B, 6 + 3 J]``."""
        base_pose, base_ang_vel_b, joint_pos, joint_vel, *action = inputs
        quat = base_pose[:, 3:]
        gravity_b = rotate_inverse(quat, axis_vectors(quat, 2, -1.0))
        deviation = joint_pos - self._default.to(joint_pos.dtype)
        parts = (base_ang_vel_b, deviation, joint_vel, gravity_b, *action)
        return (torch.cat(parts, -1),)


def object_states_b(
    base_pose: Tensor,
    base_lin_vel_w: Tensor,
    object_pose: Tensor,
    object_lin_vel_w: Tensor,
    object_active: Tensor,
) -> Tensor:
    """Return the state of the objects relative to the base.

    Args:
        base_pose: Base pose in the world, ``[B, 7]``.
        base_lin_vel_w: Base velocity [m/s], ``[B, 3]``.
        object_pose: Poses in the world, ``[B, O, 7]``.
        object_lin_vel_w: Velocities [m/s], ``[B, O, 3]``.
        object_active: Whether each is in play, ``[B, O]`` bool.

    Returns:
        ``[B, 7 O]``, for each object: position relative to the base [m] 3, velocity
        relative to the base's origin [m/s] 3, both along the base's axes, and active
        flag; zero where inactive.
    """
    flag = object_active[..., None].to(object_pose.dtype)
    turn = base_pose[:, None, 3:].expand(-1, object_pose.shape[1], -1)
    position = rotate_inverse(turn, object_pose[..., :3] - base_pose[:, None, :3])
    speed = rotate_inverse(turn, object_lin_vel_w - base_lin_vel_w[:, None])
    return torch.cat((position * flag, speed * flag, flag), -1).flatten(1)


def approaches_b(
    base_pose: Tensor,
    base_lin_vel_w: Tensor,
    object_pose: Tensor,
    object_lin_vel_w: Tensor,
    object_active: Tensor,
    *,
    gravity: float,
) -> Tensor:
    """Return the predicted time and position of each object's closest approach.

    It follows from the objects' states, but a small network cannot compute it.

    Args:
        base_pose: Base pose in the world, ``[B, 7]``.
        base_lin_vel_w: Base velocity [m/s], ``[B, 3]``, assumed constant.
        object_pose: Poses in the world, ``[B, O, 7]``.
        object_lin_vel_w: Velocities [m/s], ``[B, O, 3]``.
        object_active: Whether each is in play, ``[B, O]`` bool.
        gravity: Downward acceleration of the objects [m/s^2].

    Returns:
        ``[B, 4 O]``, for each object: nearness in time 0.3 s / (0.3 s + t), where t
        is the time of its least horizontal distance from the base, clamped to [0, 2] s,
        and its position relative to the base at that time along the base's axes [m],
        each clamped to [-3, 3] m; zero where inactive.
    """
    gap = object_pose[..., :3] - base_pose[:, None, :3]
    speed = object_lin_vel_w - base_lin_vel_w[:, None]
    (x, y, _), (u, v, _) = gap.unbind(-1), speed.unbind(-1)
    time = -(x * u + y * v) / (u * u + v * v).clamp(min=1e-3)
    time = time.clamp(0.0, _LONGEST_APPROACH)[..., None]
    fall = torch.nn.functional.pad(0.5 * gravity * time * time, (2, 0))
    turn = base_pose[:, None, 3:].expand(-1, gap.shape[1], -1)
    passing = rotate_inverse(turn, gap + speed * time - fall)
    passing = passing.clamp(-_FARTHEST_PASS, _FARTHEST_PASS)
    nearness = _SOON / (_SOON + time)
    flag = object_active[..., None].to(gap.dtype)
    return (torch.cat((nearness, passing), -1) * flag).flatten(1)


class HideObjects(RowTransform):
    """Hides all objects from later transforms, which masks every sensor.

    Reads ``object_active [*B, O]`` and overwrites it with False.
    """

    def __init__(self) -> None:
        super().__init__(["object_active"], ["object_active"])

    def compute(self, *inputs: Tensor) -> tuple[Tensor, ...]:
        """Return the flags, ``[B, O]``."""
        return (torch.zeros_like(inputs[0]),)


class Oracle(RowTransform):
    """The true state of every ball: a diagnostic that no sensor can provide.

    Reads ``base_pose``, ``base_lin_vel_w``, ``object_pose``, ``object_lin_vel_w`` and
    ``object_active``; writes ``signal [*B, 7 O]``, see `object_states_b`.

    Args:
        in_keys: Keys of the inputs, in the order above.
        out_keys: Key of the signal.
    """

    _NUM_IN, _NUM_OUT = (5, 5), (1, 1)

    def __init__(
        self,
        in_keys: Sequence[NestedKey] = (
            "base_pose",
            "base_lin_vel_w",
            "object_pose",
            "object_lin_vel_w",
            "object_active",
        ),
        out_keys: Sequence[NestedKey] = ("signal",),
    ) -> None:
        super().__init__(in_keys, out_keys)

    def compute(self, *inputs: Tensor) -> tuple[Tensor, ...]:
        """Return the signal, ``[B, 7 O]``."""
        return (object_states_b(*inputs),)


class Privileged(RowTransform):
    """Privileged observation of the critic in training; the same for every skin.

    Reads ``base_pose``, ``base_lin_vel_w`` and, with content "objects",
    ``displacement_w``, ``previous_action``, ``object_pose``, ``object_lin_vel_w`` and
    ``object_active``. Writes ``privileged_observation``: base velocity [m/s] 3; with
    content "objects" also displacement from the start [m] 3, previous action J, the
    objects' states (`object_states_b`) 7 O and approaches (`approaches_b`) 4 O, and
    height of the base above the ground [m] 1. Vectors are in the base frame.

    Args:
        content: "objects" for everything above, "velocity" for the paper's critic.
        gravity: Downward acceleration of the objects [m/s^2].
        in_keys: Keys of the inputs, in the order above.
        out_keys: Key of the observation.

    Raises:
        ValueError: If the number of ``in_keys`` does not match the content.
    """

    _VELOCITY_KEYS = ("base_pose", "base_lin_vel_w")
    _OBJECT_KEYS = (
        "displacement_w",
        "previous_action",
        "object_pose",
        "object_lin_vel_w",
        "object_active",
    )

    def __init__(
        self,
        content: Literal["objects", "velocity"],
        gravity: float,
        in_keys: Sequence[NestedKey] | None = None,
        out_keys: Sequence[NestedKey] = ("privileged_observation",),
    ) -> None:
        read = self._VELOCITY_KEYS
        if content == "objects":
            read = (*read, *self._OBJECT_KEYS)
        if in_keys is not None and len(in_keys) != len(read):
            raise ValueError(f"in_keys must name {', '.join(read)}, got {in_keys}")
        super().__init__(in_keys or read, out_keys)
        self._gravity = gravity

    def compute(self, *inputs: Tensor) -> tuple[Tensor, ...]:
        """Return the privileged observation, ``[B, P]``."""
        base_pose, base_lin_vel_w, *rest = inputs
        quat = base_pose[:, 3:]
        parts = [rotate_inverse(quat, base_lin_vel_w)]
        if rest:
            displacement_w, previous_action, *objects = rest
            planar = torch.nn.functional.pad(displacement_w, (0, 1))
            states = object_states_b(base_pose, base_lin_vel_w, *objects)
            approaches = approaches_b(
                base_pose, base_lin_vel_w, *objects, gravity=self._gravity
            )
            parts += [rotate_inverse(quat, planar), previous_action, states]
            parts += [approaches, base_pose[:, 2:3]]
        return (torch.cat(parts, -1),)
