"""Read external files, up to a maximum size, and write files atomically.

Contract: no function here waits for a named pipe, opens a device or fills memory.
"""

from __future__ import annotations

import io
import os
import stat
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from matplotlib.figure import Figure

TEXT_LIMIT = 64 * 2**20
"""Maximum size of a text file: a skin, a robot, a configuration [bytes]."""

PARTIAL = ".*.partial"
"""Pattern of the incomplete files of processes that were killed while writing."""

_KINDS = {
    stat.S_IFDIR: "a folder",
    stat.S_IFIFO: "a named pipe",
    stat.S_IFSOCK: "a socket",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
}


def check_regular(path: Path | str, limit: int = TEXT_LIMIT) -> None:
    """Raise unless a path, or its link's target, is a regular file of bounded size.

    For files that another library opens; `read_regular` checks by itself.

    Args:
        path: The file.
        limit: Maximum size [bytes].

    Raises:
        ValueError: If it is a folder, a pipe or a device, or larger than the limit.
        OSError: If there is no such file.
    """
    _check(os.stat(path), path, limit)


def read_regular(path: Path | str, limit: int = TEXT_LIMIT) -> bytes:
    """Return the content of a regular file.

    Args:
        path: The file.
        limit: Maximum size [bytes].

    Raises:
        ValueError: If it is a folder, a pipe or a device, or larger than the limit.
        OSError: If there is no such file, or it cannot be read.
    """
    # Check before opening, which can have side effects on a device; check again after,
    # as a pipe may have replaced the file.
    check_regular(path, limit)
    with open(path, "rb", opener=_open_without_waiting) as file:
        status = os.fstat(file.fileno())
        _check(status, path, limit)
        # If the file grows meanwhile, read only the size at opening.
        return file.read(status.st_size)


def check_output(path: Path | None, option: str, suffixes: Sequence[str] = ()) -> None:
    """Raise ValueError if a file cannot be written; call this before the work starts.

    Args:
        path: The file; None: there is no file to write.
        option: The option that named it, for the error text.
        suffixes: Its allowed suffixes; empty: any.
    """
    if path is None:
        return
    if suffixes and path.suffix.lower() not in suffixes:
        raise ValueError(f"{option}: {path} must end in {' or '.join(suffixes)}")
    if not path.parent.is_dir():
        raise ValueError(f"{option}: there is no folder {path.parent}")
    if os.path.isdir(path):
        raise ValueError(f"{option}: {path} is a folder")
    try:
        # Opening a named pipe waits for a reader. Pipes of a shell or /dev/stdout have
        # no path and are allowed.
        pipe = path.is_fifo() and os.path.lexists(os.path.realpath(path))
        new = not os.path.lexists(path)
        if new or path.is_file():
            # Opening to append leaves the content unchanged.
            path.open("ab").close()
        if new:
            path.unlink()
    except OSError as error:
        text = f"{option}: {path} cannot be written ({error.strerror})"
        raise ValueError(text) from None
    if pipe:
        raise ValueError(f"{option}: {path} is a named pipe, not a file")


def write_file(path: Path, content: bytes) -> None:
    """Write a file atomically: it is complete and on disk, or unchanged.

    A process that is killed while writing leaves a file that `PARTIAL` matches. An
    existing link is replaced, never followed.

    Raises:
        OSError: If it cannot be written; the text names the file.
    """
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        # A leftover file, or a link placed there for us to follow.
        partial.unlink(missing_ok=True)
        with open(partial, "xb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(partial, path)
        _sync_folder(path.parent)
    except OSError as error:
        with suppress(OSError):
            partial.unlink(missing_ok=True)
        raise named(error, path) from error


def write_output(path: Path, content: bytes) -> None:
    """Write a file that an option names, as `check_output` allows it.

    A file is written as by `write_file`; a pipe, a device or a link, as /dev/stdout, is
    written to.

    Raises:
        OSError: If it cannot be written; the text names the file.
    """
    if not path.is_symlink() and (path.is_file() or not path.exists()):
        write_file(path, content)
        return
    try:
        path.write_bytes(content)
    except OSError as error:
        raise named(error, path) from error


def write_figure(path: Path, figure: Figure, **options: Any) -> None:
    """Write a picture of a figure, in the format of its suffix; see `write_output`.

    Args:
        path: File to write.
        figure: matplotlib's figure.
        **options: Further options of its ``savefig``.

    Raises:
        OSError: If it cannot be written; the text names the file.
    """
    file = io.BytesIO()
    figure.savefig(file, format=path.suffix[1:], **options)
    write_output(path, file.getvalue())


def append(path: Path, content: bytes) -> None:
    """Append to an existing file that is not a link.

    Raises:
        OSError: If it does not exist or cannot be written; the text names it.
    """
    try:
        with open(path, "ab", opener=_open_to_append) as file:
            file.write(content)
    except OSError as error:
        raise named(error, path) from error


def _open_to_append(path: str, flags: int) -> int:
    kept = flags & ~os.O_CREAT
    return os.open(path, kept | os.O_NOFOLLOW | os.O_NONBLOCK)


def named(error: OSError, path: Path) -> OSError:
    """Return an error that names a file; the system's error of a full disk does not."""
    return OSError(error.errno, error.strerror, str(path))


def _sync_folder(path: Path) -> None:
    """Wait until the entries of a folder are on disk."""
    descriptor = os.open(path, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _open_without_waiting(path: str, flags: int) -> int:
    """Open a file without waiting, even for a named pipe that has no writer."""
    return os.open(path, flags | os.O_NONBLOCK)


def _check(status: os.stat_result, path: Path | str, limit: int) -> None:
    """Raise ValueError unless the status is of a regular file of bounded size."""
    if not stat.S_ISREG(status.st_mode):
        kind = _KINDS.get(stat.S_IFMT(status.st_mode), "something else")
        raise ValueError(f"{path} must be a file, but is {kind}")
    if status.st_size > limit:
        raise ValueError(
            f"{path} must have at most {limit:,} bytes, but has {status.st_size:,}"
        )
