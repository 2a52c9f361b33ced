"""Numbers that round right."""

from __future__ import annotations

import torch

from egoskin.rounding import exact_sqrt


def test_square_roots_are_correctly_rounded():
    x = torch.rand(10_000, generator=torch.Generator().manual_seed(0)) * 4
    assert torch.equal(exact_sqrt(x), x.double().sqrt().float())
    assert torch.equal(exact_sqrt(x.double()), x.double().sqrt())
