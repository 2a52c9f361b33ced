"""What ends a script from outside: Ctrl-C, a batch system, a terminal that closes.

A script calls `end_quietly` before it imports the rest, which takes seconds: an
exception would come out of the midst of another package, with its traceback.
"""

from __future__ import annotations

import functools
import os
import signal
from contextlib import suppress
from types import FrameType

ENDING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
"""Signals that end a script."""


def end_quietly() -> None:
    """Let Ctrl-C end this process at once, with one line: nothing is to tidy up yet.

    Import this before torch: egoskin says how torch's threads wait.
    """
    take(end_now, signal.SIGINT)


def take(handler: signal._HANDLER, *numbers: int) -> None:
    """Handle signals, but for those that are ignored (nohup, a job of a shell)."""
    for number in numbers:
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, handler)


def end_now(number: int, frame: FrameType | None = None) -> None:
    """Handle a signal: end this process at once, with one line."""
    say("stopped")
    os._exit(128 + number)


def end_next_time() -> None:
    """Let Ctrl-C or SIGTERM end this process at once, now that it is ending.

    A terminal that closes says so twice.
    """
    take(end_now, signal.SIGINT, signal.SIGTERM)
    take(signal.SIG_IGN, signal.SIGHUP)


@functools.cache
def say(text: str) -> None:
    """Write a line to stderr, the first time it is said.

    A handler of signals may at any time: `print` may be at work, and nobody listen.
    """
    with suppress(OSError):
        os.write(2, ("\n" * os.isatty(2) + text + "\n").encode())
