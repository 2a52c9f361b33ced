"""Memory of observations: the last few values, or the value at the last detection."""

from __future__ import annotations

from collections.abc import Sequence
from numbers import Integral

import torch
from tensordict import NestedKey
from torch import Tensor
from torchrl.data import Bounded, Composite, TensorSpec, Unbounded

from egoskin.transform import StatefulTransform


class History(StatefulTransform):
    """The latest values of some entries, concatenated, oldest first.

    Reads any entries ``[*B, ..., F]`` and writes ``[*B, ..., length F]`` for each. At
    the start of an episode the history is filled with the first value. The next step
    reads the histories back: later transforms must neither drop nor change them.

    Args:
        length: Number of values, including the current one.
        in_keys: Keys of the entries.
        out_keys: Keys of their histories, in the same order.

    Raises:
        ValueError: If the length is not an integer or less than 1, or the keys do not
            pair up.
    """

    def __init__(
        self,
        length: int,
        in_keys: Sequence[NestedKey] = ("signal",),
        out_keys: Sequence[NestedKey] = ("signal_history",),
    ) -> None:
        if not isinstance(length, Integral) or length < 1:
            raise ValueError(f"length must be an integer, at least 1, got {length}")
        super().__init__(in_keys, out_keys, state_keys=out_keys)
        if len(self.in_keys) != len(self.out_keys):
            raise ValueError(
                f"need one out key per in key, got {self.in_keys} and {self.out_keys}"
            )
        self.length = length

    def start(
        self,
        rows: Tensor,
        inputs: Sequence[Tensor],
        before: Sequence[Tensor] | None,
    ) -> list[Tensor]:
        """Return the first values, repeated."""
        return [torch.cat([x] * self.length, -1) for x in inputs]

    def advance(
        self, rows: Tensor, inputs: Sequence[Tensor], state: Sequence[Tensor]
    ) -> list[Tensor]:
        """Return the histories with the oldest value dropped and the new one added."""
        return [
            torch.cat((past[..., x.shape[-1] :], x), -1)
            for past, x in zip(state, inputs, strict=True)
        ]

    def out_specs(self, spec: Composite) -> Sequence[TensorSpec]:
        """Return the specs of the histories, bounded if their entries are."""
        specs = []
        for key in self.in_keys:
            one = spec[key]
            shape = torch.Size((*one.shape[:-1], self.length * one.shape[-1]))
            if isinstance(one, Bounded):
                assert one.space is not None
                low, high = (
                    torch.cat([bound.expand(one.shape)] * self.length, -1)
                    for bound in (one.space.low, one.space.high)
                )
                specs.append(
                    Bounded(low, high, shape=shape, dtype=one.dtype, device=one.device)
                )
            else:
                specs.append(Unbounded(shape=shape, dtype=one.dtype))
        return specs


class KeepLast(StatefulTransform):
    """The signal while anything is detected, then its last value.

    Reads ``signal [*B, F]`` (for example from `Localization`) and any number of
    ``object_detected [*B, O]`` (a detection in any of them counts); writes
    ``last_signal [*B, F]``, zero until the first detection of the episode. The next
    step reads it back: later transforms must neither drop nor change it.

    Args:
        in_keys: Keys of the signal and of the detections (one or more).
        out_keys: Key of the last signal.

    Raises:
        ValueError: If the number of keys is wrong.
    """

    _NUM_IN, _NUM_OUT = (2, None), (1, 1)

    def __init__(
        self,
        in_keys: Sequence[NestedKey] = ("signal", "object_detected"),
        out_keys: Sequence[NestedKey] = ("last_signal",),
    ) -> None:
        super().__init__(in_keys, out_keys, state_keys=out_keys)

    def start(
        self,
        rows: Tensor,
        inputs: Sequence[Tensor],
        before: Sequence[Tensor] | None,
    ) -> list[Tensor]:
        """Return the signal where anything is detected, zero elsewhere."""
        return self.advance(rows, inputs, [torch.zeros_like(inputs[0])])

    def advance(
        self, rows: Tensor, inputs: Sequence[Tensor], state: Sequence[Tensor]
    ) -> list[Tensor]:
        """Return the signal where anything is detected, its last value elsewhere."""
        signal, *detections = inputs
        detected = torch.stack([d.any(-1, keepdim=True) for d in detections]).any(0)
        return [torch.where(detected, signal, state[0])]
