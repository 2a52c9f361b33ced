"""Your own robots: from a folder, from a Python file, or as self-contained data.

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

Names may be patterns (``*``, ``?``, ``[ab]``). Contract: the result of `portable`
refers to no file and is the same robot wherever it is loaded.
"""

from __future__ import annotations

import fnmatch
import re
import runpy
import sys
from collections.abc import Collection, Sequence
from dataclasses import replace
from pathlib import Path
from traceback import extract_tb
from typing import Annotated, Any
from xml.etree import ElementTree

import mujoco
import numpy as np
from tyro.constructors import PrimitiveConstructorSpec

from egoskin.bounds import is_number
from egoskin.hints import did_you_mean
from egoskin.robots.builtin import ROBOTS
from egoskin.robots.chains import body_id, body_name
from egoskin.robots.config import Gain, RobotConfig, read_robot, round_off
from egoskin.robots.spec import set_inertia
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
# Collision bits of balls and floor; a robot's own bits are above them.
_WORLD_BITS, _NUM_WORLD_BITS = 3, 2


def find_robot(name: str) -> RobotConfig:
    """Return a built-in robot by name, or one read from a path.

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
    return name if name in ROBOTS else portable(find_robot(name))


def _name(robot: str | RobotConfig) -> str:
    """Return the name of a robot as stored in configurations."""
    return robot if isinstance(robot, str) else robot.name


Robot = Annotated[
    str | RobotConfig,
    PrimitiveConstructorSpec(
        nargs=1,
        metavar="NAME|PATH",
        instance_from_str=lambda texts: kept_robot(texts[0]),
        is_instance=lambda value: isinstance(value, (str, RobotConfig)),
        str_from_instance=lambda value: [_name(value)],
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
                "from egoskin.robots.own.portable(find_robot(PATH))"
            )
        return ROBOTS[robot]
    if robot.model_path is not None:
        raise ValueError(
            f"robot {robot.name!r} refers to a file, {robot.model_path}, but must be "
            "self-contained: use egoskin.robots.own.portable(robot)"
        )
    return robot


def _from_python(path: Path, variable: str) -> RobotConfig:
    """Run a Python file and return the robot in one of its variables."""
    if not path.is_file():
        raise ValueError(f"no file {path}: a robot is given as my_robot.py:ROBOT")
    try:
        names = runpy.run_path(str(path))
    # The file may raise anything.
    except Exception as error:
        lines = [
            f.lineno for f in extract_tb(error.__traceback__) if f.filename == str(path)
        ]
        if isinstance(error, SyntaxError):
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
    content = toml.content
    for key in content:
        if key not in _KEYS:
            raise toml.error(f"there is {_no_match(key, _KEYS, 'key')}", key)
    for key in _NEEDED:
        if key not in content:
            raise toml.error(f"{key} is missing")
    for key, value in content.items():
        kind = list if key in _LISTS else dict if key in _TABLES else str
        if not isinstance(value, kind):
            names = {list: "a list of links", dict: "a table", str: "a string"}
            raise toml.error(f"{key} must be {names[kind]}, got {value!r}", key)
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
    tables = [(("default_pose",), robot.default_pose)]
    tables += [(("gains", name), table) for name, table in robot.gains.items()]
    for keys, table in tables:
        for pattern in table:
            if not fnmatch.filter(robot.joints, pattern):
                text = _no_match(pattern, robot.joints, "joint")
                raise toml.error(text, *keys, pattern)
    for name, gain_set in robot.gains.items():
        for joint in robot.joints:
            matching = [p for p in gain_set if fnmatch.fnmatchcase(joint, p)]
            if len(matching) != 1:
                patterns = " and ".join(map(repr, matching)) or "none of its patterns"
                raise toml.error(
                    f"gains.{name}: joint {joint!r} must match one pattern, but "
                    f"matches {patterns}",
                    *("gains", name, *matching[1:2]),
                )
    try:
        _ = robot.default_joint_pos
    except ValueError as error:
        raise toml.error(str(error), "default_pose") from None
    return replace(robot, **lists)


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
            if (
                not isinstance(gain, dict)
                or gain.keys() != {"kp", "kd"}
                or not all(map(is_number, gain.values()))
                or gain["kp"] <= 0
                or gain["kd"] < 0
            ):
                raise toml.error(
                    f"the gains of {joint!r} must be {{ kp = N m/rad > 0, kd = "
                    f"N m s/rad >= 0 }}, got {gain!r}",
                    *("gains", name, joint),
                )
            sets[name][joint] = Gain(kp=float(gain["kp"]), kd=float(gain["kd"]))
    return sets


def _links(toml: _Toml, key: str, links: tuple[str, ...]) -> tuple[str, ...]:
    """Return the links that match a list of patterns, in the robot's order."""
    wanted: set[str] = set()
    for pattern in toml.content.get(key, []):
        matching = fnmatch.filter(links, str(pattern))
        if not matching:
            raise toml.error(_no_match(str(pattern), links, "link"), key, str(pattern))
        wanted.update(matching)
    return tuple(link for link in links if link in wanted)


def _no_match(pattern: str, names: Sequence[str], what: str) -> str:
    hint = did_you_mean(pattern, names)
    return f"no {what} {pattern!r}{hint} ({what}s: {', '.join(names)})"


def portable(robot: RobotConfig) -> RobotConfig:
    """Return a robot as self-contained data: an MJCF of primitives, as text.

    Visual meshes, actuators, sensors, key frames, their defaults, and everything that
    is not below the base are left out; masses are kept. A cylinder becomes the capsule
    inside it, of the same length and radius, or, if it is flat, a box; a primitive that
    MuJoCo fits to a mesh becomes one with a size of its own. The base of a
    URDF floats. Margins of contacts are zero. If the file does not use this package's
    collision bits (see ``egoskin/assets/h1_2.xml``), self-collision stays as in the
    file, and balls and floor collide with all shapes.

    Args:
        robot: A robot of the task; `RobotConfig.model_path` is read.

    Raises:
        ValueError: If a collision shape is not a sphere, capsule, box or cylinder, or
            the model contains other elements that cannot be kept as data.
    """
    if robot.model_xml is not None:
        return robot
    spec, model = robot.spec(), robot.model
    keep = set(robot.links)
    _check_outermost(robot, model)
    for kind, elements in {
        "tendons": spec.tendons,
        "equality constraints (in a URDF: mimic)": spec.equalities,
    }.items():
        if elements:
            raise ValueError(
                f"{robot.name}: {kind} are not supported: remove them, or fix the "
                "joints that they move"
            )
    _fix_inertia(spec, model)
    in_pairs = {pair.geomname1 for pair in spec.pairs}
    in_pairs |= {pair.geomname2 for pair in spec.pairs}
    for body in list(spec.worldbody.bodies):
        if body.name not in keep:
            spec.delete(body)
    _fit_primitives(spec)
    for geom in list(spec.geoms):
        touches = geom.contype or geom.conaffinity or geom.name in in_pairs
        if geom.parent.name == "world" or (
            not touches and geom.type not in _PRIMITIVES
        ):
            spec.delete(geom)
        elif geom.type == mujoco.mjtGeom.mjGEOM_CYLINDER:
            _round_off(geom)
        elif geom.type not in _PRIMITIVES:
            raise ValueError(
                f"{robot.name}: link {geom.parent.name!r} has a collision shape, "
                f"{geom.name or 'unnamed'}, of kind "
                f"{geom.type.name.removeprefix('mjGEOM_').lower()}; a robot stored as "
                "data may have spheres, capsules, boxes and cylinders: replace it, or "
                'make it visual only (contype="0" conaffinity="0")'
            )
    for each in (*spec.geoms, *spec.pairs):
        # A ball within the margin would count as a touch.
        each.margin = each.gap = 0.0
    geoms, bodies = ({each.name for each in x} for x in (spec.geoms, spec.bodies))
    for pair in list(spec.pairs):
        if not {pair.geomname1, pair.geomname2} <= geoms:
            spec.delete(pair)
    for exclude in list(spec.excludes):
        if not {exclude.bodyname1, exclude.bodyname2} <= bodies:
            spec.delete(exclude)
    _set_bits(spec, in_pairs)
    for elements in (
        *(spec.actuators, spec.sensors, spec.keys, spec.cameras, spec.lights),
        *(spec.meshes, spec.textures, spec.hfields, spec.skins),
        *(spec.texts, spec.numerics, spec.tuples),
    ):
        for element in list(elements):
            spec.delete(element)
    for material in spec.materials:
        material.textures = [""] * len(material.textures)
    base = spec.body(robot.base)
    if robot.is_urdf and not base.joints:
        base.add_freejoint(name="floating_base")
    try:
        spec.compile()
    except ValueError as error:
        text = " ".join(str(error).split())
        raise ValueError(f"{robot.name} cannot be stored as data: {text}") from error
    data = replace(robot, model_path=None, model_xml=_robot_only(spec.to_xml()))
    try:
        # This raises for any other element that cannot be kept.
        _ = data.model
    except ValueError:
        # Or for a flat link. Other robots keep their very text.
        if not _thicken(spec, model):
            raise
        data = replace(data, model_xml=_robot_only(spec.to_xml()))
        _ = data.model
    return data


# Elements of a default class that apply to what is kept.
_KEPT_DEFAULTS = ("default", "joint", "geom", "site", "material", "pair")


def _robot_only(text: str) -> str:
    """Return an MJCF without the settings of elements that have been left out."""
    root = ElementTree.fromstring(text)
    surplus = [(root, e) for e in root if e.tag in ("size", "statistic", "visual")]
    for default in root.iter("default"):
        surplus += [(default, e) for e in default if e.tag not in _KEPT_DEFAULTS]
    for parent, element in surplus:
        parent.remove(element)
    # Otherwise the very text, to which stored robots are compared.
    return ElementTree.tostring(root, encoding="unicode") if surplus else text


# An MJCF has six digits. Rounded, two inertias and their sum differ by less than this.
_ROUNDING = 1.1e-5
_PRIMITIVES = (
    mujoco.mjtGeom.mjGEOM_SPHERE,
    mujoco.mjtGeom.mjGEOM_CAPSULE,
    mujoco.mjtGeom.mjGEOM_BOX,
    mujoco.mjtGeom.mjGEOM_CYLINDER,
)
_QUAT = mujoco.mjtOrientation.mjORIENTATION_QUAT


def _check_outermost(robot: RobotConfig, model: mujoco.MjModel) -> None:
    """Raise ValueError if the base is fixed to another body."""
    parent = model.body_parentid[body_id(model, robot.base)]
    if parent:
        raise ValueError(
            f"{robot.name}: the base {robot.base!r} is fixed to "
            f"{body_name(model, parent)!r}, but must be attached to the world itself: "
            "take the outermost body as base, or remove what is above it"
        )


def _fix_inertia(spec: mujoco.MjSpec, model: mujoco.MjModel) -> None:
    """Set the inertia of each link, which may come from shapes that are left out."""
    for body in spec.bodies:
        if body.name != "world" and not body.explicitinertial:
            set_inertia(body, model)


def _thicken(spec: mujoco.MjSpec, model: mujoco.MjModel) -> bool:
    """Lower the largest inertia of flat links, so that it stays valid if rounded.

    Returns:
        Whether there are such links.
    """
    found = False
    for body in spec.bodies:
        inertia = np.sort(model.body_inertia[body_id(model, body.name)])
        largest = (1 - _ROUNDING) * inertia[:2].sum()
        if inertia[2] > largest:
            found = True
            set_inertia(body, model)
            thick = np.array(body.inertia)
            thick[thick.argmax()] = largest
            body.inertia = thick
    return found


def _fit_primitives(spec: mujoco.MjSpec) -> None:
    """Give the primitives that MuJoCo fits to meshes sizes and poses of their own."""
    mesh = mujoco.mjtGeom.mjGEOM_MESH
    fitted = [geom for geom in spec.geoms if geom.meshname and geom.type != mesh]
    if not fitted:
        return
    # It numbers the geoms, and fits them.
    model = spec.compile()
    for geom in fitted:
        geom.size, geom.pos = model.geom_size[geom.id], model.geom_pos[geom.id]
        geom.quat, geom.alt.type = model.geom_quat[geom.id], _QUAT
        geom.meshname = ""


def _round_off(geom: mujoco.MjsGeom) -> None:
    """Turn a cylinder into a capsule or, if it is flat, into a box."""
    kind, geom.size = round_off(float(geom.size[0]), float(geom.size[1]))
    geom.type = getattr(mujoco.mjtGeom, f"mjGEOM_{kind.upper()}")


def _set_bits(spec: mujoco.MjSpec, in_pairs: Collection[str]) -> None:
    """Make balls and floor collide with all collision shapes, if they do not yet."""
    touching = [
        g for g in spec.geoms if g.contype or g.conaffinity or g.name in in_pairs
    ]
    if all(
        g.conaffinity & _WORLD_BITS == _WORLD_BITS and not g.contype & _WORLD_BITS
        for g in touching
    ):
        return
    for geom in touching:
        own = (1 << (31 - _NUM_WORLD_BITS)) - 1
        geom.contype = (geom.contype & own) << _NUM_WORLD_BITS
        geom.conaffinity = (geom.conaffinity & own) << _NUM_WORLD_BITS | _WORLD_BITS
