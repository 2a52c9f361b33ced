"""Normalisers of the network inputs, using running statistics."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor, nn

from egoskin.sparse import SparseRows


class RunningNorm(nn.Module):
    """Normalises features by the running mean and variance of all data seen.

    Statistics are kept in float64 and change only in `update`, never in a forward
    pass, so collection and learning use the same inputs.

    Args:
        size: Number of features.
    """

    # Normalised values are clipped to this many standard deviations.
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
        """Return (x - mean) / std, times the gain and clipped, ``[*B, F]``."""
        shift, scale, limit = self.constants(x.dtype)
        return ((x - shift) * scale).clamp(-limit, limit)

    def constants(self, dtype: torch.dtype) -> tuple[Tensor, Tensor, float]:
        """Return shift and scale of `forward`, ``[F]`` or ``[1]``, and its limit."""
        scale = self._gain * (self.var + 1e-8).rsqrt()
        return self.mean.to(dtype), scale.to(dtype), self._limit

    @torch.no_grad()
    def update(self, x: Tensor) -> None:
        """Update the statistics with a batch of data, ``[*B, F]``."""
        x = x.reshape(-1, len(self.mean)).double()
        mean = x.mean(0)
        # Several times as fast as x.var(0).
        self._merge(float(len(x)), mean, (x - mean).square_().mean(0))

    def _merge(self, n: float, mean: Tensor, var: Tensor) -> None:
        """Update the statistics with mean and variance of n further samples."""
        total = self.count + n
        delta = mean - self.mean
        # Chan et al., parallel variance: M2 = M2a + M2b + delta^2 na nb / n.
        m2 = self.var * self.count + var * n + delta**2 * self.count * n / total
        self.mean += delta * n / total
        self.var.copy_(m2 / total)
        self.count.copy_(total)


class SignalNorm(RunningNorm):
    """Normalises a skin's signals by one mean and variance for all sensors.

    This keeps differences between sensors, and a sparse grid stays sparse. The total
    variance of all signals is ``WEIGHT``, whatever their number.

    Args:
        features: Number of signals, ``F``.
    """

    # As for 64 sensors with one value each; the body gives the actor 48 values.
    WEIGHT = 64.0

    def __init__(self, features: int) -> None:
        super().__init__(1)
        self._gain = math.sqrt(self.WEIGHT / features)
        # A rare detection among thousands of beams is far from the mean; not clipped.
        self._limit = self.LIMIT * max(self._gain, 1.0)

    def sparse(self, rows: SparseRows) -> SparseRows:
        """Return the result of `forward` for sparse rows, as sparse rows."""
        default = self(rows.value.new_full((1,), rows.default))
        return replace(rows, value=self(rows.value), default=float(default))

    @torch.no_grad()
    def update(self, x: Tensor | SparseRows) -> None:
        """Update the statistics with a batch of data, ``[*B, F]``."""
        if isinstance(x, Tensor):
            # In parts, since a rollout of full grids takes gigabytes in float64.
            for part in x.reshape(-1, 1).split(2**22):
                super().update(part)
            return
        values, n = x.value.double(), float(len(x) * x.size)
        # All other values are the default.
        rest = n - len(values)
        mean = ((values.sum() + rest * x.default) / n).reshape(1)
        deviation = rest * (x.default - mean).square()
        self._merge(n, mean, ((values - mean).square().sum() + deviation) / n)
