"""Functions with identical rounding on any machine, compiled or not, for any rows."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from egoskin.gradients import is_differentiated


def pad_rows(rows: Tensor) -> Tensor:
    """Return row indices padded to a multiple of 32 by repeating the first.

    Vectorised functions (``atan2``) round differently in the scalar tail of an array
    than in its body, which is processed two vectors at a time: 32 float32 numbers with
    AVX-512. Padding makes a row's result independent of the rows computed with it.

    Args:
        rows: Indices, ``[n]`` int64, n >= 1.

    Returns:
        Indices, ``[ceil(n / 32) * 32]``.
    """
    extra = -rows.shape[0] % 32
    return torch.cat((rows, rows[:1].expand(extra)))


def exact_sqrt(x: Tensor) -> Tensor:
    """Return the correctly rounded square root.

    PyTorch's own float32 root is not: it uses Intel's MKL if available, in which one
    root in seven is off by the last bit; in compiled code it is exact. A root in double
    precision, rounded to float32, is always exact.

    Args:
        x: Any tensor; for float64 the result is that of PyTorch. At 0 the derivative is
            taken as 0: infinity would become NaN in whatever the argument depends on.
    """
    if is_differentiated(x):
        zero = x == 0
        return torch.where(zero, 0.0, _root(x.masked_fill(zero, 1.0)))
    return _root(x)


def _root(x: Tensor) -> Tensor:
    if torch.compiler.is_compiling() or x.dtype != torch.float32:
        return x.sqrt()
    return x.double().sqrt_().float()


def matvec(rows: Sequence | Tensor, vector: Sequence | Tensor) -> list[Tensor]:
    """Return the product of matrices with vectors, three coordinates ``[*B]``.

    Written out: a library's product may round differently for another batch.

    Args:
        rows: Matrices, ``[3, 3, *B]``.
        vector: Vectors, ``[3, *B]``, broadcastable.
    """
    x, y, z = vector
    return [row[0] * x + row[1] * y + row[2] * z for row in rows]


def matmul(a: Tensor, b: Tensor) -> Tensor:
    """Return the product of matrices, ``[3, 3, *B]``; see `matvec`.

    Args:
        a: ``[3, 3, *B]``.
        b: ``[3, 3, *B]``, broadcastable.
    """
    columns = b.transpose(0, 1)
    return torch.stack([torch.stack(matvec(columns, row)) for row in a])


# pi/2 = HIGH + MIDDLE + LOW. The first two have only a few bits each (Cephes), so that
# their products with a small integer are exact.
HIGH, MIDDLE, LOW = 1.5703125, 4.837512969970703125e-4, 7.54978995489188216e-8


def sincos(x: Tensor) -> tuple[Tensor, Tensor]:
    """Return (sine, cosine), accurate to the last bit or two.

    Only sums and products are used: PyTorch's functions differ between compiled code,
    vector code and the tail of an array.

    Args:
        x: Joint angles [rad], up to some hundreds.
    """
    # x = n pi/2 + r, |r| <= pi/4
    n = (x * (2 / math.pi)).round()
    r = ((x - n * HIGH) - n * MIDDLE) - n * LOW
    z, terms = r * r, 9 if x.dtype == torch.float64 else 5
    # Taylor's series; the first term left out is below half of the last bit.
    s, c = torch.zeros_like(r), torch.zeros_like(r)
    for i in range(terms - 1, 0, -1):
        s = (s + (-1) ** i / math.factorial(2 * i + 1)) * z
        c = (c + (-1) ** (i + 1) / math.factorial(2 * i + 2)) * z
    s, c = r + r * s, 1 + z * (c - 0.5)
    half = (n * 0.5).floor()
    swapped, sign = n - 2 * half > 0.5, 1 - 2 * (half - 2 * (half * 0.5).floor())
    return torch.where(swapped, c, s) * sign, torch.where(swapped, -s, c) * sign
