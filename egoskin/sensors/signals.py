"""Signals: what a policy is given of what sensors measure.

All three read the measurements of a coverage (`egoskin.sensors.field`), so that every
signal goes with every coverage and whatever corrupts a measurement comes in between.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from tensordict import NestedKey
from torch import Tensor
from torchrl.data import Bounded, Composite, TensorSpec, Unbounded

from egoskin.kinematics import rotate_inverse
from egoskin.transform import RowTransform

# An infinite range has no scale of its own: distance d reads d / (d + 1 m).
_HALF_DISTANCE = 1.0


class Proximity(RowTransform):
    """Distance over range: 0 at the sensor, 1 at the range and for nothing.

    Reads ``distance [*B, S]`` [m] (infinite: nothing in range); writes ``signal
    [*B, S]`` in [0, 1].

    Args:
        max_range: The range of the sensors [m]. For an infinite one the signal is
            d / (d + 1 m).
        in_keys: Key of the distance.
        out_keys: Key of the signal.

    Raises:
        ValueError: If the range is not positive.
    """

    def __init__(
        self,
        max_range: float,
        in_keys: Sequence[NestedKey] = ("distance",),
        out_keys: Sequence[NestedKey] = ("signal",),
    ) -> None:
        super().__init__(in_keys, out_keys)
        if not max_range > 0:
            raise ValueError(f"max_range must be positive, got {max_range}")
        self.max_range = float(max_range)

    def compute(self, *inputs: Tensor) -> tuple[Tensor, ...]:
        """Return the signal, ``[B, S]``."""
        (distance,) = inputs
        if math.isinf(self.max_range):
            # 1 - 1 / (1 + d) is 1 for an infinite distance, where d / (1 + d) is NaN.
            return (1.0 - _HALF_DISTANCE / (_HALF_DISTANCE + distance),)
        return ((distance / self.max_range).clamp(0.0, 1.0),)

    def out_specs(self, spec: Composite) -> Sequence[TensorSpec]:
        """Return the spec of the signal."""
        shape, dtype = spec[self.in_keys[0]].shape, spec[self.in_keys[0]].dtype
        return (Bounded(0.0, 1.0, shape=shape, dtype=dtype),)


class Binary(RowTransform):
    """Whether each sensor detects anything: 1 or 0.

    Reads ``distance [*B, S]`` [m] (infinite: nothing in range); writes ``signal
    [*B, S]``.

    Args:
        in_keys: Key of the distance.
        out_keys: Key of the signal.
    """

    def __init__(
        self,
        in_keys: Sequence[NestedKey] = ("distance",),
        out_keys: Sequence[NestedKey] = ("signal",),
    ) -> None:
        super().__init__(in_keys, out_keys)

    def compute(self, *inputs: Tensor) -> tuple[Tensor, ...]:
        """Return the signal, ``[B, S]``."""
        (distance,) = inputs
        return (distance.isfinite().to(distance.dtype),)

    def out_specs(self, spec: Composite) -> Sequence[TensorSpec]:
        """Return the spec of the signal."""
        shape, dtype = spec[self.in_keys[0]].shape, spec[self.in_keys[0]].dtype
        return (Bounded(0.0, 1.0, shape=shape, dtype=dtype),)


class Localization(RowTransform):
    """Position of the detected object nearest to the base, in the base frame.

    Reads ``base_pose [*B, 7]``, ``object_pose [*B, O, 7]`` and ``object_detected
    [*B, O]``; writes ``signal [*B, 3]`` [m], zero if no sensor detects any object.

    Args:
        in_keys: Keys of the three inputs, in the order above.
        out_keys: Key of the signal.
    """

    def __init__(
        self,
        in_keys: Sequence[NestedKey] = ("base_pose", "object_pose", "object_detected"),
        out_keys: Sequence[NestedKey] = ("signal",),
    ) -> None:
        super().__init__(in_keys, out_keys)

    def compute(self, *inputs: Tensor) -> tuple[Tensor, ...]:
        """Return the signal, ``[B, 3]``."""
        base_pose, object_pose, detected = inputs
        offset_w = object_pose[..., :3] - base_pose[:, None, :3]
        away = offset_w.square().sum(-1).masked_fill(~detected, torch.inf)
        nearest = away.argmin(-1, keepdim=True)[..., None].expand(-1, -1, 3)
        position = rotate_inverse(base_pose[:, 3:], offset_w.gather(1, nearest)[:, 0])
        return (position * detected.any(-1, keepdim=True),)

    def out_specs(self, spec: Composite) -> Sequence[TensorSpec]:
        """Return the spec of the signal."""
        dtype = spec[self.in_keys[0]].dtype
        return (Unbounded(shape=torch.Size((*spec.shape, 3)), dtype=dtype),)
