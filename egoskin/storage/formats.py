"""File formats: their number, the SHA-256 of what a file holds, and migrations.

Whatever egoskin writes to read again, a JSON file or the JSON header of a file of
tensors, opens with a seal:

    format    number of the format; files from before there was one have none, and are 1
    egoskin   version of egoskin that wrote it
    sha256    of all the rest, tensors included

Contract: what `unseal` returns is what `seal` was given, bit for bit; of a file that
has no seal it says, once, that nobody can know.
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

FORMAT = 5
"""Number of the format that is written."""
_SEAL = ("format", "egoskin", "sha256")
_ANY = object()
# What simulated before there was a choice.
_ENGINE = "mujoco"


@dataclass(frozen=True, kw_only=True)
class Migration:
    """How a configuration becomes one of the next format, by dotted names of fields."""

    added: Mapping[str, Any] = field(default_factory=dict)
    """Fields that are new, and their values with which nothing changes."""
    renamed: Mapping[str, str] = field(default_factory=dict)
    """Fields that have another name now, by the old one."""
    removed: Mapping[str, Any] = field(default_factory=dict)
    """Fields that are no more, and their values without effect (or any)."""


# By the number of the format that a migration starts from.
_MIGRATIONS = {
    1: Migration(
        added={
            "env.task.throws.first_delay": [0.0, 0.0],
            "env.task.throws.aim": "body",
        },
        removed={
            # Steps over which what of a ball touches grew; the price of the distance
            # from the start, from "drift_start" on; the speed of the balls, from
            # "slow_start" on; an oracle told first of the ball that passes next.
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
            # Distance to a ball's centre; an angle of view along each axis; beams from
            # edge to edge of the view, and several in a zone; a signal for each ball;
            # whether a signal is one; a position over the range, and in other frames.
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
}
assert _MIGRATIONS.keys() == set(range(1, FORMAT))


def package_version(package: str) -> str | None:
    """Return the version of an installed package, None if it is not installed."""
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None


def content_hash(content: Any, tensors: Mapping[str, Tensor] | None = None) -> str:
    """Return the SHA-256 of JSON values and tensors, whatever their order.

    Args:
        content: JSON values.
        tensors: Tensors by name; their names, types, shapes and bytes count.
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
    """Return the content of a file with its seal before it.

    Args:
        content: JSON values.
        tensors: What the file holds beside them.
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
    """Return (content without its seal, number of its format).

    Args:
        content: What the file holds.
        what: Name of the file.
        tensors: What it holds beside that.
        quiet: Whether to say nothing of a file without a seal.

    Raises:
        ValueError: If the content is not what was written, or of a newer format.
    """
    number = content.get("format", 1)
    if not isinstance(number, int) or number < 1:
        raise ValueError(f"{what} is damaged: its format is {number!r}")
    if number > FORMAT:
        raise ValueError(
            f"{what} has format {number}, and this egoskin "
            f"({package_version('egoskin')}) reads formats up to {FORMAT}: it needs "
            f"egoskin {content.get('egoskin')} or a later one"
        )
    given = {key: value for key, value in content.items() if key != "sha256"}
    if "sha256" in content:
        if content_hash(given, tensors) != content["sha256"]:
            raise ValueError(
                f"{what} is damaged or was edited: its content is not that of its "
                "SHA-256; put it back as it was written"
            )
    elif number > 1:
        raise ValueError(f"{what} is damaged or was edited: its SHA-256 is missing")
    elif not quiet:
        _note(what)
    return {key: value for key, value in given.items() if key not in _SEAL}, number


@functools.cache
def _note(what: str) -> None:
    """Say, once for each file, that it cannot be verified."""
    print(
        f"note: {what} is of an egoskin without checksums: whether it is whole cannot "
        "be verified",
        file=sys.stderr,
    )


def read_sealed(path: Path, *, quiet: bool = False) -> tuple[dict[str, Any], int]:
    """Return (content, number of its format) of a JSON file with or without a seal.

    Args:
        path: The file.
        quiet: Whether to say nothing of a file without a seal.

    Raises:
        ValueError: If it is no JSON object, or not what was written.
        OSError: If it cannot be read.
    """
    content = read_json(path)
    if not isinstance(content, dict):
        raise ValueError(
            f"{path} must hold a JSON object, not a {type(content).__name__}"
        )
    return unseal(content, str(path), quiet=quiet)


def sealed_json(content: Mapping[str, Any]) -> bytes:
    """Return what `read_sealed` reads."""
    return (json.dumps(seal(content), indent=2) + "\n").encode()


def migrate(
    config: Mapping[str, Any], number: int
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return a training configuration, or a part of one, in the present format.

    Args:
        config: The configuration as plain values, ``{"env": ...}``.
        number: Its format.

    Returns:
        The configuration, and the values with an effect of options that are no more,
        by name.
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
            # A part of a configuration gets what belongs to it.
            if path[0] in config if path else {"env", "ppo"} <= config.keys():
                inner = _object(config, path, make=True)
                inner.setdefault(key, copy.copy(value))
    return config, retired


def _object(content: Any, path: Sequence[str], make: bool = False) -> dict[str, Any]:
    """Return the object at a path, a new one if there is none, which is kept or not."""
    for part in path:
        if not isinstance(content, dict):
            return {}
        content = content.setdefault(part, {}) if make else content.get(part, {})
    return content if isinstance(content, dict) else {}


def present_config(config: Mapping[str, Any], number: int, what: str) -> dict[str, Any]:
    """Return what `migrate` does, where options that are no more are refused.

    Raises:
        ValueError: If one of them has an effect; the text names it.
    """
    present, retired = migrate(config, number)
    for name, value in retired.items():
        raise ValueError(
            f"{what} was made with {name}={value}, an option that is no more: use the "
            "egoskin that made it"
        )
    return present


def present_header(header: Mapping[str, Any], number: int, what: str) -> dict[str, Any]:
    """Return a header with all configurations in it in the present format.

    Raises:
        ValueError: If an option that is no more has an effect; the text names it.
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
