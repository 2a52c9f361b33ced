"""Compiling: what happens without a compiler, and numbers that round right."""

from __future__ import annotations

import pytest
import torch
from torch._inductor import cpp_builder

from egoskin.compilation import can_compile, compiled, exact_sqrt


def double(x: torch.Tensor) -> torch.Tensor:
    return 2 * x


def test_without_a_compiler_functions_run_as_they_are_and_say_so(monkeypatch):
    monkeypatch.setenv("PATH", "")
    monkeypatch.delenv("CXX", raising=False)
    # Torch, too, remembers what it found.
    cpp_builder.cpp_compiler_search.cache_clear()
    can_compile.cache_clear()
    try:
        with pytest.warns(UserWarning, match=r"install g\+\+.*uncompiled"):
            function = compiled(double)
    finally:
        can_compile.cache_clear()
    assert function is double


def test_square_roots_are_correctly_rounded():
    x = torch.rand(10_000, generator=torch.Generator().manual_seed(0)) * 4
    assert torch.equal(exact_sqrt(x), x.double().sqrt().float())
    assert torch.equal(exact_sqrt(x.double()), x.double().sqrt())
