"""Fields of a training configuration by dotted name."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

from egoskin.hints import did_you_mean
from egoskin.make import EnvConfig
from egoskin.robots.own import kept_robot
from egoskin.runs.config import TrainConfig
from egoskin.storage.serialization import changed_fields, from_plain, to_plain

Overrides = Mapping[str, Any]
"""Values by dotted field names, as on the command line: ``sensor.range``."""

FILES = ("env.skin.path", "init_from")
"""Fields whose values are files: of these the content is compared, by its hash, because
runs have other working directories."""
# Compared as a whole: a robot is either a name or data.
_ROBOT = "env.robot"


def override(
    config: TrainConfig, overrides: Overrides, what: str, fixed: Collection[str] = ()
) -> TrainConfig:
    """Return a configuration with the values of some fields replaced.

    Args:
        config: The configuration.
        overrides: The values.
        what: Name of their owner, for the error text.
        fixed: Fields that cannot be overridden.

    Raises:
        ValueError: If a field does not exist or is fixed, or a value is invalid.
    """
    plain = to_plain(config)
    for name, value in overrides.items():
        try:
            full = _full_name(name)
            if full.split(".")[0] in fixed:
                raise ValueError(f"{name} cannot be set here")
            if full == _ROBOT and isinstance(value, str):
                value = kept_robot(value)
            # The name of a policy of the package is no path.
            if full in FILES and isinstance(value, str) and Path(value).exists():
                value = Path(value).absolute()
            set_value(plain, full, to_plain(value), known=True)
        except KeyError as error:
            raise ValueError(f"{what}: {error.args[0]}") from None
        except (ValueError, OSError) as error:
            raise ValueError(f"{what}: {error}") from error
    try:
        return from_plain(TrainConfig, plain, what)
    except ValueError as error:
        text = str(error).removeprefix(f"{what}: ")
        given = ", ".join(f"{k}={v}" for k, v in overrides.items()) or "the default"
        raise ValueError(f"{what} ({given}): {text}") from error


def settings(values: Mapping[str, Any]) -> list[str]:
    """Return the values of fields as text: "sensor.range = 0.5"."""
    return [f"{k.removeprefix('env.')} = {brief(v)}" for k, v in values.items()]


def brief(value: Any) -> str:
    """Return the value of a field as text; for a robot given as data, its name."""
    return str(value.get("name", value) if isinstance(value, dict) else value)


def changed_values(base: TrainConfig, config: TrainConfig) -> dict[str, Any]:
    """Return the plain values in which a configuration differs, by field."""
    old, new = to_plain(base), to_plain(config)
    names = (
        _ROBOT if name.startswith(f"{_ROBOT}.") else name
        for name in changed_fields(old, new)
    )
    return {name: get_value(new, name) for name in dict.fromkeys(names)}


def get_value(content: Any, name: str) -> Any:
    """Return the plain value at a dotted name."""
    for key in name.split("."):
        content = content[key]
    return content


def set_value(content: Any, name: str, value: Any, *, known: bool) -> None:
    """Set the plain value at a dotted name; if ``known``, the field must exist.

    Raises:
        KeyError: If there is no such field; the text names the closest.
        ValueError: If it is a group of fields.
    """
    *path, last = name.split(".")
    for i, key in enumerate(path):
        _check_key(content, key, ".".join(path[:i]))
        content = content[key]
    if known:
        _check_key(content, last, ".".join(path))
        if isinstance(content[last], dict) and not name.startswith(_ROBOT):
            # Its other fields would get their defaults, whatever was set before.
            group = name.removeprefix("env.")
            raise ValueError(
                f"{group} is a group of fields; set them one by one, as "
                f"{group}.{next(iter(content[last]))}"
            )
    content[last] = value


def _check_key(content: Any, key: str, where: str) -> None:
    if not isinstance(content, dict) or key not in content:
        keys = content if isinstance(content, dict) else ()
        full = f"{where}.{key}".lstrip(".").removeprefix("env.")
        raise KeyError(f"there is no field {full!r}{did_you_mean(key, keys)}")


def _full_name(name: str) -> str:
    """Return a field's name in a stored configuration.

    Raises:
        KeyError: If its first part is unknown; the text names the closest.
    """
    first = name.split(".")[0]
    parts, whole = (
        [f.name for f in dataclasses.fields(kind)] for kind in (EnvConfig, TrainConfig)
    )
    if first not in parts:
        _check_key(dict.fromkeys([*parts, *whole]), first, "")
        return name
    return f"env.{name}"
