"""What the scripts share: clear errors, wording, files, configurations as JSON."""

from __future__ import annotations

import dataclasses
import json
import math
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

import dacite

from egoskin.workers import WorkerError

T = TypeVar("T")


@contextmanager
def clear_errors() -> Iterator[None]:
    """Turn errors the user can mend into one line on stderr and exit status 2.

    Those are ValueError (bad input) and OSError (files). A worker's end is one line,
    too, with status 1. Anything else is a fault of ours and keeps its traceback. Ctrl-C
    ends without one.
    """
    try:
        yield
    except WorkerError as error:
        raise SystemExit(f"error: {error}") from None
    except (ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(2) from None
    except KeyboardInterrupt:
        raise SystemExit(130) from None


def counted(number: int, noun: str) -> str:
    """Return a number with its noun: "1 worker", "2 workers"."""
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


def check_counts(config: Any, *names: str) -> None:
    """Raise ValueError if a field that counts something is below 1; None is left."""
    for name in names:
        value = getattr(config, name)
        if value is not None and value < 1:
            raise ValueError(f"{name} must be at least 1, got {value}")


def check_output(path: Path | None, option: str) -> None:
    """Raise ValueError if a file cannot be written there, before the work starts.

    Args:
        path: The file; None is none.
        option: The option that named it, for the error text.
    """
    if path is not None and not path.parent.is_dir():
        raise ValueError(f"{option}: there is no folder {path.parent}")
    if path is not None and path.is_dir():
        raise ValueError(f"{option}: {path} is a folder")


def read_json(path: Path) -> Any:
    """Return the content of a JSON file.

    Raises:
        ValueError: If it is none; the text names it.
    """
    try:
        return json.loads(path.read_text())
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"{path} is not JSON: {error}") from error


def to_plain(value: Any) -> Any:
    """Return a configuration as JSON values: dicts, lists, strings, numbers, None.

    Infinite numbers become "inf", which JSON lacks.
    """
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = dataclasses.fields(value)
        return {f.name: to_plain(getattr(value, f.name)) for f in fields}
    if isinstance(value, (tuple, list)):
        return [to_plain(item) for item in value]
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, float) and math.isinf(value):
        return str(value)
    return value


def check_numbers(content: Any, name: str = "") -> None:
    """Raise ValueError if a plain value holds NaN; the text names where."""
    if isinstance(content, dict):
        for key, value in content.items():
            check_numbers(value, f"{name}.{key}".lstrip("."))
    elif isinstance(content, list):
        for value in content:
            check_numbers(value, name)
    elif isinstance(content, float) and math.isnan(content):
        raise ValueError(f"{name} must be a number, got nan")


def from_plain(kind: type[T], content: Any, what: str) -> T:
    """Return a configuration from the values that `to_plain` gave.

    Args:
        kind: Dataclass to build.
        content: Plain values.
        what: Where they came from, for the error text.

    Raises:
        ValueError: If a field is unknown or of the wrong type; the text names it.
    """
    if not isinstance(content, dict):
        raise ValueError(f"{what}: expected an object, got {type(content).__name__}")
    hooks = {float: _float, Path: _path}
    config = dacite.Config(type_hooks=hooks, cast=[tuple], strict=True)
    try:
        return dacite.from_dict(kind, content, config)
    except dacite.DaciteError as error:
        raise ValueError(f"{what}: {error}") from error


def _float(value: Any) -> Any:
    """Return a number as float, "inf" too; anything else is left to be refused."""
    whole = isinstance(value, int) and not isinstance(value, bool)
    return float(value) if whole or value in ("inf", "-inf") else value


def _path(value: Any) -> Any:
    """Return a text as path; anything else is left to be refused."""
    return Path(value) if isinstance(value, str) else value


def changed_fields(old: Any, new: Any, prefix: str = "") -> list[str]:
    """Return the dotted names of the fields in which two plain values differ."""
    if not (isinstance(old, dict) and isinstance(new, dict)):
        return [] if old == new else [prefix.rstrip(".")]
    names = []
    for key in sorted(old.keys() | new.keys()):
        names += changed_fields(old.get(key), new.get(key), f"{prefix}{key}.")
    return names
