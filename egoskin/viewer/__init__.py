"""Pictures and films of an episode."""

from __future__ import annotations

import ctypes
import os
import sys
from contextlib import suppress


def draw_without_display() -> None:
    """Make MuJoCo render with EGL on Linux, unless ``MUJOCO_GL`` is set.

    Call this before the first import of mujoco, which selects the backend. Nothing is
    set if EGL is not installed, because mujoco could then not be imported.
    """
    if sys.platform == "linux" and not os.environ.get("MUJOCO_GL"):
        with suppress(OSError):
            ctypes.CDLL("libEGL.so.1")
            os.environ["MUJOCO_GL"] = "egl"
