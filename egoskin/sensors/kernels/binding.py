"""Python binding of the sensors' kernels: C++ (`kernels.cpp`) and, for CUDA, Warp."""

from __future__ import annotations

import ctypes
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import torch
from torch import Tensor

from egoskin.gpu import uses_warp
from egoskin.gradients import is_dual
from egoskin.robots.kinematics import LinkKinematics
from egoskin.sensors.kernels.compilation import load_library
from egoskin.shapes import Sphere

if TYPE_CHECKING:
    from egoskin.sensors.kernels.warp import WarpKernels

VECTOR = 16
"""Vector size of the kernels."""

SOURCE = Path(__file__).with_name("kernels.cpp")
"""C++ source of the kernels."""

_COUNTS = (
    *("joints", "steps", "links", "sensors", "objects"),
    *("beams", "reduce", "apart"),
)
_ARRAYS = (
    *("joint", "parent", "frame", "link"),
    *("constant", "by_cos", "by_sin", "shift", "slide"),
    *("offset", "axes", "range", "radius", "squared", "bound", "farthest"),
    *("cos_half", "reach", "pyramid", "directions", "grid", "depth"),
)


class _Tables(ctypes.Structure):
    """`Tables` of kernels.cpp."""

    _fields_ = [
        *((name, ctypes.c_int64) for name in _COUNTS),
        *((name, ctypes.c_void_p) for name in _ARRAYS),
    ]


class _Inputs(ctypes.Structure):
    """`Inputs` of kernels.cpp."""

    _fields_ = [
        ("rows", ctypes.c_int64),
        ("address", ctypes.c_void_p * 4),
        ("stride", ctypes.c_int64 * 4),
    ]


class Kernels:
    """Compiled implementation of the sensors for balls and without occlusion.

    It is in C++ for float32 tensors on the CPU and in Warp for those on a CUDA device.
    `can` returns False if the C++ code cannot be compiled or Warp is not installed.

    Args:
        kind: Coverage of all sensors.
        kinematics: Kinematics of the links that carry sensors.
        balls: The objects.
        constants: The other entries of `Tables` in kernels.cpp: counts, flags and
            arrays; missing ones are 0 or null.
    """

    def __init__(
        self,
        kind: Literal["field", "ray"],
        kinematics: LinkKinematics,
        balls: Sequence[Sphere],
        constants: Mapping[str, Any],
    ) -> None:
        self._kind: Literal["field", "ray"] = kind
        self._library = load_library(SOURCE)
        steps = kinematics.steps
        radius = np.array([float(ball.radius) for ball in balls])
        self._constants: dict[str, Any] = {
            **steps._asdict(),
            "joints": kinematics.num_joints,
            "steps": len(steps.parent),
            "links": len(kinematics.links),
            "frame": kinematics.frames,
            "objects": len(balls),
            "radius": radius,
            "squared": radius * radius,
            **constants,
        }
        # The arrays must be kept alive: the tables hold only their addresses.
        self._tables: tuple[_Tables, list[np.ndarray]] | None = None
        self._warp: dict[torch.device, WarpKernels] = {}

    def __getstate__(self) -> dict[str, Any]:
        """Return the state without what cannot be pickled."""
        return {**vars(self), "_library": None, "_tables": None, "_warp": {}}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Restore the state and load the library again."""
        vars(self).update(state)
        self._library = load_library(SOURCE)

    def set_constants(self, **constants: Any) -> None:
        """Change some of the constants.

        Args:
            constants: As in the class.
        """
        # Not in place: copies share the dictionary.
        self._constants = {**self._constants, **constants}
        self._tables = None
        self._warp.clear()

    def can(self, *inputs: Tensor) -> bool:
        """Whether the kernels support these inputs: float32, without derivatives.

        Always False under ``torch.compile``.
        """
        if torch.is_grad_enabled() and any(x.requires_grad for x in inputs):
            return False
        if any(is_dual(x) for x in inputs):
            return False
        if any(x.dtype != torch.float32 for x in inputs):
            return False
        if all(x.is_cpu for x in inputs):
            return self._library is not None
        return uses_warp(*inputs)

    def on(self, device: torch.device) -> WarpKernels:
        """Return the Warp kernels of a device."""
        if device not in self._warp:
            from egoskin.sensors.kernels.warp import WarpKernels

            self._warp[device] = WarpKernels(self._kind, self._constants, device)
        return self._warp[device]

    def poses(self, joint_pos: Tensor, position: Tensor, rotation: Tensor) -> None:
        """Write the sensors' poses in the base frame, on the CPU.

        Args:
            joint_pos: Joint positions, ``[B, J]``.
            position: [m], ``[B, S, 3]``, contiguous.
            rotation: ``[B, S, 3, 3]``, contiguous.
        """
        none = joint_pos.new_empty(0, 0)
        to = map(_address, (position, rotation))
        self._call("poses", (none, joint_pos, none, none), *to)

    def measure(self, inputs: Sequence[Tensor], out: Tensor, detected: Tensor) -> None:
        """Write readings and detections.

        Args:
            inputs: Base pose, joint positions, object poses, active flags.
            out: Readings [m], contiguous.
            detected: ``[B, O]``, contiguous; must be all False.
        """
        if out.is_cuda:
            self.on(out.device).measure(inputs, out, detected)
        else:
            self._call(self._kind, inputs, _address(out), _address(detected))

    def hits(self, inputs: Sequence[Tensor]) -> tuple[Tensor, Tensor]:
        """Return the result of `RaySensor.hits`.

        Args:
            inputs: As in `measure`.
        """
        if inputs[0].is_cuda:
            return self.on(inputs[0].device).hits(inputs)
        # About a dozen beams per row hit. If more hit than there is room for, a second
        # call follows.
        room = 32 * len(inputs[0])
        while True:
            place = torch.empty(room, dtype=torch.int64)
            reading = inputs[0].new_empty(room)
            to = map(_address, (place, reading))
            found = self._call("hits", inputs, ctypes.c_int64(room), *to)
            if found <= room:
                return place[:found], reading[:found]
            room = found

    def _call(self, name: str, inputs: Sequence[Tensor], *arguments: object) -> int:
        """Call a kernel."""
        # Rows must be contiguous.
        rows = [x.flatten(1) for x in inputs]
        rows = [x if x.stride(-1) == 1 else x.contiguous() for x in rows]
        given = _Inputs(
            len(inputs[1]),
            (ctypes.c_void_p * 4)(*(x.data_ptr() for x in rows)),
            (ctypes.c_int64 * 4)(*(x.stride(0) for x in rows)),
        )
        if self._tables is None:
            self._tables = _tables(self._constants)
        function = getattr(self._library, f"egoskin_{name}")
        function.restype = ctypes.c_int64
        tables = ctypes.byref(self._tables[0])
        return function(tables, ctypes.byref(given), *arguments)


def _tables(constants: Mapping[str, Any]) -> tuple[_Tables, list[np.ndarray]]:
    """Return the constants for the kernels, and the arrays that they point to."""
    tables, arrays = _Tables(), []
    for name, value in constants.items():
        if value is not None and name in _ARRAYS:
            value = np.ascontiguousarray(value)
            if value.dtype == np.float64:
                value = value.astype(np.float32)
            arrays.append(value)
            value = value.ctypes.data
        setattr(tables, name, value)
    return tables, arrays


def _address(x: Tensor) -> ctypes.c_void_p:
    """Return the address of a tensor's data."""
    return ctypes.c_void_p(x.data_ptr())
