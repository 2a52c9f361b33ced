"""Whether derivatives are computed with respect to a tensor."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.autograd import forward_ad


def is_dual(x: Tensor) -> bool:
    """Whether a tensor has a forward-mode derivative, or belongs to `torch.func`.

    Neither is seen in its data. Under ``torch.compile``, where neither can be known, it
    is taken for granted.
    """
    if torch.compiler.is_compiling():
        return True
    wrapped = torch._C._functorch.is_functorch_wrapped_tensor(x)
    return wrapped or forward_ad.unpack_dual(x).tangent is not None


def is_differentiated(x: Tensor) -> bool:
    """Whether a tensor has derivatives, of reverse or forward mode."""
    return x.requires_grad or is_dual(x)
