"""Normalisers of what the networks read, by running statistics."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor, nn

from egoskin.sparse import SparseRows


class RunningNorm(nn.Module):
    """Normalises features by the running mean and variance of all data seen.

    Statistics are kept in float64 and change only in `update`, never in a forward
    pass: collection and learning see the same input.

    Args:
        size: Number of features.
    """

    # Normalised values beyond this many standard deviations are cut off.
    LIMIT = 10.0
    count: Tensor
    mean: Tensor
    var: Tensor

    def __init__(self, size: int) -> None:
        super().__init__()
        self._gain, self._limit = 1.0, self.LIMIT
        self.register_buffer("count", torch.zeros((), dtype=torch.float64))
        self.register_buffer("mean", torch.zeros(size, dtype=torch.float64))
        self.register_buffer("var", torch.ones(size, dtype=torch.float64))

    def forward(self, x: Tensor) -> Tensor:
        """Return (x - mean) / std, times the gain and cut off, ``[*B, F]``."""
        shift, scale, limit = self.constants(x.dtype)
        return ((x - shift) * scale).clamp(-limit, limit)

    def constants(self, dtype: torch.dtype) -> tuple[Tensor, Tensor, float]:
        """Return shift and scale, ``[F]`` or ``[1]`` each, and limit of `forward`."""
        scale = self._gain * (self.var + 1e-8).rsqrt()
        return self.mean.to(dtype), scale.to(dtype), self._limit

    @torch.no_grad()
    def update(self, x: Tensor) -> None:
        """Take a batch of data into the statistics, ``[*B, F]``."""
        x = x.reshape(-1, len(self.mean)).double()
        mean = x.mean(0)
        # Several times as fast as x.var(0).
        self._merge(float(len(x)), mean, (x - mean).square_().mean(0))

    def _merge(self, n: float, mean: Tensor, var: Tensor) -> None:
        """Take mean and variance of n more into the statistics."""
        total = self.count + n
        delta = mean - self.mean
        # Chan et al., parallel variance: M2 = M2a + M2b + delta^2 na nb / n.
        m2 = self.var * self.count + var * n + delta**2 * self.count * n / total
        self.mean += delta * n / total
        self.var.copy_(m2 / total)
        self.count.copy_(total)


class SignalNorm(RunningNorm):
    """Normalises a skin's signals by one mean and variance for all sensors.

    What differs between sensors still does, and a sparse grid stays sparse. All
    signals together have the variance ``WEIGHT``, be they three or thousands.

    Args:
        features: Number of signals, ``F``.
    """

    # That of 64 sensors of one number each; the actor knows 48 of its body.
    WEIGHT = 64.0

    def __init__(self, features: int) -> None:
        super().__init__(1)
        self._gain = math.sqrt(self.WEIGHT / features)
        # What is rare among thousands of beams is far from their mean: it stays.
        self._limit = self.LIMIT * max(self._gain, 1.0)

    def sparse(self, rows: SparseRows) -> SparseRows:
        """Return what `forward` would, as sparse rows."""
        default = self(rows.value.new_full((1,), rows.default))
        return replace(rows, value=self(rows.value), default=float(default))

    @torch.no_grad()
    def update(self, x: Tensor | SparseRows) -> None:
        """Take a batch of data into the statistics, ``[*B, F]``."""
        if isinstance(x, Tensor):
            # In parts: a rollout of full grids takes gigabytes in float64.
            for part in x.reshape(-1, 1).split(2**22):
                super().update(part)
            return
        values, n = x.value.double(), float(len(x) * x.size)
        # All others are the default.
        rest = n - len(values)
        mean = ((values.sum() + rest * x.default) / n).reshape(1)
        deviation = rest * (x.default - mean).square()
        self._merge(n, mean, ((values - mean).square().sum() + deviation) / n)
