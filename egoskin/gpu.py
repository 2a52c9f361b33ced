"""Kernels of Warp, for CUDA: whether they are used, and how they are launched.

Modules with kernels import Warp; they are themselves imported only where it is used.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from importlib.util import find_spec
from typing import Any

import torch
from torch import Tensor


@cache
def has_warp() -> bool:
    """Whether Warp is installed, the library of that name by NVIDIA."""
    return find_spec("mujoco_warp") is not None


def uses_warp(*inputs: Tensor) -> bool:
    """Whether kernels of Warp compute with these tensors: on CUDA, if it is installed.

    Always False under ``torch.compile``. Kernels have no derivatives.
    """
    if torch.compiler.is_compiling():
        return False
    return all(x.is_cuda for x in inputs) and has_warp()


def init_warp() -> None:
    """Start Warp, without a log of each kernel that is loaded."""
    import warp as wp  # pyright: ignore[reportMissingImports]

    wp.config.log_level = wp.LOG_WARNING
    wp.init()


def launch(
    kernel: Any, dim: int | Sequence[int], inputs: Sequence[Any], device: torch.device
) -> None:
    """Launch a kernel after the work that PyTorch has already queued.

    Args:
        kernel: A kernel of Warp.
        dim: Number of its threads, in each dimension.
        inputs: Its arguments.
        device: A CUDA device, or the CPU.
    """
    import warp as wp  # pyright: ignore[reportMissingImports]

    stream = None
    if device.type == "cuda":
        stream = wp.stream_from_torch(torch.cuda.current_stream(device))
    where = wp.device_from_torch(device)
    wp.launch(kernel, dim, inputs, device=where, stream=stream)
