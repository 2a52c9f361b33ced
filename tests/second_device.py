"""A second device without its hardware: tensors that carry its label, on the CPU.

Code for a GPU fails where tensors of two devices meet. Here such an operation raises,
on any machine, and results have the bits of the CPU. Not possible: gradients, for which
autograd asks the device, and indexing by a list.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import fields, is_dataclass, replace
from typing import Any

import torch
from torch import Tensor, nn
from torch.overrides import TorchFunctionMode
from torch.utils import backend_registration
from torch.utils._python_dispatch import TorchDispatchMode, _disable_current_modes
from torch.utils._pytree import tree_leaves, tree_map

from egoskin.envs.physics.contract import Physics
from egoskin.envs.physics.mujoco import MujocoPhysics

DEVICE = torch.device("privateuseone", 0)
_SETUP = "_setup_privateuseone_for_python_backend"
AVAILABLE = hasattr(backend_registration, _SETUP)
"""Whether this version of PyTorch has devices that are implemented in Python."""
# Operations that move data between devices.
_MOVES = ("aten::_to_copy", "aten::copy_", "aten::_local_scalar_dense")


class Labelled(Tensor):
    """A tensor on the second device; ``content`` is the tensor on the CPU."""

    content: Tensor

    @staticmethod
    def __new__(cls, content: Tensor) -> Labelled:
        made = Tensor._make_wrapper_subclass(  # type: ignore[attr-defined]
            cls,
            content.size(),
            strides=content.stride(),
            storage_offset=content.storage_offset(),
            dtype=content.dtype,
            device=DEVICE,
        )
        made.content = content
        return made

    def __repr__(self, **options: Any) -> str:
        return f"Labelled({self.content!r})"

    @classmethod
    def __torch_dispatch__(cls, func, types, args=(), kwargs=None):
        return _run(func, args, kwargs or {})


def _is_ours(device: torch.device | str | int | None) -> bool:
    return device is not None and torch.device(device).type == DEVICE.type


def _content(value: Any) -> Any:
    return value.content if isinstance(value, Labelled) else value


def _label(value: Any) -> Any:
    return Labelled(value) if isinstance(value, Tensor) else value


def _run(func: Any, args: tuple, kwargs: dict[str, Any]) -> Any:
    """Run an operation on the CPU; label its results if they are on the device."""
    schema = func._schema
    tensors = [x for x in tree_leaves((args, kwargs)) if isinstance(x, Tensor)]
    ours = any(isinstance(x, Labelled) for x in tensors)
    if ours and schema.name not in _MOVES:
        for tensor in tensors:
            # Numbers may be on the CPU.
            if tensor.ndim and not isinstance(tensor, Labelled):
                raise RuntimeError(
                    f"{schema.name}: a tensor {tuple(tensor.shape)} on {tensor.device} "
                    f"beside one on {DEVICE}"
                )
    device = kwargs.get("device")
    if _is_ours(device):
        kwargs = {**kwargs, "device": torch.device("cpu")}
    result = func(*tree_map(_content, args), **tree_map(_content, kwargs))
    if schema.is_mutable and len(schema.returns) == 1:
        for argument, given in zip(schema.arguments, args, strict=False):
            if argument.alias_info is not None and argument.alias_info.is_write:
                return given
        return kwargs.get("out", result)
    here = ours if device is None else _is_ours(device)
    return tree_map(_label, result) if here else result


class _Factories(TorchDispatchMode):
    """Operations without a labelled argument."""

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        return _run(func, args, kwargs or {})


class _Literals(TorchFunctionMode):
    """Tensors from Python's numbers, and copies, which PyTorch makes by itself."""

    def __torch_function__(self, func, types, args=(), kwargs=None):
        kwargs = dict(kwargs or {})
        ours = bool(args) and isinstance(args[0], Labelled)
        if func in (torch.tensor, torch.as_tensor) and _is_ours(kwargs.get("device")):
            made = func(*tree_map(_content, args), **{**kwargs, "device": "cpu"})
            return args[0] if ours else Labelled(made)
        if func is Tensor.new_tensor and ours:
            return Labelled(args[0].content.new_tensor(*args[1:], **kwargs))
        if func is Tensor.__deepcopy__ and ours:
            tensor, memo = args
            copy = Labelled(tensor.content.clone())
            if isinstance(tensor, nn.Parameter):
                copy = nn.Parameter(copy, requires_grad=tensor.requires_grad)
            return memo.setdefault(id(tensor), copy)
        return func(*args, **kwargs)


@functools.cache
def _set_up() -> None:
    """Let PyTorch know the device, in this process."""
    getattr(backend_registration, _SETUP)()
    # tensordict waits for the device after a copy to the CPU.
    module = type(torch.get_device_module(DEVICE))
    module.synchronize = lambda self, device=None: None  # type: ignore[attr-defined]


@contextmanager
def second_device() -> Iterator[torch.device]:
    """Yield the device; while the context is open, it works."""
    _set_up()
    with _Factories(), _Literals():
        yield DEVICE


def _each(function: Callable[[Any], Any], value: Any) -> Any:
    """Apply a function to a value or, of a dataclass, to each of its fields."""
    if is_dataclass(value) and not isinstance(value, type):
        parts = {f.name: _each(function, getattr(value, f.name)) for f in fields(value)}
        return replace(value, **parts)
    return function(value)


class OnSecondDevice(MujocoPhysics):
    """An engine on the second device, with the results of MuJoCo."""

    def __init__(self, scene, num_envs, *, num_threads=1, device="cpu") -> None:
        assert _is_ours(device)
        with _disable_current_modes():
            super().__init__(scene, num_envs, num_threads=num_threads)


def _on_device(name: str):
    def method(self, *args):
        if name != "load_state":  # from a file
            tensors = [x for x in args if isinstance(x, Tensor)]
            assert all(isinstance(x, Labelled) for x in tensors), name
        with _disable_current_modes():
            on_cpu = [_each(_content, arg) for arg in args]
            return _each(_label, getattr(MujocoPhysics, name)(self, *on_cpu))

    return method


for _name in Physics.__abstractmethods__ - {"__init__"}:
    setattr(OnSecondDevice, _name, _on_device(_name))
