"""Configurations as plain values, and reading JSON files."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Mapping
from pathlib import Path
from types import UnionType
from typing import (
    Annotated,
    Any,
    Literal,
    TypeVar,
    Union,
    get_args,
    get_origin,
    get_type_hints,
)

import dacite

from egoskin.bounds import BoundsError, path_to
from egoskin.hints import did_you_mean
from egoskin.storage.files import read_regular, write_output

T = TypeVar("T")
# Deeper than anything that egoskin writes, and safe for recursive functions.
_DEEPEST = 100
_NAMES = {
    int: "an integer",
    float: "a number",
    str: "a string",
    Path: "a path",
    bool: "true or false",
    type(None): "null",
}


def read_json(path: Path) -> Any:
    """Return the content of a JSON file.

    Raises:
        ValueError: If it is not valid JSON; the text names the file.
        OSError: If it cannot be read.
    """
    content = read_regular(path)
    try:
        value = json.loads(content)
        if _depth(value) > _DEEPEST:
            raise ValueError(f"it is nested more than {_DEEPEST} levels deep")
        return value
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path} is not JSON: {error}") from error


def write_json(path: Path, content: Any, *, allow_nan: bool = True) -> None:
    """Write a JSON file that an option names; see `write_output`.

    Args:
        path: File to write.
        content: JSON values.
        allow_nan: Whether NaN and infinity may occur, which JSON does not have.

    Raises:
        ValueError: If they occur but may not.
        OSError: If it cannot be written; the text names the file.
    """
    text = json.dumps(content, indent=2, allow_nan=allow_nan) + "\n"
    write_output(path, text.encode())


def _depth(value: Any) -> int:
    """Return the nesting depth of lists and objects."""
    depth, level = 0, [value]
    while level := [x for x in level if isinstance(x, (dict, list))]:
        depth += 1
        level = [y for x in level for y in (x.values() if isinstance(x, dict) else x)]
    return depth


def to_plain(value: Any) -> Any:
    """Return a configuration as JSON values: dicts, lists, strings, numbers, None.

    Infinite numbers become "inf", which JSON lacks.
    """
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = dataclasses.fields(value)
        return {f.name: to_plain(getattr(value, f.name)) for f in fields}
    if isinstance(value, Mapping):
        return {key: to_plain(item) for key, item in value.items()}
    if isinstance(value, (tuple, list)):
        return [to_plain(item) for item in value]
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, float) and math.isinf(value):
        return str(value)
    return value


def from_plain(kind: type[T], content: Any, what: str) -> T:
    """Return a configuration from the output of `to_plain`.

    Args:
        kind: Dataclass to build.
        content: Plain values.
        what: Their source, for the error text.

    Raises:
        ValueError: If a field is unknown, of the wrong type or out of bounds; the text
            names it.
    """
    if not isinstance(content, dict):
        raise ValueError(f"{what}: expected an object, got {type(content).__name__}")
    hooks = {float: _float, Path: _path}
    config = dacite.Config(type_hooks=hooks, strict=True)
    try:
        return dacite.from_dict(kind, _with_tuples(content), config)
    except BoundsError as error:
        raise ValueError(f"{what}: {path_to(error.owner, kind)}{error}") from error
    except dacite.UnexpectedDataError as error:
        key, *_ = sorted(error.keys)
        hint = did_you_mean(key, _fields_beside(key, kind, content))
        raise ValueError(f"{what}: there is no field {key!r}{hint}") from error
    except dacite.MissingValueError as error:
        raise ValueError(f"{what}: {error.field_path} is missing") from error
    except dacite.WrongTypeError as error:
        text = f"{what}: {error.field_path} must be {_described(error.field_type)}"
        given = json.dumps(to_plain(error.value), default=str)
        # dacite changes a string that is given for a list or an object.
        if "<generator object" not in given:
            text += f", got {given}"
        raise ValueError(text) from error
    # ValueError is raised by the checks of the configuration itself.
    except (dacite.DaciteError, ValueError) as error:
        text = _object_for_list(kind, content) or error
        raise ValueError(f"{what}: {text}") from error


def _object_for_list(kind: Any, content: Any, path: str = "") -> str:
    """Return what is wrong with an object given for a list, which dacite does not tell.

    Args:
        kind: Type of the content.
        content: Plain values.
        path: Dotted name of the content.

    Returns:
        The text, "" if there is none.
    """
    if get_origin(kind) in (Union, UnionType):
        # Of several types, dacite tells that none fits.
        kinds = [x for x in get_args(kind) if x is not type(None)]
        kind = kinds[0] if len(kinds) == 1 else kind
    if dataclasses.is_dataclass(kind) and isinstance(content, dict):
        hints = get_type_hints(kind)
        parts = [(hints[k], x, f"{path}.{k}") for k, x in content.items() if k in hints]
    elif get_origin(kind) is tuple and isinstance(content, (list, tuple)):
        parts = [(get_args(kind)[0], x, path) for x in content]
    elif get_origin(kind) is tuple and isinstance(content, dict):
        given = json.dumps(to_plain(content), default=str)
        return f"{path.lstrip('.')} must be {_described(kind)}, got {given}"
    else:
        return ""
    return next(filter(None, (_object_for_list(*part) for part in parts)), "")


def _fields_beside(key: str, kind: Any, content: Any) -> list[str]:
    """Return the fields of the dataclass, here or inside, that has an unknown key."""
    if isinstance(content, dict) and dataclasses.is_dataclass(kind):
        hints = get_type_hints(kind)
        if key in content and key not in hints:
            return list(hints)
        parts = [(hints[name], item) for name, item in content.items() if name in hints]
    else:
        items = content.values() if isinstance(content, dict) else content
        inside = items if isinstance(content, (dict, list, tuple)) else ()
        parts = [(part, x) for part in get_args(kind) for x in (content, *inside)]
    return [name for part, x in parts for name in _fields_beside(key, part, x)]


def _described(kind: Any) -> str:
    """Return a type in words, as its values are written in JSON."""
    if get_origin(kind) is Literal:
        return "one of " + ", ".join(json.dumps(value) for value in get_args(kind))
    if get_origin(kind) in (tuple, list):
        items = [x for x in get_args(kind) if x is not ...]
        words = dict.fromkeys(_described(x) for x in items)
        return f"a list, each item {' or '.join(words)}"
    if get_origin(kind) in (Union, UnionType):
        return " or ".join(_described(x) for x in get_args(kind))
    if get_origin(kind) is Annotated:
        return _described(get_args(kind)[0])
    return _NAMES.get(kind, "an object")


def _with_tuples(content: Any) -> Any:
    """Return plain values with lists replaced by tuples, as in configurations."""
    if isinstance(content, dict):
        return {key: _with_tuples(value) for key, value in content.items()}
    if isinstance(content, list):
        return tuple(map(_with_tuples, content))
    return content


def _float(value: Any) -> Any:
    """Return a number or "inf" as float; other values unchanged, for later checks."""
    whole = isinstance(value, int) and not isinstance(value, bool)
    try:
        return float(value) if whole or value in ("inf", "-inf") else value
    except OverflowError as error:
        raise ValueError("a number with hundreds of digits is out of range") from error


def _path(value: Any) -> Any:
    """Return a string as path; other values unchanged, for later checks."""
    return Path(value) if isinstance(value, str) else value


def changed_fields(old: Any, new: Any, prefix: str = "") -> list[str]:
    """Return the dotted names of the fields in which two plain values differ."""
    if not (isinstance(old, dict) and isinstance(new, dict)):
        return [] if old == new else [prefix.rstrip(".")]
    names = []
    for key in sorted(old.keys() | new.keys()):
        names += changed_fields(old.get(key), new.get(key), f"{prefix}{key}.")
    return names
