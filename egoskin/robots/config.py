"""Robots: a model and the settings that a model file does not contain.

The built-in robots are in `egoskin.robots.builtin`; your own robots are read from a
folder or a file (`egoskin.robots.own`). Names are resolved to indices once, in the
properties of the configuration.
"""

from __future__ import annotations

import fnmatch
from collections.abc import Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytorch_kinematics as pk

from egoskin.bounds import is_number
from egoskin.hints import matching
from egoskin.robots.chains import JOINT_TYPES, build_chain
from egoskin.robots.model import body_id, body_name, geom_mesh, joint_name
from egoskin.robots.model_text import checked_model
from egoskin.robots.spec import compile_robot, is_urdf, load_spec
from egoskin.storage.files import check_regular

# Largest component of the quaternion of a base that counts as upright.
_TILT = 1e-3


@dataclass(frozen=True, kw_only=True)
class Gain:
    """PD gain of one joint: torque = kp (q* - q) - kd qdot."""

    kp: float
    """Stiffness [N m/rad]."""
    kd: float
    """Damping [N m s/rad]."""

    def __post_init__(self) -> None:
        """Raise ValueError unless kp is positive and kd is not negative."""
        if not (is_number(self.kp) and is_number(self.kd)) or not (
            self.kp > 0 and self.kd >= 0
        ):
            raise ValueError(
                f"a gain must have numbers kp > 0 and kd >= 0, got kp = {self.kp!r}, "
                f"kd = {self.kd!r}"
            )


def resolve(
    table: Mapping[str, object],
    names: tuple[str, ...],
    what: str,
    default: object = None,
) -> list:
    """Return the value of each name from a table keyed by name patterns.

    Args:
        table: Values by shell pattern (``*_knee_joint``).
        names: Names to look up.
        what: Name of the table, for the error text.
        default: Value of names that match no pattern; None: they are refused.

    Returns:
        One value for each name.

    Raises:
        ValueError: If a name matches several patterns or, without a default, none, or a
            pattern matches no name.
    """
    values = []
    for name in names:
        matches = [p for p in table if fnmatch.fnmatchcase(name, p)]
        if not matches and default is not None:
            values.append(default)
            continue
        if len(matches) != 1:
            raise ValueError(
                f"{what}: {name!r} must match exactly one of the patterns "
                f"{', '.join(table)}; it matches {matches or 'none'}"
            )
        values.append(table[matches[0]])
    for pattern in table:
        if not fnmatch.filter(names, pattern):
            raise ValueError(f"{what}: {pattern!r} matches none of {', '.join(names)}")
    return values


@dataclass(frozen=True, kw_only=True, eq=False)
class Primitive:
    """A sphere, capsule or box fixed to a link."""

    link: str
    """Body that carries it."""
    kind: str
    """"sphere", "capsule" or "box"."""
    size: np.ndarray
    """MuJoCo's sizes [m], ``[3]``: radius; radius, half length; half extents."""
    position: np.ndarray
    """Centre in the link frame [m], ``[3]``."""
    rotation: np.ndarray
    """Orientation in the link frame (a capsule's axis is z), ``[3, 3]``."""

    def __post_init__(self) -> None:
        """Accept lists."""
        for name in ("size", "position", "rotation"):
            object.__setattr__(self, name, np.asarray(getattr(self, name), float))


@dataclass(frozen=True, kw_only=True)
class RobotConfig:
    """A robot: a base, and the hinges and slides below it.

    Sensors can be placed on any robot. The task requires a floating base, only hinges,
    gains, and the result of `egoskin.robots.portable.portable`, which leaves out the
    floor, actuators and sensors.
    """

    name: str
    """Name by which configurations refer to the robot."""
    model_path: Path | None = None
    """MJCF or URDF; only the base and the bodies below it are used. In a URDF, links on
    fixed joints are kept, and meshes, whose paths are seldom valid, are left out
    (`portable` puts primitives around those that it finds)."""
    model_xml: str | None = None
    """Instead of a path, an MJCF as text that refers to no other file, as saved with
    policies and runs (`egoskin.robots.portable.portable`)."""
    base: str
    """Root of `chain`, the *robot's centre frame*: the body with the free joint or, for
    a fixed-base robot, a body welded to the world or ``"world"``."""
    skin_links: tuple[str, ...]
    """Links that carry the proximity skin (the upper body)."""
    default_pose: Mapping[str, float] = field(default_factory=dict)
    """Joint positions of the default pose [rad], for slides [m], by joint name pattern;
    else 0."""
    gains: Mapping[str, Mapping[str, Gain]] = field(default_factory=dict)
    """Named sets of PD gains by joint name pattern; the first is the default."""
    feet: tuple[str, ...] = ()
    """Links that may touch the ground."""
    untargeted_links: tuple[str, ...] = ()
    """Links that throws at the whole body (standard 1) are not aimed at."""

    def __post_init__(self) -> None:
        """Raise ValueError unless exactly one model is given; accept a path as text."""
        if isinstance(self.model_path, str):
            object.__setattr__(self, "model_path", Path(self.model_path))
        if (self.model_path is None) == (self.model_xml is None):
            raise ValueError(
                f"robot {self.name!r} must have exactly one of model_path and model_xml"
            )

    def __hash__(self) -> int:
        """Return a hash without the tables, which are not hashable."""
        return hash((self.name, self.base, self.model_path, self.model_xml))

    def __getstate__(self) -> dict[str, Any]:
        """Return the fields only: cached properties are not copied or pickled."""
        return {f.name: getattr(self, f.name) for f in fields(self)}

    @cached_property
    def model(self) -> mujoco.MjModel:
        """The compiled model of the robot alone."""
        return compile_robot(self.spec(), self._origin)

    def spec(self) -> mujoco.MjSpec:
        """Return a new, editable specification of the robot.

        Raises:
            ValueError: If MuJoCo cannot read the model as MJCF or URDF, or a model
                given as text contains more than a robot of primitives.
            OSError: If there is no such file.
        """
        source = self.model_path
        if source is None:
            source = checked_model(self.model_xml or "", f"robot {self.name!r}")
        return load_spec(source, self._origin)

    @property
    def is_urdf(self) -> bool:
        """Whether the model is a URDF."""
        return self.model_path is not None and is_urdf(self.model_path)

    @property
    def _origin(self) -> str:
        """Where the model comes from, for error texts."""
        return str(self.model_path or f"the model of {self.name!r}")

    @cached_property
    def _bodies(self) -> list[int]:
        """The base (possibly the world) and all bodies below it, in MuJoCo's order."""
        bodies = [body_id(self.model, self.base)]
        for body in range(bodies[0] + 1, self.model.nbody):
            if self.model.body_parentid[body] in bodies:
                bodies.append(body)
        return bodies

    @cached_property
    def links(self) -> tuple[str, ...]:
        """The base and the bodies below it in MuJoCo's order (without the world).

        Unnamed bodies are named as in `build_chain`.
        """
        return tuple(body_name(self.model, body) for body in self._bodies if body)

    @cached_property
    def _joint_ids(self) -> np.ndarray:
        """Indices of the robot's joints in the model, ``[J]``."""
        model = self.model
        below = np.isin(model.jnt_bodyid, self._bodies[1:])
        return np.flatnonzero(below & np.isin(model.jnt_type, list(JOINT_TYPES)))

    @cached_property
    def joints(self) -> tuple[str, ...]:
        """Hinges and slides below the base, in MuJoCo's order, as in `build_chain`."""
        return tuple(joint_name(self.model, joint) for joint in self._joint_ids)

    @property
    def floats(self) -> bool:
        """Whether the base has a free joint."""
        first = self.model.body_jntadr[self._bodies[0]]
        free = mujoco.mjtJoint.mjJNT_FREE
        return bool(first >= 0 and self.model.jnt_type[first] == free)

    @property
    def base_pose(self) -> np.ndarray:
        """Pose of the base in the world where the file puts it, ``[7]``.

        Position [m] and quaternion (w, x, y, z). If the base does not float, it is what
        sensors read as ``base_pose``.
        """
        data = self._in_pose(self.default_joint_pos)
        base = self._bodies[0]
        return np.concatenate((data.xpos[base], data.xquat[base]))

    def check_floating_base(self) -> None:
        """Raise ValueError unless the base floats, upright, and the rest are hinges."""
        model, kinds = self.model, self.model.jnt_type
        if not self.floats or model.jnt_bodyid[0] != self._bodies[0]:
            raise ValueError(
                f"{self.name}: the first joint must be the free joint of its base "
                f"{self.base!r} (required to throw balls, not to place sensors)"
            )
        # Both components are 0 in a rotation about z.
        if np.abs(model.qpos0[4:6]).max() > _TILT:
            raise ValueError(
                f"{self.name}: its base {self.base!r} must be upright in the file "
                "(turned about z at most); an episode starts so"
            )
        own = {*self._joint_ids}
        others = [
            joint_name(model, j)
            for j in range(1, model.njnt)
            if j not in own or kinds[j] != mujoco.mjtJoint.mjJNT_HINGE
        ]
        if others:
            raise ValueError(
                f"{self.name}: all joints but the first must be hinges below its base; "
                f"not so: {', '.join(others)}"
            )

    @cached_property
    def default_joint_pos(self) -> np.ndarray:
        """Joint positions of the default pose [rad], for slides [m], ``[J]``."""
        return np.array(resolve(self.default_pose, self.joints, "default_pose", 0.0))

    @cached_property
    def torque_limit(self) -> np.ndarray:
        """Largest torque of each joint [N m], ``[J]`` (``actuatorfrcrange``).

        For a slide, the largest force [N].
        """
        return self.model.jnt_actfrcrange[self._joint_ids, 1]

    @cached_property
    def joint_range(self) -> np.ndarray:
        """Lower and upper limit of each joint [rad], for slides [m], ``[2, J]``.

        Infinite for a joint without a range.
        """
        limited = self.model.jnt_limited[self._joint_ids, None].astype(bool)
        limits = self.model.jnt_range[self._joint_ids]
        return np.where(limited, limits, [-np.inf, np.inf]).T

    def joint_gains(self, gain_set: str | None) -> tuple[np.ndarray, np.ndarray]:
        """Return (kp [N m/rad], kd [N m s/rad]) of a gain set, ``[J]`` each.

        Args:
            gain_set: Name of the gain set; None selects the first.

        Raises:
            ValueError: If the robot has no gain set of that name, or none at all.
        """
        if not self.gains:
            raise ValueError(
                f"{self.name} has no gains to hold its joints (required to throw "
                "balls, not to place sensors)"
            )
        if gain_set is None:
            gain_set = next(iter(self.gains))
        if gain_set not in self.gains:
            raise ValueError(
                f"{self.name} has no gain set {gain_set!r}; it has "
                f"{', '.join(self.gains)}"
            )
        gains = resolve(self.gains[gain_set], self.joints, f"gains[{gain_set!r}]")
        return np.array([g.kp for g in gains]), np.array([g.kd for g in gains])

    @cached_property
    def default_base_height(self) -> float:
        """Height of the base when the default pose stands on the ground [m]."""
        return self.base_height(self.default_joint_pos)

    def base_height(self, joint_pos: np.ndarray) -> float:
        """Return the height of the base when a pose stands on the ground [m].

        Args:
            joint_pos: Joint positions [rad], for slides [m], ``[J]``.
        """
        data = self._in_pose(joint_pos)
        lowest, _ = self._extent(data)
        return float(data.xpos[self._bodies[0], 2] - lowest)

    @property
    def lowest_link(self) -> str:
        """The link that reaches lowest in the default pose."""
        data = self._in_pose(self.default_joint_pos)
        geoms = self._collision_geoms(self.links)
        if not geoms:
            return min(self.links, key=lambda link: data.body(link).xpos[2])
        geom = min(geoms, key=lambda g: _extent(self.model, data, g)[0])
        return body_name(self.model, int(self.model.geom_bodyid[geom]))

    @cached_property
    def standing_height(self) -> float:
        """Height of the robot in the default pose, rounded to 1 cm [m]."""
        lowest, highest = self._extent(self._in_pose(self.default_joint_pos))
        return round(highest - lowest, 2)

    def _in_pose(self, joint_pos: np.ndarray) -> mujoco.MjData:
        """Return the robot in a pose, the base where the file puts it."""
        model, data = self.model, mujoco.MjData(self.model)
        data.qpos[model.jnt_qposadr[self._joint_ids]] = joint_pos
        mujoco.mj_kinematics(model, data)
        return data

    def _extent(self, data: mujoco.MjData) -> tuple[float, float]:
        """Return the height of the lowest and highest point of its shapes [m].

        Without collision shapes: of the origins of its links.
        """
        ends = [_extent(self.model, data, g) for g in self._collision_geoms(self.links)]
        lows, highs = zip(*(ends or data.xpos[self._bodies][:, [2, 2]]), strict=True)
        return min(lows), max(highs)

    @cached_property
    def primitives(self) -> tuple[Primitive, ...]:
        """The collision shapes, with their poses in the frames of their links."""
        return self.primitives_on(self.links)

    def _collision_geoms(self, links: Collection[str]) -> list[int]:
        """Return the collision geoms of some links, without visual geoms."""
        model = self.model
        wanted = [b for b in self._bodies if b and body_name(model, b) in links]
        touching = (model.geom_contype | model.geom_conaffinity) != 0
        touching[[*model.pair_geom1, *model.pair_geom2]] = True
        on_links = np.isin(model.geom_bodyid, wanted)
        return np.flatnonzero(on_links & touching).tolist()

    def has_shape(self, link: str, *, visual: bool = False) -> bool:
        """Return whether a link has a collision shape or, if asked, any other one."""
        if not visual:
            return bool(self._collision_geoms([link]))
        return body_id(self.model, link) in self.model.geom_bodyid

    def primitives_on(self, links: Collection[str]) -> tuple[Primitive, ...]:
        """Return the collision shapes of some links, with their poses in their frames.

        A cylinder is replaced as in `round_off`.

        Args:
            links: Names of the links; the shapes of other links are ignored.

        Raises:
            ValueError: If a shape is not a sphere, capsule, box or cylinder.
        """
        model, shapes = self.model, []
        for geom in self._collision_geoms(links):
            rotation = np.zeros(9)
            mujoco.mju_quat2Mat(rotation, model.geom_quat[geom])
            kind, size = _primitive(model, geom)
            shapes.append(
                Primitive(
                    link=body_name(model, int(model.geom_bodyid[geom])),
                    kind=kind,
                    size=size,
                    position=model.geom_pos[geom].copy(),
                    rotation=rotation.reshape(3, 3),
                )
            )
        return tuple(shapes)

    @cached_property
    def known_primitives(self) -> tuple[Primitive, ...]:
        """The collision shapes of those links whose shapes are all primitives."""
        shapes: list[Primitive] = []
        for link in self.links:
            # If one shape of a link is unknown, the others do not define its surface.
            with suppress(ValueError):
                shapes += self.primitives_on([link])
        return tuple(shapes)

    @cached_property
    def chain(self) -> pk.Chain:
        """Kinematic chain from the base, for pytorch-kinematics.

        Its constants are float32, so poses are accurate to about 4e-7 m, also those
        computed in float64; `build_chain` makes chains of other types.
        """
        return build_chain(self.model, self.base)


def read_robot(
    path: Path | str,
    *,
    base: str | None = None,
    skin_links: Sequence[str] | None = None,
) -> RobotConfig:
    """Return the robot of an MJCF or URDF file, to place or import sensors on.

    The name is the model's, or else the file's.

    Args:
        path: The file.
        base: Base of the robot; bodies that are not below it are left out (those of a
            scene, say). By default the only body attached to the world if it has a free
            joint or none, else (with several such bodies, or a hinge between them) the
            world itself.
        skin_links: Links that may carry skin, by name or shell pattern; by default all.

    Raises:
        ValueError: If MuJoCo cannot read the file as MJCF or URDF, or the base or a
            link is not in it.
        OSError: If there is no such file.
    """
    path = Path(path)
    # With other suffixes MuJoCo does not know the format, and logs a warning.
    if path.suffix.lower() not in (".xml", ".urdf"):
        check_regular(path)
        raise ValueError(f"{path} must be an MJCF (.xml) or a URDF (.urdf, .xml)")
    whole = RobotConfig(name=path.stem, model_path=path, base="world", skin_links=())
    model, name = whole.model, whole.spec().modelname
    if base is None:
        in_world = np.flatnonzero(model.body_parentid[1:] == 0) + 1
        kinds = model.jnt_type[model.jnt_bodyid == in_world[0]] if len(in_world) else []
        # Joints of the base are not part of its chain.
        one = len(in_world) == 1 and all(k == mujoco.mjtJoint.mjJNT_FREE for k in kinds)
        base = body_name(model, int(in_world[0])) if one else "world"
    # MuJoCo's default name of a model.
    name = whole.name if name in ("", "MuJoCo Model") else name
    robot = replace(whole, name=name, base=base)
    if skin_links is None:
        return replace(robot, skin_links=robot.links)
    try:
        chosen = matching(skin_links, robot.links, "link")
    except ValueError as error:
        raise ValueError(f"{path}, below base {base!r}: {error}") from None
    return replace(robot, skin_links=chosen)


def round_off(radius: float, half_length: float) -> tuple[str, list[float]]:
    """Return the primitive that replaces a cylinder, and its size as in MuJoCo [m].

    It is the capsule inside it, of the same length and radius, or, if it is not longer
    than its diameter, the box around it.
    """
    if half_length > radius:
        return "capsule", [radius, half_length - radius, 0.0]
    return "box", [radius, radius, half_length]


def _primitive(model: mujoco.MjModel, geom: int) -> tuple[str, np.ndarray]:
    """Return "sphere", "capsule" or "box", and its size as in MuJoCo [m], ``[3]``.

    Raises:
        ValueError: If the geom is of another kind and no cylinder.
    """
    kind = mujoco.mjtGeom(int(model.geom_type[geom])).name
    kind = kind.removeprefix("mjGEOM_").lower()
    size = model.geom_size[geom].copy()
    if kind == "cylinder":
        kind, rounded = round_off(*size[:2].tolist())
        size = np.array(rounded)
    elif kind not in ("sphere", "capsule", "box"):
        link = body_name(model, int(model.geom_bodyid[geom]))
        name = model.geom(geom).name or geom
        raise ValueError(
            f"link {link!r} has a collision shape, geom {name!r}, of kind {kind}; it "
            "must be a sphere, capsule, box or cylinder: use "
            "egoskin.robots.portable.portable(robot), or a folder with robot.toml, "
            "which put one around meshes and ellipsoids; or place sensors on the "
            f"link's meshes with meshes={{{link!r}: [...]}} (--meshes)"
        )
    return kind, size


def _extent(
    model: mujoco.MjModel, data: mujoco.MjData, geom: int
) -> tuple[float, float]:
    """Return the height of the lowest and highest point of a geom [m].

    Raises:
        ValueError: If the geom is neither a primitive nor a mesh.
    """
    z_row = data.geom_xmat[geom].reshape(3, 3)[2]
    if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_MESH:
        vertices, _ = geom_mesh(model, geom)
        heights = vertices @ z_row
        heights += data.geom_xpos[geom, 2]
        return float(heights.min()), float(heights.max())
    kind, size = _primitive(model, geom)
    if kind == "sphere":
        reach = size[0]
    elif kind == "capsule":
        reach = size[0] + size[1] * abs(z_row[2])
    else:
        reach = float(np.abs(z_row) @ size)
    centre = data.geom_xpos[geom, 2]
    return float(centre - reach), float(centre + reach)
