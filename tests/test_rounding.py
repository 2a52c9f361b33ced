"""Correct rounding."""

from __future__ import annotations

import torch

from egoskin.rounding import exact_sqrt


def test_square_roots_are_correctly_rounded():
    x = torch.rand(100_000, generator=torch.Generator().manual_seed(0)) * 4
    root = exact_sqrt(x)
    assert root.dtype == torch.float32
    # Nearer to no other float32: x lies between the squares of the middles to the next
    # ones, of 25 bits each, which float64 squares exactly.
    for end, far in ((0.0, torch.less), (torch.inf, torch.greater)):
        neighbour = torch.nextafter(root, torch.tensor(end))
        middle = (root.double() + neighbour.double()) / 2
        assert far(middle.square(), x.double()).all()
    # In float64 the square's own rounding is all that is left.
    root = exact_sqrt(x.double())
    torch.testing.assert_close(root.square(), x.double(), rtol=2**-51, atol=0)
