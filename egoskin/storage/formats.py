"""File formats: version numbers, SHA-256 of the content, and migrations.

Each JSON file, and each JSON header of a file of tensors, that egoskin writes to read
again starts with a seal:

    format    number of the format; older files without a number have format 1
    egoskin   version of egoskin that wrote it
    sha256    hash of everything else, tensors included

Contract: `unseal` returns what `seal` was given, bit for bit. For a file without a seal
it prints once that the content cannot be verified.
"""

from __future__ import annotations

import copy
import functools
import hashlib
import importlib.metadata
import json
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from egoskin.storage.serialization import read_json

FORMAT = 7
"""Number of the format in which files are written."""
_SEAL = ("format", "egoskin", "sha256")
_ANY = object()
# The physics engine before there was a choice.
_ENGINE = "mujoco"


@dataclass(frozen=True, kw_only=True)
class Migration:
    """Changes of a configuration to the next format, by dotted field names."""

    added: Mapping[str, Any] = field(default_factory=dict)
    """New fields, with the values that keep the old behaviour."""
    renamed: Mapping[str, str] = field(default_factory=dict)
    """New names of renamed fields, by the old name."""
    removed: Mapping[str, Any] = field(default_factory=dict)
    """Removed fields, with their values without effect (or any)."""


# By the number of the format from which a migration starts.
_MIGRATIONS = {
    1: Migration(
        added={
            "env.task.throws.first_delay": [0.0, 0.0],
            "env.task.throws.aim": "body",
        },
        removed={
            # Environment steps over which these grew: the touching part of a ball; the
            # penalty on distance from the start, beginning at "drift_start"; the speed
            # of the balls, beginning at "slow_start". Further, whether an oracle
            # observes the ball that passes next first.
            "core_frames": [0, 0],
            "drift_frames": [0, 0],
            "slow_start_frames": 0,
            "told_next_first": False,
            "drift_start": _ANY,
            "slow_start": _ANY,
            "compile_kernels": _ANY,
            "env.sensor.numb": False,
        },
    ),
    2: Migration(
        renamed={"env.sensor.localization.hold": "env.sensor.keep_last"},
        removed={
            "env.task.one_action_scale": None,
            "env.task.clip_targets": False,
            "env.task.physics.self_collision": True,
            "env.task.physics.solver_iterations": 10,
            "env.task.throws.mass": 0.4,
            "env.task.throws.speed_is": "horizontal",
            "env.task.throws.on_ground": "inactive",
            # Removed options: distance to a ball's centre; angle of view along each
            # axis; beams from edge to edge of the view; several beams per zone; a
            # signal per ball; a validity flag; position divided by the range, or in
            # other frames.
            "env.sensor.field.measure": "surface",
            "env.sensor.ray.fov": "diagonal",
            "env.sensor.ray.beams": "centres",
            "env.sensor.ray.sub_beams": 1,
            "env.sensor.per_object": False,
            "env.sensor.validity": False,
            "env.sensor.localization.over_range": False,
            "env.sensor.localization.frame": "base",
            "env.sensor.localization": {},
        },
    ),
    3: Migration(
        added={
            "env.task.randomization": {
                "link_mass": [1.0, 1.0],
                "friction": [1.0, 1.0],
                "gains": [1.0, 1.0],
                "torque_limit": [1.0, 1.0],
                "delay_steps": [0, 0],
                "push_speed": [0.0, 0.0],
                "push_interval": [1.0, 3.0],
            },
        },
    ),
    4: Migration(added={"engine": _ENGINE}),
    5: Migration(added={"init_from": None}),
    6: Migration(added={"env.task.throws.shape": "sphere", "env.task.throws.size": []}),
}
assert _MIGRATIONS.keys() == set(range(1, FORMAT))


def package_version(package: str) -> str | None:
    """Return the version of an installed package, None if it is not installed."""
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None


def content_hash(content: Any, tensors: Mapping[str, Tensor] | None = None) -> str:
    """Return the SHA-256 of JSON values and tensors, independent of their order.

    Args:
        content: JSON values.
        tensors: Tensors by name; names, types, shapes and bytes are hashed.
    """
    text = json.dumps(content, sort_keys=True, separators=(",", ":"))
    digest = hashlib.sha256(text.encode())
    for name, value in sorted((tensors or {}).items()):
        digest.update(f"\n{name!r} {value.dtype} {list(value.shape)}\n".encode())
        data = value.detach().cpu().contiguous().reshape(-1)
        digest.update(data.view(torch.uint8).numpy().data)
    return digest.hexdigest()


def seal(
    content: Mapping[str, Any], tensors: Mapping[str, Tensor] | None = None
) -> dict[str, Any]:
    """Return the content of a file, preceded by its seal.

    Args:
        content: JSON values.
        tensors: Tensors of the file.
    """
    assert not content.keys() & set(_SEAL)
    version = package_version("egoskin")
    head: dict[str, Any] = {"format": FORMAT, "egoskin": version}
    head["sha256"] = content_hash({**head, **content}, tensors)
    return {**head, **content}


def unseal(
    content: Mapping[str, Any],
    what: str,
    tensors: Mapping[str, Tensor] | None = None,
    *,
    quiet: bool = False,
) -> tuple[dict[str, Any], int]:
    """Return (content without its seal, format number).

    Args:
        content: JSON values of the file.
        what: Name of the file.
        tensors: Tensors of the file.
        quiet: Whether to omit the note about a missing seal.

    Raises:
        ValueError: If the content has been changed, or has a newer format.
    """
    number = content.get("format", 1)
    if not isinstance(number, int) or number < 1:
        raise ValueError(f"{what} is damaged: its format number is {number!r}")
    if number > FORMAT:
        raise ValueError(
            f"{what} has format {number}, but this egoskin "
            f"({package_version('egoskin')}) reads formats up to {FORMAT}: use "
            f"egoskin {content.get('egoskin')} or later"
        )
    given = {key: value for key, value in content.items() if key != "sha256"}
    if "sha256" in content:
        if content_hash(given, tensors) != content["sha256"]:
            raise ValueError(
                f"{what} is damaged or was edited: its content does not match its "
                "SHA-256; restore the original file"
            )
    elif number > 1:
        raise ValueError(f"{what} is damaged or was edited: its SHA-256 is missing")
    elif not quiet:
        _note(what)
    return {key: value for key, value in given.items() if key not in _SEAL}, number


@functools.cache
def _note(what: str) -> None:
    """Print, once for each file, that it cannot be verified."""
    print(
        f"note: {what} was written by an egoskin without checksums: its integrity "
        "cannot be verified",
        file=sys.stderr,
    )


def read_sealed(path: Path, *, quiet: bool = False) -> tuple[dict[str, Any], int]:
    """Return (content, format number) of a JSON file with or without a seal.

    Args:
        path: The file.
        quiet: Whether to omit the note about a missing seal.

    Raises:
        ValueError: If it is not a JSON object, has been changed, or has a newer format.
        OSError: If it cannot be read.
    """
    content = read_json(path)
    if not isinstance(content, dict):
        raise ValueError(
            f"{path} must hold a JSON object, not a {type(content).__name__}"
        )
    return unseal(content, str(path), quiet=quiet)


def sealed_json(content: Mapping[str, Any]) -> bytes:
    """Return the bytes of a sealed JSON file, for `read_sealed`."""
    return (json.dumps(seal(content), indent=2) + "\n").encode()


def migrate(
    config: Mapping[str, Any], number: int
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return a training configuration, or a part of one, in the current format.

    Args:
        config: The configuration as plain values, ``{"env": ...}``.
        number: Its format number.

    Returns:
        The configuration, and the removed options that had an effect: their values by
        name.
    """
    config, retired = copy.deepcopy(dict(config)), {}
    for step in range(number, FORMAT):
        for old, new in _MIGRATIONS[step].renamed.items():
            (*path, key), (*to, name) = old.split("."), new.split(".")
            if key in (holder := _object(config, path)):
                _object(config, to, make=True)[name] = holder.pop(key)
        for name, without_effect in _MIGRATIONS[step].removed.items():
            *path, key = name.split(".")
            value = _object(config, path).pop(key, without_effect)
            if without_effect is not _ANY and value != without_effect:
                retired[name] = value
        for name, value in _MIGRATIONS[step].added.items():
            *path, key = name.split(".")
            # A part of a configuration only gets the fields of that part.
            if path[0] in config if path else {"env", "ppo"} <= config.keys():
                inner = _object(config, path, make=True)
                inner.setdefault(key, copy.copy(value))
    return config, retired


def _object(content: Any, path: Sequence[str], make: bool = False) -> dict[str, Any]:
    """Return the object at a path, or a new one, which is stored only if ``make``."""
    for part in path:
        if not isinstance(content, dict):
            return {}
        content = content.setdefault(part, {}) if make else content.get(part, {})
    return content if isinstance(content, dict) else {}


def present_config(config: Mapping[str, Any], number: int, what: str) -> dict[str, Any]:
    """Return a configuration in the current format; refuse removed options.

    Raises:
        ValueError: If a removed option had an effect; the text names it.
    """
    present, retired = migrate(config, number)
    for name, value in retired.items():
        raise ValueError(
            f"{what} was made with {name}={value}, an option that was removed: use the "
            "egoskin that made it"
        )
    return present


def present_header(header: Mapping[str, Any], number: int, what: str) -> dict[str, Any]:
    """Return a header with all its configurations in the current format.

    Raises:
        ValueError: If a removed option had an effect; the text names it.
    """
    header = copy.deepcopy(dict(header))
    if isinstance(header.get("config"), dict):
        header["config"] = present_config(header["config"], number, what)
    policy = header.get("policy")
    if isinstance(policy, dict) and "env" in policy:
        policy["env"] = present_config({"env": policy["env"]}, number, what)["env"]
        if number < 5:
            policy.setdefault("engine", _ENGINE)
    return header
