"""Your own robots: from a folder or from a Python file.

A folder holds an MJCF or URDF and ``robot.toml``::

    model = "robot.xml"                    # in the folder
    base = "pelvis"                        # the link that floats
    feet = ["*_foot"]                      # links that may touch the ground
    skin_links = ["torso", "*_arm"]        # links that carry sensors
    untargeted_links = ["*_shin"]          # optional: not aimed at with --standard 1
    name = "my_robot"                      # optional: else the folder's name

    [default_pose]                         # [rad] by joint; else 0
    "*_knee" = 0.4

    [gains.soft]                           # N m/rad, N m s/rad; the first set is used
    "*" = { kp = 100, kd = 5 }

Names may be patterns (``*``, ``?``, ``[ab]``).
"""

from __future__ import annotations

import fnmatch
import re
import runpy
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from traceback import extract_tb
from typing import Annotated, Any

from tyro.constructors import PrimitiveConstructorSpec

from egoskin.bounds import is_number
from egoskin.hints import did_you_mean, matching
from egoskin.robots.builtin import ROBOTS
from egoskin.robots.config import Gain, RobotConfig, read_robot
from egoskin.robots.portable import portable
from egoskin.storage.files import read_regular

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

TOML_NAME = "robot.toml"
"""Name of the file that describes the robot of a folder."""
_LISTS = ("feet", "skin_links", "untargeted_links")
_TABLES = ("default_pose", "gains")
_KEYS = ("name", "model", "base", *_LISTS, *_TABLES)
_NEEDED = ("model", "base", "feet", "skin_links", "gains")


def find_robot(name: str) -> RobotConfig:
    """Return a built-in robot by name, or one read from a path.

    A robot of the task, which has gains, is that of trainings: self-contained data, as
    of `egoskin.robots.portable.portable`. Others are as in their file.

    Args:
        name: As for `raw_robot`.

    Raises:
        ValueError: If there is no such robot, or its description is invalid.
        OSError: If a file that it refers to cannot be read.
    """
    robot = raw_robot(name)
    return portable(robot) if robot.gains and name not in ROBOTS else robot


def raw_robot(name: str) -> RobotConfig:
    """Return a built-in robot by name, or one as a file describes it.

    Args:
        name: Name of a built-in robot, a folder with ``robot.toml``, a `RobotConfig` in
            a Python file (``my_robot.py:ROBOT``; the file is executed), or an MJCF or
            URDF, to place sensors on (`egoskin.robots.config.read_robot`).

    Raises:
        ValueError: If there is no such robot, or its description is invalid.
        OSError: If a file that it refers to cannot be read.
    """
    if name in ROBOTS:
        return ROBOTS[name]
    file, _, variable = name.rpartition(":")
    if file.endswith(".py"):
        return _from_python(Path(file), variable)
    path = Path(name)
    if path.is_dir():
        return read_folder(path)
    if path.name == TOML_NAME and path.is_file():
        return read_folder(path.parent)
    if path.suffix == ".py" and path.is_file():
        raise ValueError(
            f"{name} lacks the name of the robot's variable: use {name}:ROBOT"
        )
    if path.exists():
        return read_robot(path)
    raise ValueError(
        f"no robot {name!r}: it must be one of {', '.join(ROBOTS)}, a folder with "
        f"{TOML_NAME}, my_robot.py:ROBOT, or the path of an MJCF or URDF"
    )


def kept_robot(name: str) -> str | RobotConfig:
    """Return a robot as stored in configurations: a built-in name, or data.

    Args:
        name: As for `find_robot`.

    Raises:
        ValueError: If there is no such robot, or its description is invalid.
        OSError: If a file that it refers to cannot be read.
    """
    return name if name in ROBOTS else portable(raw_robot(name))


Robot = Annotated[
    str | RobotConfig,
    PrimitiveConstructorSpec(
        nargs=1,
        metavar="NAME|PATH",
        instance_from_str=lambda texts: kept_robot(texts[0]),
        is_instance=lambda value: isinstance(value, (str, RobotConfig)),
        str_from_instance=lambda value: [
            value if isinstance(value, str) else value.name
        ],
    ),
]
"""A built-in robot by name, or another one as data; a command-line option accepts the
names and paths of `find_robot`."""


def robot_of(robot: str | RobotConfig) -> RobotConfig:
    """Return the robot stored in a configuration.

    Raises:
        ValueError: If it is neither a built-in name nor self-contained data.
    """
    if isinstance(robot, str):
        if robot not in ROBOTS:
            raise ValueError(
                f"no robot {robot!r}: it must be one of {', '.join(ROBOTS)}, or data "
                "from egoskin.robots.portable.portable(find_robot(PATH))"
            )
        return ROBOTS[robot]
    if robot.model_path is not None:
        raise ValueError(
            f"robot {robot.name!r} refers to a file, {robot.model_path}, but must be "
            "self-contained: use egoskin.robots.portable.portable(robot)"
        )
    return robot


def _from_python(path: Path, variable: str) -> RobotConfig:
    """Run a Python file and return the robot in one of its variables."""
    if not path.is_file():
        raise ValueError(f"no file {path}: a robot is given as my_robot.py:ROBOT")
    try:
        names = runpy.run_path(str(path))
    # The file may raise anything, or end the program.
    except (Exception, SystemExit) as error:
        lines = [
            f.lineno for f in extract_tb(error.__traceback__) if f.filename == str(path)
        ]
        # Not of a file that it imports.
        if isinstance(error, SyntaxError) and error.filename == str(path):
            lines.append(error.lineno)
        where = f":{lines[-1]}" if lines else ""
        raise ValueError(f"{path}{where}: {type(error).__name__}: {error}") from error
    robot = names.get(variable)
    if not isinstance(robot, RobotConfig):
        robots = [n for n, value in names.items() if isinstance(value, RobotConfig)]
        raise ValueError(
            f"{path} has no robot {variable!r}; its variables of type RobotConfig: "
            f"{', '.join(robots) or 'none'}"
        )
    return robot


class _Toml:
    """A TOML file, with errors that give the line number."""

    def __init__(self, path: Path) -> None:
        self.path, self.text = path, read_regular(path).decode("utf-8-sig", "replace")
        try:
            self.content: dict[str, Any] = tomllib.loads(self.text)
        except RecursionError:
            raise ValueError(f"{path}: nested too deeply") from None
        except tomllib.TOMLDecodeError as error:
            # The text ends in (at line 3, column 5), or (at end of document).
            text = str(error)
            if where := re.search(r" \(at line (\d+), column \d+\)$", text):
                text, line = text[: where.start()], where[1]
            else:
                line = len(self.text.splitlines()) or 1
            raise ValueError(f"{path}:{line}: {text}") from None

    def error(self, text: str, *keys: str) -> ValueError:
        """Return an error at the line of a key path, as far as the path is found."""
        return ValueError(f"{self.path}:{self._line(keys)}: {text}")

    def _line(self, keys: Sequence[str]) -> int:
        """Return the line of a key path; its last key may be the text of an item."""
        lines, at = self.text.splitlines(), 0
        for key in keys:
            quoted = rf"(?:{re.escape(key)}|\"{re.escape(key)}\"|'{re.escape(key)}')"
            # As a key or in a table's name, in an inline table, or else as a string.
            patterns = (
                rf"^\s*(?:\[[^\]#]*)?(?<![\w-]){quoted}\s*[=.\]]",
                rf"[{{,.]\s*{quoted}\s*=",
                rf"[\"']{re.escape(key)}[\"']",
            )
            found = next(
                (
                    i
                    for pattern in patterns
                    for i in range(at, len(lines))
                    if re.search(pattern, lines[i])
                ),
                None,
            )
            if found is None:
                break
            at = found
        return at + 1


def read_folder(folder: Path) -> RobotConfig:
    """Return the robot of a folder with an MJCF or URDF and ``robot.toml``.

    Raises:
        ValueError: If there is no ``robot.toml`` or it is invalid; the text gives the
            file, the line and what is valid.
        OSError: If a file cannot be read.
    """
    path = folder / TOML_NAME
    if not path.is_file():
        raise ValueError(
            f"{folder} is not a robot: it has no {TOML_NAME} (model, base, feet, "
            "skin_links, gains)"
        )
    toml = _Toml(path)
    _check_keys(toml)
    content = toml.content
    model = folder / content["model"]
    if not model.is_file():
        raise toml.error(f"there is no file {model}", "model")
    robot = RobotConfig(
        name=content.get("name", folder.resolve().name),
        model_path=model,
        base=content["base"],
        skin_links=(),
        default_pose=_pose(toml),
        gains=_gains(toml),
    )
    # Names of links and joints can only be checked once the model is loaded.
    try:
        _ = robot.model
    except ValueError as error:
        raise toml.error(str(error), "model") from None
    try:
        links = robot.links
    except ValueError as error:
        raise toml.error(str(error), "base") from None
    lists = {key: _links(toml, key, links) for key in _LISTS}
    _check_joints(toml, robot)
    return replace(robot, **lists)


def _check_keys(toml: _Toml) -> None:
    """Raise ValueError for keys that are unknown, missing or of a wrong type."""
    content = toml.content
    for key in content:
        if key not in _KEYS:
            hint = did_you_mean(key, _KEYS)
            known = ", ".join(_KEYS)
            raise toml.error(f"there is no key {key!r}{hint} (keys: {known})", key)
    for key in _NEEDED:
        if key not in content:
            raise toml.error(f"{key} is missing")
    for key, value in content.items():
        kind = list if key in _LISTS else dict if key in _TABLES else str
        if not isinstance(value, kind):
            names = {list: "a list of links", dict: "a table", str: "a string"}
            raise toml.error(f"{key} must be {names[kind]}, got {value!r}", key)


def _check_joints(toml: _Toml, robot: RobotConfig) -> None:
    """Raise ValueError for patterns of joints that match none, or too many."""
    tables = [(("default_pose",), robot.default_pose)]
    tables += [(("gains", name), table) for name, table in robot.gains.items()]
    for keys, table in tables:
        for pattern in table:
            _matching(toml, pattern, robot.joints, "joint", *keys)
    for name, gain_set in robot.gains.items():
        for joint in robot.joints:
            fitting = [p for p in gain_set if fnmatch.fnmatchcase(joint, p)]
            if len(fitting) != 1:
                patterns = " and ".join(map(repr, fitting)) or "none of its patterns"
                raise toml.error(
                    f"gains.{name}: joint {joint!r} must match one pattern, but "
                    f"matches {patterns}",
                    *("gains", name, *fitting[1:2]),
                )
    try:
        _ = robot.default_joint_pos
    except ValueError as error:
        raise toml.error(str(error), "default_pose") from None


def _pose(toml: _Toml) -> dict[str, float]:
    """Return the default pose."""
    pose = {}
    for joint, value in toml.content.get("default_pose", {}).items():
        if not is_number(value):
            raise toml.error(
                f"the position of {joint!r} must be a number [rad], got {value!r}",
                *("default_pose", joint),
            )
        pose[joint] = float(value)
    return pose


def _gains(toml: _Toml) -> dict[str, dict[str, Gain]]:
    """Return the gain sets."""
    if not toml.content["gains"]:
        raise toml.error("gains must contain a set, [gains.NAME]", "gains")
    sets: dict[str, dict[str, Gain]] = {}
    for name, table in toml.content["gains"].items():
        sets[name] = {}
        if not isinstance(table, dict):
            raise toml.error(f"gains.{name} must be a table of joints", "gains", name)
        for joint, gain in table.items():
            try:
                given = Gain(**gain)
            except (TypeError, ValueError):
                raise toml.error(
                    f"the gains of {joint!r} must be {{ kp = N m/rad > 0, kd = "
                    f"N m s/rad >= 0 }}, got {gain!r}",
                    *("gains", name, joint),
                ) from None
            sets[name][joint] = Gain(kp=float(given.kp), kd=float(given.kd))
    return sets


def _links(toml: _Toml, key: str, links: tuple[str, ...]) -> tuple[str, ...]:
    """Return the links that match a list of patterns, in the robot's order."""
    wanted: set[str] = set()
    for pattern in map(str, toml.content.get(key, [])):
        wanted.update(_matching(toml, pattern, links, "link", key))
    return tuple(link for link in links if link in wanted)


def _matching(
    toml: _Toml, pattern: str, names: Sequence[str], what: str, *keys: str
) -> tuple[str, ...]:
    """Return the names that match a pattern, of which there must be one."""
    try:
        return matching([pattern], names, what)
    except ValueError as error:
        raise toml.error(str(error), *keys, pattern) from None
