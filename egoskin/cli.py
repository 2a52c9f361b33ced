"""What the scripts share: clear errors, wording, configurations as plain values."""

from __future__ import annotations

import dataclasses
import math
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

import dacite

T = TypeVar("T")


@contextmanager
def clear_errors() -> Iterator[None]:
    """Turn errors the user can mend into one line on stderr and exit status 2.

    Those are ValueError (bad input) and OSError (files). Anything else is a fault of
    ours and keeps its traceback. Ctrl-C ends without one.
    """
    try:
        yield
    except (ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(2) from None
    except KeyboardInterrupt:
        raise SystemExit(130) from None


def counted(number: int, noun: str) -> str:
    """Return a number with its noun: "1 worker", "2 workers"."""
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


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


def from_plain(kind: type[T], content: Any, what: str) -> T:
    """Return a configuration from the values that `to_plain` gave.

    Args:
        kind: Dataclass to build.
        content: Plain values.
        what: Where they came from, for the error text.

    Raises:
        ValueError: If a field is unknown or of the wrong type; the text names it.
    """
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
