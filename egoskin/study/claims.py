"""Claims: locks that let only one process work on a run, on one host or many.

A claim has two parts. The lock (``NAME.lock``) is released by the system when its
process ends, however it ends. It works between the processes of a host, and between
hosts if their shared file system supports locks. The owner file (``NAME.owner.3``: the
third owner) is for hosts that do not share locks: its modification time is a heartbeat,
and an owner on another host counts as dead when the heartbeat is too old. The next
owner creates the file with the next number, which only one process can do. Numbers are
used again after an owner has removed all files; the content tells whose a file is.
"""

from __future__ import annotations

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

from egoskin.storage.locks import try_lock

HEARTBEAT_S = 15.0
"""Interval between heartbeats of an owner [s]."""
STALE_S = 180.0
"""An owner on another host counts as dead this long after its last heartbeat [s]."""


def this_host() -> str:
    """Return an identifier of this host that is unique since its last boot."""
    with suppress(OSError):
        # Containers on one machine share its locks even if their host names differ.
        return Path("/proc/sys/kernel/random/boot_id").read_text().strip()
    return f"{socket.gethostname()}-{uuid.getnode():x}"


def is_claimed(folder: Path, name: str, stale: float = STALE_S) -> bool:
    """Return whether a living process holds a claim.

    Args:
        folder: Folder of the claims.
        name: Name of the claim.
        stale: An owner on another host counts as dead this long after its last
            heartbeat [s].
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


def owner(folder: Path, name: str) -> str:
    """Return the host and process of a claim's owner as text, "" if unknown.

    Args:
        folder: Folder of the claims.
        name: Name of the claim.
    """
    for path in reversed(_owners(folder, name)):
        with suppress(FileNotFoundError, ValueError, KeyError):
            content = json.loads(path.read_text())
            return f"{content['name']}, process {content['pid']}"
    return ""


@contextmanager
def claimed(
    folder: Path,
    name: str,
    *,
    heartbeat: float = HEARTBEAT_S,
    stale: float = STALE_S,
    lost: Callable[[], None] = lambda: os._exit(1),
) -> Iterator[bool]:
    """Hold a claim while the context is open; yield whether it could be obtained.

    Args:
        folder: Folder of the claims.
        name: Name of the claim.
        heartbeat: Interval between heartbeats of this owner [s].
        stale: An owner on another host counts as dead this long after its last
            heartbeat [s].
        lost: Called if another process took over the claim, because this host was
            suspended or its clock stood still.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with _lock(folder / f"{name}.lock", create=True) as free:
        mine = _signature()
        owner = _own(folder, name, stale, mine) if free else None
        if owner is None:
            yield False
            return
        ended = threading.Event()

        def is_mine() -> bool:
            return _owners(folder, name)[-1:] == [owner] and owner.read_text() == mine

        def beat() -> None:
            while not ended.wait(heartbeat):
                # File system errors may be temporary: the next heartbeat tries again.
                with suppress(OSError):
                    if not is_mine():
                        return lost()
                    os.utime(owner)

        thread = threading.Thread(target=beat, daemon=True)
        thread.start()
        try:
            yield True
        finally:
            ended.set()
            thread.join()
            with suppress(OSError):
                if is_mine():
                    for path in _owners(folder, name):
                        path.unlink(missing_ok=True)


@contextmanager
def _lock(path: Path, *, create: bool) -> Iterator[bool]:
    """Try to lock a file, or only look; yield whether no other process has locked it.

    Args:
        path: The file.
        create: Whether to create and lock it. Otherwise the lock is shared, so that
            those who look do not see each other; and for an exclusive lock some file
            systems require that the file is open for writing.
    """
    with open(path, "a" if create else "r") as file:
        yield try_lock(file.fileno(), path, shared=not create)


def _owners(folder: Path, name: str) -> list[Path]:
    """Return the owner files, that of the current owner last."""
    pattern = re.compile(re.escape(name) + r"\.owner\.(\d+)")
    with suppress(FileNotFoundError):
        found = [(pattern.fullmatch(p.name), p) for p in folder.iterdir()]
        return [p for _, p in sorted((int(m[1]), p) for m, p in found if m)]
    return []


def _signature() -> str:
    """Return the content of an owner file of this process."""
    content = {"host": this_host(), "name": socket.gethostname(), "pid": os.getpid()}
    return json.dumps(content)


def _own(folder: Path, name: str, stale: float, content: str) -> Path | None:
    """Become the owner; return the owner file, or None if another process is."""
    owners = _owners(folder, name)
    if _lives_elsewhere(folder, name, stale):
        return None
    number = int(owners[-1].suffix[1:]) + 1 if owners else 1
    path = folder / f"{name}.owner.{number}"
    temporary = folder / f".{name}.{uuid.uuid4().hex}"
    temporary.write_text(content)
    try:
        # Atomic: the file appears complete, and only one process can create it.
        os.link(temporary, path)
    except FileExistsError:
        return None
    finally:
        temporary.unlink()
    # A faster process may have ended since and removed its files.
    return path if _owners(folder, name)[-1:] == [path] else None


def _lives_elsewhere(folder: Path, name: str, stale: float) -> bool:
    """Return whether the owner is on another host and has a recent heartbeat."""
    for path in reversed(_owners(folder, name)):
        with suppress(FileNotFoundError, ValueError, KeyError):
            content = json.loads(path.read_text())
            # For owners on this host the lock decides.
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
        # The folder is read-only.
        return time.time()
    finally:
        with suppress(OSError):
            path.unlink(missing_ok=True)
