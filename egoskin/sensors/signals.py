"""Signals: conversion of sensor measurements to policy observations.

Signals read the measurements of any coverage, with or without corruption in between. A
measurement that is infinite or beyond the range means that nothing is in range; NaN
(invalid input) gives a signal of NaN.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Sequence

import torch
from tensordict import NestedKey
from torch import Tensor
from torchrl.data import Bounded, Composite, TensorSpec

from egoskin.robots.kinematics import rotate_inverse
from egoskin.sensors.geometry import ProximitySensor
from egoskin.transform import RowTransform

# An infinite range has no scale: a distance d gives the signal d / (d + 1 m).
_HALF_DISTANCE = 1.0


class _Reading(RowTransform):
    """A signal of one number for each measurement, in [0, 1].

    Args:
        max_range: Sensor transform whose ranges are used, or ranges [m], one for all or
            one for each sensor; may be infinite. A measurement beyond counts as no
            detection, even if the sensor's own range is larger.
        in_keys: Key of the measurements.
        out_keys: Key of the signal.

    Raises:
        ValueError: If a range is not positive, or there is none, or there is not one
            key each.
    """

    _NUM_IN = _NUM_OUT = (1, 1)
    _range: Tensor

    def __init__(
        self,
        max_range: ProximitySensor | float | Sequence[float],
        in_keys: Sequence[NestedKey],
        out_keys: Sequence[NestedKey],
    ) -> None:
        super().__init__(in_keys, out_keys)
        if isinstance(max_range, ProximitySensor):
            max_range = max_range.ranges.tolist()
        try:
            limit = torch.as_tensor(max_range, dtype=torch.float64)
        except (TypeError, ValueError) as error:
            raise ValueError(
                "max_range must be a sensor transform, a number or one for each "
                f"sensor, got {type(max_range).__name__}"
            ) from error
        if not limit.numel() or not (limit > 0).all():
            raise ValueError(f"max_range must be positive, got {max_range}")
        self.register_buffer("_range", limit.reshape(-1), persistent=False)

    def compute(self, *inputs: Tensor) -> tuple[Tensor, ...]:
        """Return the signal, ``[B, S ...]`` flattened.

        Raises:
            ValueError: If there are several ranges, but not one for each sensor, or no
                dimension of sensors.
        """
        if inputs[0].ndim < 2:
            raise ValueError(f"{self.in_keys[0]!r} must be [*B, S, ...], got [*B]")
        ranges, sensors = len(self._range), inputs[0].shape[1]
        if ranges > 1 and ranges != sensors:
            raise ValueError(
                f"{ranges} ranges do not fit the {sensors} sensors of "
                f"{self.in_keys[0]!r}"
            )
        return (self.signal(inputs[0].flatten(1)),)

    @abstractmethod
    def signal(self, distance: Tensor) -> Tensor:
        """Return the signal of measurements [m], ``[B, n]`` each."""

    def _limits(self, distance: Tensor) -> Tensor:
        """Ranges [m] in the dtype of the measurements, ``[n]`` or one for all."""
        limit = self._range.to(distance.dtype)
        if len(limit) > 1:
            limit = limit.repeat_interleave(distance.shape[1] // len(limit))
        return limit

    def out_specs(self, spec: Composite) -> Sequence[TensorSpec]:
        """Return the spec of the signal."""
        measured = spec[self.in_keys[0]]
        size = measured.shape[len(spec.shape) :].numel()
        shape = torch.Size((*spec.shape, size))
        return (Bounded(0.0, 1.0, shape=shape, dtype=measured.dtype),)


class Proximity(_Reading):
    """Distance over range: 0 is contact, 1 is at the range or no detection.

    Reads ``distance [*B, S]`` or ``[*B, S, K]`` [m]; writes ``signal [*B, S K]``,
    sensor by sensor. With ``per_object``, each reading's objects follow one another.

    Args:
        max_range: Sensor transform whose ranges are used, or ranges [m], one for all or
            one for each sensor. A measurement beyond counts as no detection, even if
            the sensor's own range is larger. For an infinite range the signal is
            d / (d + 1 m).
        closeness: Write 1 - signal instead: 1 is contact, 0 is at the range or no
            detection.
        in_keys: Key of the measurements.
        out_keys: Key of the signal.

    Raises:
        ValueError: If a range is not positive, or there is not one key each.
    """

    def __init__(
        self,
        max_range: ProximitySensor | float | Sequence[float],
        *,
        closeness: bool = False,
        in_keys: Sequence[NestedKey] = ("distance",),
        out_keys: Sequence[NestedKey] = ("signal",),
    ) -> None:
        super().__init__(max_range, in_keys, out_keys)
        self._unlimited = bool(self._range.isinf().any())
        self.closeness = closeness

    def signal(self, distance: Tensor) -> Tensor:
        """Return the signal of measurements [m], ``[B, n]`` each."""
        scale = self._limits(distance)
        # An infinite distance gives 1 for every range.
        limited = (distance / scale).clamp_(0.0, 1.0)
        if self._unlimited:
            # For an infinite distance 1 - 1 / (1 + d) is 1, but d / (1 + d) is NaN.
            unlimited = 1.0 - _HALF_DISTANCE / (_HALF_DISTANCE + distance)
            limited = torch.where(scale.isinf(), unlimited, limited)
        return 1.0 - limited if self.closeness else limited


class Binary(_Reading):
    """Whether each measurement is in range: 1 or 0.

    Reads ``distance [*B, S]`` or ``[*B, S, K]`` [m]; writes ``signal [*B, S K]``,
    in the order of `Proximity`.

    Args:
        max_range: Sensor transform whose ranges are used, or ranges [m], one for all or
            one for each sensor. (Not needed for ideal sensors, whose measurements are
            infinite beyond their range.)
        in_keys: Key of the measurements.
        out_keys: Key of the signal.

    Raises:
        ValueError: If a range is not positive, or there is not one key each.
    """

    def __init__(
        self,
        max_range: ProximitySensor | float | Sequence[float] = math.inf,
        *,
        in_keys: Sequence[NestedKey] = ("distance",),
        out_keys: Sequence[NestedKey] = ("signal",),
    ) -> None:
        super().__init__(max_range, in_keys, out_keys)

    def signal(self, distance: Tensor) -> Tensor:
        """Return 1 for measurements in range, 0 for no detection, NaN for NaN."""
        # An infinite distance is out of range even if the range is infinite.
        limit = self._limits(distance).clamp(max=torch.finfo(distance.dtype).max)
        inside = (distance <= limit).to(distance)
        return torch.where(distance.isnan(), distance, inside)


class SkinOrder(RowTransform):
    """Concatenates the signals of several groups of sensors in the order of the skin.

    Reads a signal ``[*B, n]`` for each group, its sensors one after the other, and
    writes ``signal [*B, N]`` with the readings in the order of the skin's sensors.

    Args:
        groups: Indices of the sensors of each group; together all of the skin.
        num_readings: Readings per sensor of each group.
        in_keys: Key of the signal of each group.
        out_keys: Key of the signal of all groups.
    """

    _order: Tensor

    def __init__(
        self,
        groups: Sequence[Sequence[int]],
        num_readings: Sequence[int],
        *,
        in_keys: Sequence[NestedKey],
        out_keys: Sequence[NestedKey] = ("signal",),
    ) -> None:
        super().__init__(in_keys, out_keys)
        # Index of the sensor that each number comes from.
        owner = [
            torch.tensor(group).repeat_interleave(each)
            for group, each in zip(groups, num_readings, strict=True)
        ]
        order = torch.cat(owner).argsort(stable=True)
        self.register_buffer("_order", order, persistent=False)

    def compute(self, *inputs: Tensor) -> tuple[Tensor, ...]:
        """Return the signal of all groups, ``[B, N]``."""
        return (torch.cat(inputs, -1)[:, self._order],)

    def out_specs(self, spec: Composite) -> Sequence[TensorSpec]:
        """Return the spec of the signal of all groups."""
        shape = torch.Size((*spec.shape, len(self._order)))
        return (Bounded(0.0, 1.0, shape=shape, dtype=spec[self.in_keys[0]].dtype),)


class BeamMinimum(RowTransform):
    """Minimum over each sensor's beams, for existing readings.

    Reads ``distance [*B, S, K]`` [m]; writes ``sensor_distance [*B, S]``.
    (``RaySensor(reduce="min")`` is faster if beams need not be kept or corrupted
    individually.)

    Args:
        in_keys: Key of the measurements.
        out_keys: Key of the minima.

    Raises:
        ValueError: If there is not one key each.
    """

    _NUM_IN = _NUM_OUT = (1, 1)

    def __init__(
        self,
        in_keys: Sequence[NestedKey] = ("distance",),
        out_keys: Sequence[NestedKey] = ("sensor_distance",),
    ) -> None:
        super().__init__(in_keys, out_keys)

    def compute(self, *inputs: Tensor) -> tuple[Tensor, ...]:
        """Return the minima, ``[B, S]``.

        Raises:
            ValueError: If the measurements have no dimension of beams.
        """
        if inputs[0].ndim < 3:
            raise ValueError(
                f"BeamMinimum needs beams, [*B, S, K], but {self.in_keys[0]!r} is [*B, "
                f"{', '.join(map(str, inputs[0].shape[1:]))}]"
            )
        return (inputs[0].amin(-1),)


class Localization(RowTransform):
    """Position of the detected object nearest to the robot's base, in the base frame.

    Position and distance are those of the object's centre.

    Reads ``base_pose [*B, 7]``, ``object_pose [*B, O, 7]``, ``joint_pos [*B, J]`` and
    any number of ``object_detected [*B, O]`` (a detection in any of them counts).
    Writes ``signal [*B, 3]`` [m], zero if no sensor detects any object, and NaN if one
    is detected in a row with NaN inputs, as the sensor poses are then unknown.

    Args:
        in_keys: Keys of base pose, object pose, joint positions and detections (one
            or more).
        out_keys: Key of the signal.

    Raises:
        ValueError: If the number of keys is wrong.
    """

    _NUM_IN, _NUM_OUT = (4, None), (1, 1)

    def __init__(
        self,
        in_keys: Sequence[NestedKey] = (
            *("base_pose", "object_pose", "joint_pos"),
            "object_detected",
        ),
        out_keys: Sequence[NestedKey] = ("signal",),
    ) -> None:
        super().__init__(in_keys, out_keys)

    def compute(self, *inputs: Tensor) -> tuple[Tensor, ...]:
        """Return the signal, ``[B, 3]``."""
        base_pose, object_pose, joint_pos, *detections = inputs
        detected = torch.stack(detections).any(0)
        offset_w = object_pose[..., :3] - base_pose[:, None, :3]
        quat = base_pose[:, 3:] / base_pose[:, 3:].norm(dim=-1, keepdim=True)
        each = quat[:, None].expand(-1, offset_w.shape[1], -1)
        position = rotate_inverse(each, offset_w)
        # With invalid joints the sensor poses are unknown, with an invalid orientation
        # the object's surface is: 0 NaN = NaN.
        bad = joint_pos.sum(-1, keepdim=True) + object_pose[..., 3:].sum(-1)
        position = position + 0.0 * bad[..., None]
        away = offset_w.square().sum(-1)
        nearest = away.masked_fill(~detected, torch.inf).argmin(-1, keepdim=True)
        position = position.gather(1, nearest[..., None].expand(-1, -1, 3))[:, 0]
        # NaN remains if an object is detected; poses of inactive objects do not matter.
        return (position.masked_fill(~detected.any(-1, keepdim=True), 0.0),)
