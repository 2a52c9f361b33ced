"""The C++ kernels of the sensors, called from Python; `kernels.cpp` holds them."""

from __future__ import annotations

import ctypes
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from egoskin.robots.kinematics import LinkKinematics
from egoskin.sensors.kernels.compilation import load_library
from egoskin.shapes import Sphere

VECTOR = 16
"""Numbers that the kernels work on together."""

SOURCE = Path(__file__).with_name("kernels.cpp")
"""What `load_library` compiles."""

_NAMES = {torch.float32: "float32", torch.float64: "float64"}
_COUNTS = (
    *("joints", "steps", "links", "sensors", "objects"),
    *("beams", "cull", "reduce", "apart"),
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
    """What C++ computes of balls and a skin on a robot that is transparent to it.

    Where it cannot be compiled, `can` says no.

    Args:
        kind: Coverage of all sensors.
        kinematics: Of the links that they are on.
        balls: What is sensed.
        constants: What else `Tables` of kernels.cpp holds: counts, flags and arrays;
            what is missing is 0 or null.
    """

    def __init__(
        self,
        kind: Literal["field", "ray"],
        kinematics: LinkKinematics,
        balls: Sequence[Sphere],
        constants: Mapping[str, Any],
    ) -> None:
        self._kind = kind
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
        # The arrays are kept: a table holds their addresses alone.
        self._tables: dict[torch.dtype, tuple[_Tables, list[np.ndarray]]] = {}

    def __getstate__(self) -> dict[str, Any]:
        """Return what can be copied into another process."""
        return {**vars(self), "_library": None, "_tables": {}}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Find the library again."""
        vars(self).update(state)
        self._library = load_library(SOURCE)

    def set_constants(self, **constants: Any) -> None:
        """Give some of the constants other values.

        Args:
            constants: As of the class.
        """
        self._constants.update(constants)
        self._tables.clear()

    def can(self, *inputs: Tensor) -> bool:
        """Whether the kernels take these inputs: on the CPU, and without gradients."""
        if self._library is None or torch.compiler.is_compiling():
            return False
        grad = torch.is_grad_enabled()
        return all(
            x.is_cpu and x.dtype in _NAMES and not (grad and x.requires_grad)
            for x in inputs
        )

    def poses(self, joint_pos: Tensor, position: Tensor, rotation: Tensor) -> None:
        """Write the sensors' poses in the base frame.

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
            detected: ``[B, O]``, contiguous; false before.
        """
        self._call(self._kind, inputs, _address(out), _address(detected))

    def hits(self, inputs: Sequence[Tensor]) -> tuple[Tensor, Tensor]:
        """Return what `RaySensor.hits` says.

        Args:
            inputs: As of `measure`.
        """
        # A dozen beams of a row hit; where more do, a second call has the room.
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
        """Call a kernel; all of its inputs are of the type of the joint positions."""
        dtype = inputs[1].dtype
        # The numbers of a row must be next to each other.
        rows = [x.flatten(1) for x in inputs]
        rows = [x if x.stride(-1) == 1 else x.contiguous() for x in rows]
        given = _Inputs(
            len(inputs[1]),
            (ctypes.c_void_p * 4)(*(x.data_ptr() for x in rows)),
            (ctypes.c_int64 * 4)(*(x.stride(0) for x in rows)),
        )
        function = getattr(self._library, f"{name}_{_NAMES[dtype]}")
        function.restype = ctypes.c_int64
        tables = ctypes.byref(self._of_type(dtype))
        return function(tables, ctypes.byref(given), *arguments)

    def _of_type(self, dtype: torch.dtype) -> _Tables:
        """Return the constants in a floating type."""
        if dtype not in self._tables:
            arrays = []
            tables = _Tables()
            for name, value in self._constants.items():
                if value is not None and name in _ARRAYS:
                    value = np.ascontiguousarray(value)
                    if value.dtype == np.float64:
                        value = value.astype(_NAMES[dtype])
                    arrays.append(value)
                    value = value.ctypes.data
                setattr(tables, name, value)
            self._tables[dtype] = tables, arrays
        return self._tables[dtype][0]


def _address(x: Tensor) -> ctypes.c_void_p:
    """Return where a tensor's numbers are."""
    return ctypes.c_void_p(x.data_ptr())
