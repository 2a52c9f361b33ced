"""Named tensors with a JSON header in one file, written atomically.

The format is safetensors: loading runs no code from the file. Tensors and header are
sealed together, see `egoskin.storage.formats`: a damaged file does not load.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from egoskin.storage.files import write_file
from egoskin.storage.formats import present_header, seal, unseal

_HEADER = "egoskin"


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
