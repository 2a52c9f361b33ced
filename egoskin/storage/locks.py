"""Locks of files, which the operating system releases when their process ends."""

from __future__ import annotations

import errno
import fcntl
from pathlib import Path

_UNSUPPORTED = (errno.ENOSYS, errno.ENOTSUP, errno.EOPNOTSUPP, errno.ENOLCK)


def try_lock(descriptor: int, path: Path, *, shared: bool = False) -> bool:
    """Try to lock a file; return whether no other process has locked it.

    Args:
        descriptor: The open file.
        path: Its path, for the error text.
        shared: Whether others may hold a shared lock at the same time.

    Raises:
        ValueError: If its file system has no locks.
    """
    kind = fcntl.LOCK_SH if shared else fcntl.LOCK_EX
    try:
        fcntl.flock(descriptor, kind | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError as error:
        if error.errno not in _UNSUPPORTED:
            raise
        raise ValueError(
            f"{path}: its file system has no locks, so two processes could write the "
            "same run; mount it with locks (Lustre: option flock), or use another "
            "folder"
        ) from error
    return True
