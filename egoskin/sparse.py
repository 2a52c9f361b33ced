"""Sparse features with a default value, and a linear layer for them.

A full ray grid gives thousands of readings per row, of which one in 250 detects
anything. In sparse form it takes 1 % of the memory, and the first layer of a network
1 % of the time; the weights are those of the dense layer.
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
    """A matrix ``[B, size]`` whose entries are ``default`` except for a few.

    The stored entries of row b are those from ``offsets[b]`` to ``offsets[b + 1]``,
    exclusive.
    """

    offsets: Tensor
    """Start of the entries of each row, and the end, ``[B + 1]`` int64."""
    column: Tensor
    """Column of each entry, ``[n]`` int64."""
    value: Tensor
    """Value of each entry, ``[n]``."""
    size: int
    """Number of columns."""
    default: float
    """Value of all entries that are not stored."""

    def __len__(self) -> int:
        """Return the number of rows ``B``."""
        return len(self.offsets) - 1

    @staticmethod
    def cat(parts: Sequence[SparseRows]) -> SparseRows:
        """Return the concatenated rows of matrices with equal size and default."""
        counts = torch.cat([part.offsets.diff() for part in parts])
        return replace(
            parts[0],
            offsets=offsets_of(counts),
            column=torch.cat([part.column for part in parts]),
            value=torch.cat([part.value for part in parts]),
        )

    def select(self, rows: Tensor) -> SparseRows:
        """Return the rows with the given indices, ``[n]`` int64, in that order."""
        start = self.offsets[rows]
        counts = self.offsets[rows + 1] - start
        offsets = offsets_of(counts)
        # Entry i of the result is entry i - offsets[b] + start[b] of this matrix.
        shift = torch.repeat_interleave(start - offsets[:-1], counts)
        entry = shift + torch.arange(len(shift), device=shift.device)
        column, value = self.column[entry], self.value[entry]
        return replace(self, offsets=offsets, column=column, value=value)

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
        """Return the output of a linear layer for the matrix, ``[B, out]``.

        Args:
            weight: Weights of the layer, ``[out, size]``.
            bias: Its bias, ``[out]``, or None.
        """
        result = _Linear.apply(weight, self)
        assert isinstance(result, Tensor)
        # A constant input acts as another bias.
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
        """Difference of each entry from the default."""
        return self.value - self.default if self.default else self.value

    @cached_property
    def _by_column(self) -> tuple[Tensor, Tensor, Tensor]:
        """Row and excess of each entry, sorted by column, and the column offsets."""
        if self.column.is_cpu:
            # NumPy uses a radix sort for 16 bits, several times as fast as PyTorch.
            bits = np.uint16 if self.size <= 2**16 else np.int64
            keys = self.column.numpy().astype(bits)
            order = torch.from_numpy(np.argsort(keys, kind="stable"))
        else:
            order = self.column.argsort(stable=True)
        counts = torch.bincount(self.column, minlength=self.size)
        return self._row[order], self._excess[order], offsets_of(counts)


class SparseSource(Protocol):
    """Computes sparse rows from the output of an environment."""

    in_keys: list[str]
    """Keys that the source reads."""
    size: int
    """Number of columns."""

    def __call__(self, tensordict: TensorDictBase) -> SparseRows:
        """Return the rows of a tensordict, ``[B]``."""
        ...


def offsets_of(counts: Tensor) -> Tensor:
    """Return the starts of groups with these sizes, and the end, ``[n + 1]``."""
    return torch.cat((counts.new_zeros(1), counts.cumsum(0)))


def _sums(table: Tensor, index: Tensor, scale: Tensor, offsets: Tensor) -> Tensor:
    """Return the sum of scaled rows of a table for each group."""
    return embedding_bag(
        index,
        table,
        offsets,
        mode="sum",
        per_sample_weights=scale.to(table.dtype),
        include_last_offset=True,
    )


class _Linear(torch.autograd.Function):
    """Layer output of the entries; PyTorch's gradient takes ten times as long."""

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
