"""What ends a process: signals (Ctrl-C, batch systems, closed terminals), its parent.

A script calls `end_quietly` before its other imports, which take seconds: without it,
Ctrl-C during an import prints a traceback from within another package.
"""

from __future__ import annotations

import functools
import os
import shutil
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from multiprocessing import parent_process
from threading import Thread
from types import FrameType

ENDING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
"""Signals that end a script."""


def end_quietly() -> None:
    """Let Ctrl-C end this process at once, with one line and without cleanup.

    Import this before torch: egoskin configures how torch's threads wait.
    """
    take(end_now, signal.SIGINT)


def take(handler: signal._HANDLER, *numbers: int) -> None:
    """Set a signal handler, except for ignored signals (nohup, background jobs)."""
    for number in numbers:
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, handler)


def end_now(number: int, frame: FrameType | None = None) -> None:
    """Signal handler: end this process at once, with one line."""
    say("stopped")
    os._exit(128 + number)


def end_next_time() -> None:
    """Let a further Ctrl-C or SIGTERM end this process at once.

    SIGHUP is ignored: a closing terminal sends it twice.
    """
    take(end_now, signal.SIGINT, signal.SIGTERM)
    take(signal.SIG_IGN, signal.SIGHUP)


@contextmanager
def block_terminal_signals() -> Iterator[None]:
    """Keep a terminal's signals from the processes that are started in this context.

    Ctrl-C and a closed terminal reach the whole process group, but the parent decides
    when to end. A new process inherits the signal mask.
    """
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, signal.SIGHUP})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)


def end_with_parent(folder: str | None = None) -> None:
    """Let this child process end as soon as its parent ends, even by SIGKILL.

    Args:
        folder: Temporary folder of the parent, to be removed then.
    """
    Thread(target=_await_parent, args=(folder,), daemon=True).start()


def _await_parent(folder: str | None) -> None:
    parent = parent_process()
    assert parent is not None
    parent.join()
    if folder is not None:
        shutil.rmtree(folder, ignore_errors=True)
    os._exit(1)


def unread_output() -> SystemExit:
    """Return the exit for output that is no longer read, as in `| head -1`."""
    # Python flushes the remaining output at exit: it must not fail again.
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return SystemExit(128 + signal.SIGPIPE)


@functools.cache
def say(text: str) -> None:
    """Write a line to stderr; a repeated text is not written again.

    Safe in signal handlers: it does not use `print`, which may have been interrupted,
    and ignores a closed stderr.
    """
    with suppress(OSError):
        os.write(2, ("\n" * os.isatty(2) + text + "\n").encode())
