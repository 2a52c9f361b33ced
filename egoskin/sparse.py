"""Features that are almost all the same: rows of a few others, and a layer of them.

A full ray grid gives thousands of readings for each row, of which one in 250 found
anything. Kept as lists it takes 1 % of the memory, and the first layer of a network 1 %
of the time; its weights are those of the dense layer.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor
from torch.nn.functional import embedding_bag


@dataclass(frozen=True, kw_only=True, eq=False)
class SparseRows:
    """A matrix ``[B, size]`` whose entries are ``default``, but for a few.

    Those of row b are number ``offsets[b]`` to ``offsets[b + 1]``.
    """

    offsets: Tensor
    """Where the entries of each row begin, and the end, ``[B + 1]`` int64."""
    column: Tensor
    """Column of each entry, ``[n]`` int64."""
    value: Tensor
    """Value of each entry, ``[n]``."""
    size: int
    """Number of columns."""
    default: float
    """What all others are."""

    def __len__(self) -> int:
        """Return the number of rows ``B``."""
        return len(self.offsets) - 1

    @staticmethod
    def cat(parts: Sequence[SparseRows]) -> SparseRows:
        """Return the rows of several matrices of one kind, one after the other."""
        counts = torch.cat([part.offsets.diff() for part in parts])
        return replace(
            parts[0],
            offsets=offsets_of(counts),
            column=torch.cat([part.column for part in parts]),
            value=torch.cat([part.value for part in parts]),
        )

    def select(self, rows: Tensor) -> SparseRows:
        """Return some rows, ``[n]`` int64, in their order."""
        start = self.offsets[rows]
        counts = self.offsets[rows + 1] - start
        offsets = offsets_of(counts)
        # Entry i of the result is entry i - offsets[b] + start[b] of this.
        shift = torch.repeat_interleave(start - offsets[:-1], counts)
        entry = shift + torch.arange(len(shift), device=shift.device)
        column, value = self.column[entry], self.value[entry]
        return replace(self, offsets=offsets, column=column, value=value)

    def to(self, device: torch.device) -> SparseRows:
        """Return it on a device."""
        return replace(
            self,
            offsets=self.offsets.to(device),
            column=self.column.to(device),
            value=self.value.to(device),
        )

    def is_finite(self) -> Tensor:
        """Return which rows hold only finite values, ``[B]`` bool."""
        finite = torch.ones(len(self), dtype=torch.bool, device=self.value.device)
        finite[self._row[~self.value.isfinite()]] = False
        return finite

    def dense(self) -> Tensor:
        """Return the matrix, ``[B, size]``."""
        matrix = self.value.new_full((len(self), self.size), self.default)
        return matrix.index_put_((self._row, self.column), self.value)

    def linear(self, weight: Tensor, bias: Tensor | None) -> Tensor:
        """Return what a linear layer makes of the matrix, ``[B, out]``.

        Args:
            weight: Weights of the layer, ``[out, size]``.
            bias: Its bias, ``[out]``, or None.
        """
        result = _Linear.apply(weight, self)
        assert isinstance(result, Tensor)
        # A constant input is one more bias.
        constant = self.default * weight.sum(1) if self.default else None
        for shift in (constant, bias):
            result = result if shift is None else result + shift
        return result

    @property
    def _row(self) -> Tensor:
        """Row of each entry."""
        rows = torch.arange(len(self), device=self.offsets.device)
        return torch.repeat_interleave(rows, self.offsets.diff())

    @property
    def _excess(self) -> Tensor:
        """By how much each entry differs from the default."""
        return self.value - self.default if self.default else self.value

    @cached_property
    def _by_column(self) -> tuple[Tensor, Tensor, Tensor]:
        """Row and excess of each entry, column by column, and where columns begin."""
        if self.column.is_cpu:
            # A radix sort for 16 bits: several times as fast as PyTorch's.
            bits = np.uint16 if self.size <= 2**16 else np.int64
            keys = self.column.numpy().astype(bits)
            order = torch.from_numpy(np.argsort(keys, kind="stable"))
        else:
            order = self.column.argsort(stable=True)
        counts = torch.bincount(self.column, minlength=self.size)
        return self._row[order], self._excess[order], offsets_of(counts)


class SparseSource(Protocol):
    """Computes sparse rows from what an environment gives."""

    in_keys: list[str]
    """Keys it reads."""
    size: int
    """Number of columns."""

    def __call__(self, tensordict: TensorDictBase) -> SparseRows:
        """Return the rows of a tensordict, ``[B]``."""
        ...


def offsets_of(counts: Tensor) -> Tensor:
    """Return where groups of these sizes begin, and the end, ``[n + 1]``."""
    return torch.cat((counts.new_zeros(1), counts.cumsum(0)))


def _sums(table: Tensor, index: Tensor, scale: Tensor, offsets: Tensor) -> Tensor:
    """Return sums of scaled rows of a table, one for each group."""
    return embedding_bag(
        index,
        table,
        offsets,
        mode="sum",
        per_sample_weights=scale.to(table.dtype),
        include_last_offset=True,
    )


class _Linear(torch.autograd.Function):
    """The entries' part of the layer. PyTorch's gradient takes ten times as long."""

    @staticmethod
    def forward(ctx: torch.autograd.function.FunctionCtx, *args: object) -> Tensor:
        weight, rows = args
        assert isinstance(weight, Tensor)
        assert isinstance(rows, SparseRows)
        setattr(ctx, "rows", rows)  # noqa: B010 (FunctionCtx has no fields of its own)
        table = weight.detach().t().contiguous()
        return _sums(table, rows.column, rows._excess, rows.offsets)

    @staticmethod
    def backward(
        ctx: torch.autograd.function.FunctionCtx, *grad_outputs: Tensor
    ) -> tuple[Tensor, None]:
        rows: SparseRows = getattr(ctx, "rows")  # noqa: B009
        row, excess, offsets = rows._by_column
        # dW^T = X^T dy
        return _sums(grad_outputs[0].contiguous(), row, excess, offsets).t(), None
