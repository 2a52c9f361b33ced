"""What the server that forks the workers imports, once.

It takes seconds, in which the server sees nothing. If its parent ends meanwhile, it
must not fork, much later, what the parent had asked for: Linux then ends it.
"""

from __future__ import annotations

import ctypes
import signal
from importlib import import_module

# prctl(2): a signal when the parent ends.
_PR_SET_PDEATHSIG = 1
_prctl = getattr(ctypes.CDLL(None), "prctl", None)

if _prctl is not None:
    _prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
import_module("egoskin.make")
if _prctl is not None:
    # From here on it sees by itself; the thread that started it may end before.
    _prctl(_PR_SET_PDEATHSIG, 0)
