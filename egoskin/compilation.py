"""Compiled kernels: the same numbers, faster, where a C++ compiler is there."""

from __future__ import annotations

import functools
import warnings
from collections.abc import Callable
from typing import ParamSpec, TypeVar

import torch
from torch import Tensor
from torch._inductor import cpp_builder, exc

P = ParamSpec("P")
T = TypeVar("T")


@functools.cache
def can_compile() -> bool:
    """Whether torch finds a C++ compiler; says so once if it does not."""
    try:
        cpp_builder.get_cpp_compiler()
    except exc.InvalidCxxCompiler:
        warnings.warn(
            "no C++ compiler was found (install g++): sensor kernels run uncompiled, "
            "with the same results",
            stacklevel=2,
        )
        return False
    return True


def exact_sqrt(x: Tensor) -> Tensor:
    """Return the correctly rounded square root, which PyTorch's own is not.

    PyTorch takes that of Intel's MKL where it has it, in which one float32 root in
    seven is off by the last bit; compiled, it is exact. Double precision, rounded, is
    exact for float32 in either.

    Args:
        x: Any tensor; float64 is as exact as PyTorch.
    """
    if torch.compiler.is_compiling() or x.dtype != torch.float32:
        return x.sqrt()
    return x.double().sqrt_().float()


def compiled(
    function: Callable[P, T], *, dynamic: bool | None = None
) -> Callable[P, T]:
    """Return a function compiled by torch, or itself where there is no compiler.

    Only for functions of +, -, x, /, square roots and comparisons: these round alike
    in vector code, scalar code and PyTorch's own kernels, so that compiling changes
    no bit.

    Args:
        function: What to compile, at its first call.
        dynamic: Whether sizes change from call to call; None finds out.
    """
    if not can_compile():
        return function
    return torch.compile(function, dynamic=dynamic, fullgraph=True)
