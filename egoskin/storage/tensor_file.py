"""Named tensors with a JSON header in one file, written atomically.

The format is safetensors: loading runs no code from the file. Tensors and header are
sealed together, see `egoskin.storage.formats`: a damaged file does not load.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from egoskin.storage.formats import present_header, seal, unseal

_HEADER = "egoskin"
# Pattern of the incomplete files of processes that were killed while writing.
PARTIAL = ".*.partial"


def save_tensors(
    path: Path, tensors: Mapping[str, Tensor], header: Mapping[str, Any]
) -> None:
    """Write tensors and a header atomically: the file is complete or unchanged.

    Args:
        path: File to write or replace.
        tensors: Tensors by name.
        header: JSON values.

    Raises:
        OSError: If it cannot be written; an existing file is unchanged.
    """
    own = {key: value.detach().cpu().contiguous() for key, value in tensors.items()}
    content = save(own, metadata={_HEADER: json.dumps(seal(header, own))})
    write_file(path, content)


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


def load_tensors(
    path: Path, *, quiet: bool = False
) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Return (tensors by name, header) of a file that `save_tensors` wrote.

    Configurations in the header are converted to the current format.

    Args:
        path: The file.
        quiet: Whether to omit the note about a missing seal.

    Raises:
        ValueError: If the file is missing, damaged or of another format; the text
            names it.
    """
    if not path.is_file():
        folder = path.is_dir()
        raise ValueError(f"{path} is a folder" if folder else f"no such file: {path}")
    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            tensors = {key: file.get_tensor(key) for key in file.keys()}
    except SafetensorError as error:
        raise ValueError(
            f"{path} is truncated or not an egoskin checkpoint ({error})"
        ) from error
    if _HEADER not in metadata:
        raise ValueError(f"{path} was not written by egoskin")
    try:
        header = json.loads(metadata[_HEADER])
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path} is damaged: its header is not JSON") from error
    if not isinstance(header, dict):
        raise ValueError(f"{path} is damaged: its header is not a JSON object")
    header, number = unseal(header, str(path), tensors, quiet=quiet)
    return tensors, present_header(header, number, str(path))


def prefixed(prefix: str, tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Return the tensors with a prefix and a slash before each name."""
    return {f"{prefix}/{key}": value for key, value in tensors.items()}


def part(prefix: str, tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Return the tensors under a prefix, without it."""
    start = f"{prefix}/"
    return {k.removeprefix(start): v for k, v in tensors.items() if k.startswith(start)}
