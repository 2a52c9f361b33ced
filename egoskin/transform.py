"""The shape that all stateless transforms of the project share.

Contract: a row of the result depends on the same row of the input alone. On a partial
reset only the rows that reset are computed; the environment fills the others in.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import Composite, TensorSpec
from torchrl.envs import Transform

from egoskin.kinematics import pad_rows


class RowTransform(Transform):
    """A TorchRL transform that maps each row of its inputs to a row of its outputs.

    Works inside a worker, around a ParallelEnv, and by calling it on any TensorDict
    with any leading dimensions (a stored batch with time, for example).

    Args:
        in_keys: Keys read; never written.
        out_keys: Keys written.
    """

    def __init__(
        self, in_keys: Sequence[NestedKey], out_keys: Sequence[NestedKey]
    ) -> None:
        super().__init__(in_keys=list(in_keys), out_keys=list(out_keys))

    @abstractmethod
    def compute(self, *inputs: Tensor) -> tuple[Tensor, ...]:
        """Return one tensor for each out key, from one for each in key.

        Args:
            inputs: Tensors ``[B, ...]`` with a single batch dimension.

        Returns:
            Tensors ``[B, ...]``.
        """

    @abstractmethod
    def out_specs(self, spec: Composite) -> Sequence[TensorSpec]:
        """Return the spec of each out key, ``[*B, ...]``, from the input's spec."""

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        """Return the spec with the out keys added."""
        assert isinstance(observation_spec, Composite)
        for key, spec in zip(
            self.out_keys, self.out_specs(observation_spec), strict=True
        ):
            observation_spec[key] = spec
        return observation_spec

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        missing = [k for k in self.in_keys if k not in next_tensordict.keys(True)]
        if missing:
            raise KeyError(
                f"{type(self).__name__} reads {missing[0]!r}, which the tensordict "
                f"lacks; it holds {sorted(map(str, next_tensordict.keys(True)))}"
            )
        batch = next_tensordict.batch_size
        inputs = [next_tensordict[key] for key in self.in_keys]
        if len(batch) != 1:
            inputs = [x.reshape(-1, *x.shape[len(batch) :]) for x in inputs]
        for key, value in zip(self.out_keys, self.compute(*inputs), strict=True):
            next_tensordict.set(key, value.reshape(*batch, *value.shape[1:]))
        return next_tensordict

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the out keys into any tensordict that holds the in keys."""
        return self._call(tensordict)

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        mask = tensordict.get("_reset", None)
        if mask is None or mask.all():
            return self._call(tensordict_reset)
        batch = tensordict_reset.batch_size
        total = batch.numel()
        rows = mask.reshape(total, -1).any(-1).nonzero()[:, 0]
        if not len(rows):
            rows = rows.new_zeros(1)
        index = pad_rows(rows)
        inputs = [tensordict_reset[key] for key in self.in_keys]
        part = self.compute(
            *(x.reshape(total, *x.shape[len(batch) :])[index] for x in inputs)
        )
        for key, value in zip(self.out_keys, part, strict=True):
            full = torch.zeros(total, *value.shape[1:], dtype=value.dtype)
            full = full.to(value.device)
            full[rows] = value[: len(rows)]
            tensordict_reset.set(key, full.reshape(*batch, *value.shape[1:]))
        return tensordict_reset
