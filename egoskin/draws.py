"""Random numbers that depend on *what* is drawn, never on when or by whom.

Every draw of the project is a pure function of (seed, row, episode, counter,
stream): the counter-based generator Philox4x32-10. A worker that simulates rows
2048 to 4095 draws for them what a single process would have drawn, so results do
not depend on the number of workers, threads or on the order of resets.

Source: Salmon et al., "Parallel random numbers: as easy as 1, 2, 3", SC 2011.
"""

from __future__ import annotations

from enum import IntEnum

import torch
from torch import Tensor

_MASK = 0xFFFFFFFF
# Multipliers and Weyl constants of Philox4x32, from the paper above.
_M0, _M1 = 0xD2511F53, 0xCD9E8D57
_W0, _W1 = 0x9E3779B9, 0xBB67AE85


class Stream(IntEnum):
    """What a draw is for; two streams never share numbers."""

    START = 0
    THROW = 1
    SENSOR = 2


def philox(counter: Tensor, key: tuple[int, int]) -> Tensor:
    """Return four random 32-bit words per counter (Philox4x32-10).

    Args:
        counter: Four 32-bit words, ``[4, *B]`` int64, each in [0, 2**32).
        key: Two 32-bit words.

    Returns:
        Random words in [0, 2**32), ``[4, *B]`` int64.
    """
    c0, c1, c2, c3 = counter.unbind(0)
    k0, k1 = key
    for _ in range(10):
        # int64 products wrap modulo 2**64; the masks recover both halves exactly.
        p0, p1 = c0 * _M0, c2 * _M1
        c0, c1, c2, c3 = (
            ((p1 >> 32) & _MASK) ^ c1 ^ k0,
            p1 & _MASK,
            ((p0 >> 32) & _MASK) ^ c3 ^ k1,
            p0 & _MASK,
        )
        k0, k1 = (k0 + _W0) & _MASK, (k1 + _W1) & _MASK
    return torch.stack((c0, c1, c2, c3))


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
        seed: Run seed, in [0, 2**32).
        stream: Purpose of the draw.
        row: Global agent row, ``[*B]`` int64.
        episode: Episode of that row, ``[*B]`` int64.
        counter: Index within the episode (a step, or the n-th throw),
            ``[*B]`` int64.
        size: How many numbers for each element of the batch.

    Returns:
        Multiples of 2**-24 in [0, 1), ``[*B, size]`` float32.

    Raises:
        ValueError: If the seed is not a 32-bit unsigned integer.
    """
    if not 0 <= seed <= _MASK:
        raise ValueError(f"seed must be in [0, 2**32), got {seed}")
    blocks = []
    for block in range(-(-size // 4)):
        words = torch.stack((row, episode, counter, torch.full_like(row, block)))
        blocks.append(philox(words & _MASK, (seed, int(stream))))
    bits = torch.cat(blocks)[:size].movedim(0, -1)
    return (bits >> 8).to(torch.float32) * 2.0**-24
