"""Imports of the server that forks the workers, done once.

The imports take seconds, in which the server does not notice the end of its parent. It
must not fork workers for a parent that has ended, so Linux then kills the server.
"""

from __future__ import annotations

import ctypes
import os
import signal
from importlib import import_module

# prctl(2) option: signal to receive when the parent ends.
_PR_SET_PDEATHSIG = 1
_prctl = getattr(ctypes.CDLL(None), "prctl", None)

if _prctl is not None:
    _prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
import_module("egoskin.make")
# The parent compiles, and says so.
os.environ[import_module("egoskin.sensors.kernels.compilation").TRIED] = "1"
if _prctl is not None:
    # From here on the server notices by itself; the thread that started it may end.
    _prctl(_PR_SET_PDEATHSIG, 0)
