"""Counter-based random numbers, independent of the order of draws.

Every draw of environments and sensors is a pure function of (seed, row, episode,
counter, stream), computed by the generator Philox4x32-10. A worker that simulates rows
2048 to 4095 draws the same numbers for them as a single process would. Results
therefore do not depend on the number of workers or threads, or on the order of resets.

Source: Salmon et al., "Parallel random numbers: as easy as 1, 2, 3", SC 2011.
"""

from __future__ import annotations

from enum import IntEnum
from functools import cache
from numbers import Integral

import torch
from torch import Tensor

from egoskin.gpu import uses_warp

_MASK = 0xFFFFFFFF
# Bit that marks a held-out seed, and the bit for it in the key's second word, above the
# bits of the streams.
_HELD_OUT, _HELD_OUT_KEY = 1 << 32, 1 << 16
# Multipliers and Weyl constants of Philox4x32, from the paper above.
_M0, _M1 = 0xD2511F53, 0xCD9E8D57
_W0, _W1 = 0x9E3779B9, 0xBB67AE85


class Stream(IntEnum):
    """Purpose of a draw; two streams never share numbers."""

    START = 0
    THROW = 1
    SENSOR = 2
    FIRST_DELAY = 3
    ROBOT = 4
    DELAY = 5
    PUSH = 6


def philox(counter: Tensor, key: tuple[int, int]) -> Tensor:
    """Return four random 32-bit words per counter (Philox4x32-10).

    On CUDA it is one kernel instead of 120 operations, if Warp is installed.

    Args:
        counter: Four 32-bit words, ``[4, *B]`` int64, each in [0, 2**32).
        key: Two 32-bit words.

    Returns:
        Random words in [0, 2**32), ``[4, *B]`` int64.
    """
    if uses_warp(counter):
        from egoskin.warp_philox import philox as kernel

        return kernel(counter, key)
    c0, c1, c2, c3 = counter.unbind(0)
    k0, k1 = key
    for _ in range(10):
        # int64 products wrap modulo 2**64; shift and mask recover both halves exactly.
        p0, p1 = c0 * _M0, c2 * _M1
        high0, high1 = p0 >> 32, p1 >> 32
        # In place, because allocation takes half of the time of a round.
        c0, c1, c2, c3 = (
            high1.bitwise_and_(_MASK).bitwise_xor_(c1).bitwise_xor_(k0),
            p1.bitwise_and_(_MASK),
            high0.bitwise_and_(_MASK).bitwise_xor_(c3).bitwise_xor_(k1),
            p0.bitwise_and_(_MASK),
        )
        k0, k1 = (k0 + _W0) & _MASK, (k1 + _W1) & _MASK
    return torch.stack((c0, c1, c2, c3))


def check_seed(seed: int, name: str = "seed") -> None:
    """Raise ValueError for a seed that is not a 32-bit unsigned integer."""
    if not isinstance(seed, Integral):
        raise ValueError(f"{name} must be an integer, got {seed!r}")
    if not 0 <= seed <= _MASK:
        raise ValueError(f"{name} must be in [0, 2**32), got {seed}")


def held_out(seed: int) -> int:
    """Return the held-out version of a seed, whose draws no training uses.

    Args:
        seed: A seed that a user may choose, in [0, 2**32).

    Raises:
        ValueError: If it is not a 32-bit unsigned integer.
    """
    check_seed(seed)
    return seed | _HELD_OUT


def offset_seed(seed: int, offset: int) -> int:
    """Return another seed, held out if the given one is.

    Args:
        seed: A seed, or the result of `held_out`.
        offset: Offset to add, modulo 2**32; 0 gives the same seed.
    """
    return ((seed + offset) & _MASK) | (seed & _HELD_OUT)


def stream_key(seed: int, stream: Stream) -> tuple[int, int]:
    """Return the two words of the generator's key.

    Args:
        seed: A seed in [0, 2**32), or the result of `held_out`.
        stream: Purpose of the draws.

    Raises:
        ValueError: If the seed is neither of them.
    """
    if not isinstance(seed, Integral) or not 0 <= seed & ~_HELD_OUT <= _MASK:
        check_seed(seed)
    return seed & ~_HELD_OUT, int(stream) | (_HELD_OUT_KEY if seed & _HELD_OUT else 0)


def random_words(
    seed: int,
    stream: Stream,
    row: Tensor,
    episode: Tensor,
    counter: Tensor,
    block: Tensor,
) -> Tensor:
    """Return four random 32-bit words for each element, a function of the arguments.

    Args:
        seed: Run seed, in [0, 2**32), or the result of `held_out`.
        stream: Purpose of the draw.
        row: Global agent row, ``[*B]`` int64.
        episode: Episode of that row, ``[*B]`` int64.
        counter: Index within the episode (a step, or the n-th throw),
            ``[*B]`` int64.
        block: Index of the four words within the draw, ``[*B]`` int64.

    Returns:
        Random words in [0, 2**32), ``[4, *B]`` int64.

    Raises:
        ValueError: If the seed is neither of these.
    """
    words = torch.stack((row, episode, counter, block))
    return philox(words & _MASK, stream_key(seed, stream))


def uniform(
    seed: int,
    stream: Stream,
    row: Tensor,
    episode: Tensor,
    counter: Tensor,
    size: int,
) -> Tensor:
    """Return uniform numbers in [0, 1), a pure function of the arguments.

    Args:
        seed: Run seed, in [0, 2**32), or the result of `held_out`.
        stream: Purpose of the draw.
        row: Global agent row, ``[*B]`` int64.
        episode: Episode of that row, ``[*B]`` int64.
        counter: Index within the episode (a step, or the n-th throw),
            ``[*B]`` int64.
        size: Number of values for each element of the batch.

    Returns:
        Multiples of 2**-24 in [0, 1), ``[*B, size]`` float32.

    Raises:
        ValueError: If the seed is neither of these.
    """
    shape = (-(-size // 4), *row.shape)
    block = torch.arange(shape[0], device=row.device).reshape(-1, *[1] * row.ndim)
    what = (x.expand(shape) for x in (row, episode, counter, block))
    # [4, blocks, *B]: the numbers of one element are four words of each block.
    words = random_words(seed, stream, *what).transpose(0, 1).flatten(0, 1)
    bits = words[:size].movedim(0, -1)
    return (bits >> 8).to(torch.float32) * 2.0**-24


def between(bounds: tuple[float, float], u: Tensor) -> Tensor:
    """Return numbers in an interval from uniform numbers in [0, 1)."""
    low, high = bounds
    return low + (high - low) * u


def halfwords(words: Tensor) -> Tensor:
    """Return random words as twice as many 16-bit numbers.

    Args:
        words: Random words in [0, 2**32), ``[W, *B]`` int64.

    Returns:
        Numbers in [0, 2**16), ``[*B, 2 W]`` int64.
    """
    words = words.movedim(0, -1)
    return torch.stack((words & 0xFFFF, words >> 16), -1).flatten(-2)


@cache
def _normal_quantiles(dtype: torch.dtype, device: torch.device) -> Tensor:
    middle = (torch.arange(2**16, dtype=torch.float64) + 0.5) * 2.0**-16
    return torch.special.ndtri(middle).to(device, dtype)


def standard_normal(half: Tensor, dtype: torch.dtype = torch.float32) -> Tensor:
    """Return standard normal numbers from 16-bit ones: 2**16 quantiles within +-4.3.

    They are read from a table, so that each result depends only on its 16 bits:
    functions like ``log`` round differently in the body and in the tail of a vectorised
    loop.

    Args:
        half: Numbers in [0, 2**16), ``[*B]`` int64.
        dtype: Type of the result.

    Returns:
        The quantiles at (half + 1/2) / 2**16, ``[*B]``.
    """
    return _normal_quantiles(dtype, half.device).take(half)
