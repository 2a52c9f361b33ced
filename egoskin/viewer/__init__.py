"""Pictures and films of an episode."""

from __future__ import annotations

import ctypes
import os
import sys
from contextlib import suppress


def draw_without_display() -> None:
    """Let MuJoCo draw by EGL, on Linux, unless ``MUJOCO_GL`` asks for another way.

    Call this before mujoco is first imported, which is when it chooses. Where EGL is
    not installed nothing is asked for: mujoco could not be imported.
    """
    if sys.platform == "linux" and not os.environ.get("MUJOCO_GL"):
        with suppress(OSError):
            ctypes.CDLL("libEGL.so.1")
            os.environ["MUJOCO_GL"] = "egl"
