"""Claims: one process works on one thing, on one host or on many with a shared folder.

A claim has two parts. A lock (``NAME.lock``) that the system takes from a process that
ends, however it ends; it works among the processes of a host, and among hosts where the
file system shares locks. And an owner file (``NAME.owner.3``: the third owner) whose
time of change is its heartbeat, for hosts among which locks are not shared: an owner on
another host is dead once its heart has not beaten for a while. The next owner creates
the file of the next number, which only one can.
"""

from __future__ import annotations

import fcntl
import json
import os
import re
import socket
import threading
import time
import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO

HEARTBEAT_S = 15.0
"""Time between two beats of an owner's heart [s]."""
STALE_S = 180.0
"""An owner on another host is dead after this long without one [s]."""


def this_host() -> str:
    """Return what tells this host, since it was started, from all others."""
    with suppress(OSError):
        # Containers of one machine share its locks, whatever their host names.
        return Path("/proc/sys/kernel/random/boot_id").read_text().strip()
    return f"{socket.gethostname()}-{uuid.getnode():x}"


def is_claimed(folder: Path, name: str, stale: float = STALE_S) -> bool:
    """Return whether a living process works on something.

    Args:
        folder: Folder of the claims.
        name: What is worked on.
        stale: An owner elsewhere without a heartbeat for this long [s] is dead.
    """
    try:
        with _lock(folder / f"{name}.lock", create=False) as free:
            return not free or _lives_elsewhere(folder, name, stale)
    except FileNotFoundError:
        return _lives_elsewhere(folder, name, stale)


def is_locked(path: Path) -> bool:
    """Return whether another process holds the lock of a file."""
    try:
        with _lock(path, create=False) as free:
            return not free
    except FileNotFoundError:
        return False


@contextmanager
def claimed(
    folder: Path,
    name: str,
    *,
    heartbeat: float = HEARTBEAT_S,
    stale: float = STALE_S,
    lost: Callable[[], None] = lambda: os._exit(1),
) -> Iterator[bool]:
    """Claim something while the context is open; yield whether it could be claimed.

    Args:
        folder: Folder of the claims.
        name: What to work on.
        heartbeat: Time between two beats of this owner's heart [s].
        stale: An owner elsewhere without one for this long [s] is dead.
        lost: Called if somebody else took it: this host slept, or its clock stood.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with _lock(folder / f"{name}.lock", create=True) as free:
        owner = _own(folder, name, stale) if free else None
        if owner is None:
            yield False
            return
        ended = threading.Event()

        def beat() -> None:
            while not ended.wait(heartbeat):
                # A file system that fails may come back: the next beat looks again.
                with suppress(OSError):
                    if _owners(folder, name)[-1:] != [owner]:
                        return lost()
                    os.utime(owner)

        thread = threading.Thread(target=beat, daemon=True)
        thread.start()
        try:
            yield True
        finally:
            ended.set()
            thread.join()
            for path in _owners(folder, name):
                path.unlink(missing_ok=True)
                if path == owner:
                    break


@contextmanager
def _lock(path: Path, *, create: bool) -> Iterator[bool]:
    """Hold a lock; yield whether nobody else does."""
    with _open(path, create=create) as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            yield False
            return
        yield True


def _open(path: Path, *, create: bool) -> IO[str]:
    """Open a file to lock; some shared folders lock only what is open to be written."""
    if create:
        return open(path, "a")
    try:
        return open(path, "r+")
    except PermissionError:
        # Who may only read may still look.
        return open(path)


def _owners(folder: Path, name: str) -> list[Path]:
    """Return the owner files, the present owner's last."""
    pattern = re.compile(re.escape(name) + r"\.owner\.(\d+)")
    with suppress(FileNotFoundError):
        found = [(pattern.fullmatch(p.name), p) for p in folder.iterdir()]
        return [p for _, p in sorted((int(m[1]), p) for m, p in found if m)]
    return []


def _own(folder: Path, name: str, stale: float) -> Path | None:
    """Become the owner; return the owner file, None if somebody lives elsewhere."""
    owners = _owners(folder, name)
    if _lives_elsewhere(folder, name, stale):
        return None
    number = int(owners[-1].suffix[1:]) + 1 if owners else 1
    path = folder / f"{name}.owner.{number}"
    content = {"host": this_host(), "name": socket.gethostname(), "pid": os.getpid()}
    temporary = folder / f".{name}.{uuid.uuid4().hex}"
    temporary.write_text(json.dumps(content))
    try:
        # Whole at once, and for one process alone.
        os.link(temporary, path)
    except FileExistsError:
        return None
    finally:
        temporary.unlink()
    # Who was faster may have ended since, and its files with it.
    return path if _owners(folder, name)[-1:] == [path] else None


def _lives_elsewhere(folder: Path, name: str, stale: float) -> bool:
    """Whether the owner is on another host and its heart beats."""
    for path in reversed(_owners(folder, name)):
        with suppress(FileNotFoundError, ValueError, KeyError):
            content = json.loads(path.read_text())
            # Of this host the lock tells all.
            if content["host"] == this_host():
                return False
            return _now(folder) - path.stat().st_mtime < stale
    return False


def _now(folder: Path) -> float:
    """Return the time by the clock of the folder's file system [s]."""
    path = folder / f".clock.{uuid.uuid4().hex}"
    try:
        path.touch()
        return path.stat().st_mtime
    except OSError:
        # A folder that can only be read.
        return time.time()
    finally:
        with suppress(OSError):
            path.unlink(missing_ok=True)
