"""The generator of `egoskin.rng` as a kernel of Warp, for CUDA.

It is integer arithmetic, with the bits of the PyTorch code. Warp's CPU device runs it
as well; it is meant for tests.
"""

# Type checkers do not know the types of kernels.
# pyright: reportInvalidTypeForm=false, reportGeneralTypeIssues=false
# pyright: reportArgumentType=false, reportOperatorIssue=false

from __future__ import annotations

import torch
import warp as wp  # pyright: ignore[reportMissingImports]
from torch import Tensor

from egoskin.gpu import init_warp, launch

init_warp()
wp.set_module_options({"enable_backward": False})

_Words = wp.array(dtype=wp.int64, ndim=2)
# Multipliers and Weyl constants, as in `egoskin.rng`.
_M0, _M1 = wp.constant(wp.uint64(0xD2511F53)), wp.constant(wp.uint64(0xCD9E8D57))
_W0, _W1 = wp.constant(wp.uint32(0x9E3779B9)), wp.constant(wp.uint32(0xBB67AE85))
_HALF = wp.constant(wp.uint64(32))


@wp.kernel
def _philox(counter: _Words, key0: wp.uint32, key1: wp.uint32, words: _Words):
    """Write four random words for each counter, ``[4, n]`` both."""
    i = wp.tid()
    c0 = wp.uint32(counter[0, i])
    c1 = wp.uint32(counter[1, i])
    c2 = wp.uint32(counter[2, i])
    c3 = wp.uint32(counter[3, i])
    k0 = wp.uint32(key0)
    k1 = wp.uint32(key1)
    for _ in range(10):
        p0 = wp.uint64(c0) * _M0
        p1 = wp.uint64(c2) * _M1
        c0 = wp.uint32(p1 >> _HALF) ^ c1 ^ k0
        c1 = wp.uint32(p1)
        c2 = wp.uint32(p0 >> _HALF) ^ c3 ^ k1
        c3 = wp.uint32(p0)
        k0 = k0 + _W0
        k1 = k1 + _W1
    words[0, i] = wp.int64(c0)
    words[1, i] = wp.int64(c1)
    words[2, i] = wp.int64(c2)
    words[3, i] = wp.int64(c3)


def philox(counter: Tensor, key: tuple[int, int]) -> Tensor:
    """Return the result of `egoskin.rng.philox`, computed on the counter's device."""
    given = counter.contiguous()
    words, n = torch.empty_like(given), given[0].numel()
    read, written = (wp.from_torch(x.view(4, n)) for x in (given, words))
    launch(_philox, n, [read, *map(wp.uint32, key), written], given.device)
    return words
