"""Child processes that end when, and only when, their parent wants it.

This module imports nothing heavy: a new process imports it first.
"""

from __future__ import annotations

import os
import shutil
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing import parent_process
from threading import Thread


@contextmanager
def sheltered() -> Iterator[None]:
    """Keep a terminal's signals from the processes that are started in this context.

    Ctrl-C and a closed terminal reach the whole process group, but the parent decides
    when to end. A new process inherits the signal mask.
    """
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, signal.SIGHUP})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)


def end_with_parent(folder: str) -> None:
    """Let this process end as soon as its parent ends, even by SIGKILL.

    Args:
        folder: Temporary folder of the parent, to be removed then.
    """
    Thread(target=_await_parent, args=(folder,), daemon=True).start()


def _await_parent(folder: str) -> None:
    parent = parent_process()
    assert parent is not None
    parent.join()
    shutil.rmtree(folder, ignore_errors=True)
    os._exit(1)
