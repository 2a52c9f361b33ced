"""Robots as self-contained data: an MJCF of primitives, as text.

Contract: the result of `portable` refers to no file and is the same robot wherever it
is loaded.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable
from dataclasses import dataclass, replace
from typing import Any
from xml.etree import ElementTree

import mujoco
import numpy as np

from egoskin.robots.config import RobotConfig, round_off
from egoskin.robots.meshes import (
    MeshFit,
    add_urdf_meshes,
    fit_meshes,
    set_shape,
    type_of,
)
from egoskin.robots.model import body_id, body_name
from egoskin.robots.spec import set_inertia

# Collision bits of balls and floor; a robot's own bits are above them.
_WORLD_BITS, _NUM_WORLD_BITS = 3, 2
# What a tendon without effect has none of.
_TENDON_FORCES = ("limited", "stiffness", "damping", "frictionloss", "armature")
# Groups of geoms that pictures show are those up to this one.
_LAST_SHOWN = 2
# Elements of a default class that apply to what is kept.
_KEPT_DEFAULTS = ("default", "joint", "geom", "site", "material", "pair")
# An MJCF has six digits. Rounded, two inertias and their sum differ by less than this.
_ROUNDING = 1.1e-5
_PRIMITIVES = (
    mujoco.mjtGeom.mjGEOM_SPHERE,
    mujoco.mjtGeom.mjGEOM_CAPSULE,
    mujoco.mjtGeom.mjGEOM_BOX,
    mujoco.mjtGeom.mjGEOM_CYLINDER,
)


@dataclass(frozen=True, kw_only=True)
class Portable:
    """A robot as self-contained data, and what became of some collision shapes."""

    robot: RobotConfig
    """The robot, its model as text."""
    fits: list[MeshFit]
    """Primitives in place of collision meshes and ellipsoids."""
    lost: list[str]
    """Links of a URDF with collision meshes that could not be read."""


def portable(robot: RobotConfig) -> RobotConfig:
    """Return a robot as self-contained data: an MJCF of primitives, as text.

    Visual meshes, actuators, sensors, key frames, their defaults, tendons without
    effect, and everything that is not below the base are left out; masses are kept. A
    joint without a torque limit has that of its actuators. A cylinder becomes the
    capsule inside it, of the same length and radius, or, if it is flat, a box; a
    collision mesh or ellipsoid the smallest primitives around it; a primitive that
    MuJoCo fits to a mesh one with a size of its own. Links do not collide with each
    other if they overlap in the default pose and one of them had a collision mesh or
    ellipsoid. The base of a URDF floats. Margins of contacts are zero. If the file does
    not use this package's collision bits (see ``egoskin/assets/h1_2.xml``),
    self-collision stays as in the file, and balls and floor collide with all shapes.

    Args:
        robot: A robot of the task; `RobotConfig.model_path` is read.

    Raises:
        ValueError: If a collision shape is of another kind (height field), or the
            model contains other elements that cannot be kept as data.
    """
    return make_portable(robot).robot


def make_portable(robot: RobotConfig) -> Portable:
    """Return a robot as of `portable`, and what became of meshes and ellipsoids."""
    if robot.model_xml is not None:
        return Portable(robot=robot, fits=[], lost=[])
    spec, model = robot.spec(), robot.model
    _check_supported(robot, spec, model)
    _fix_inertia(spec, model)
    _limit_torques(spec, model)
    in_pairs = {pair.geomname1 for pair in spec.pairs}
    in_pairs |= {pair.geomname2 for pair in spec.pairs}
    for body in list(spec.worldbody.bodies):
        if body.name not in robot.links:
            spec.delete(body)
    # They may refer to what has been deleted.
    _delete(
        spec,
        *(spec.actuators, spec.sensors, spec.keys, spec.cameras, spec.lights),
        *(spec.texts, spec.numerics, spec.tuples, spec.tendons, spec.skins),
    )
    if robot.is_urdf and robot.model_path is not None:
        fits, lost = add_urdf_meshes(spec, robot.model_path)
    else:
        fits, lost = fit_meshes(spec, in_pairs), []
    _round_off(spec)
    _keep_primitives(spec, robot.name, in_pairs)
    _set_bits(spec, in_pairs)
    _exclude_overlaps(spec, robot, {fit.link for fit in fits})
    _delete(spec, spec.meshes, spec.textures, spec.hfields)
    spec.meshdir = spec.texturedir = ""
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
    return Portable(robot=data, fits=fits, lost=lost)


def _delete(spec: mujoco.MjSpec, *kinds: Iterable[Any]) -> None:
    """Delete elements of a specification."""
    for elements in kinds:
        for element in list(elements):
            spec.delete(element)


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


def _keep_primitives(spec: mujoco.MjSpec, name: str, in_pairs: Collection[str]) -> None:
    """Delete visual meshes and the shapes of the world; reset margins of contacts.

    Raises:
        ValueError: If a collision shape is no primitive.
    """
    for geom in list(spec.geoms):
        touches = geom.contype or geom.conaffinity or geom.name in in_pairs
        if touches and geom.group > _LAST_SHOWN:
            # What was shown in its place is left out.
            geom.group = 0
        if geom.parent.name == "world" or (
            not touches and geom.type not in _PRIMITIVES
        ):
            spec.delete(geom)
        elif geom.type not in _PRIMITIVES:
            raise ValueError(
                f"{name}: link {geom.parent.name!r} has a collision shape, "
                f"{geom.name or 'unnamed'}, of kind "
                f"{geom.type.name.removeprefix('mjGEOM_').lower()}; a robot stored as "
                "data may have spheres, capsules, boxes, cylinders, ellipsoids and "
                "meshes: replace it, or make it visual only "
                '(contype="0" conaffinity="0")'
            )
    for each in (*spec.geoms, *spec.pairs):
        # A ball within the margin would count as a touch.
        each.margin = each.gap = 0.0
    geoms = {geom.name for geom in spec.geoms}
    for pair in list(spec.pairs):
        if not {pair.geomname1, pair.geomname2} <= geoms:
            spec.delete(pair)


def _check_supported(
    robot: RobotConfig, spec: mujoco.MjSpec, model: mujoco.MjModel
) -> None:
    """Raise ValueError if the base is fixed to a body, or for tendons or equalities."""
    if robot.is_urdf and robot.base == "world":
        roots = [b.name for b in spec.worldbody.bodies]
        raise ValueError(
            f"{robot.name} has no single base: attached to the world are "
            f"{', '.join(roots)}; give base in robot.toml"
        )
    parent = model.body_parentid[body_id(model, robot.base)]
    if parent:
        raise ValueError(
            f"{robot.name}: the base {robot.base!r} is fixed to "
            f"{body_name(model, parent)!r}, but must be attached to the world itself: "
            "take the outermost body as base, or remove what is above it"
        )
    acting = [np.any(getattr(model, f"tendon_{name}")) for name in _TENDON_FORCES]
    for kind, found in {
        "tendons with limit, stiffness, damping, friction or armature": any(acting),
        "equality constraints (in a URDF: mimic)": bool(spec.equalities),
    }.items():
        if found:
            raise ValueError(
                f"{robot.name}: {kind} are not supported: remove them, or fix the "
                "joints that they move"
            )


def _fix_inertia(spec: mujoco.MjSpec, model: mujoco.MjModel) -> None:
    """Set the inertia of each link, which may come from shapes that are left out."""
    for body in spec.bodies:
        if body.name != "world" and not body.explicitinertial:
            set_inertia(body, model)


def _limit_torques(spec: mujoco.MjSpec, model: mujoco.MjModel) -> None:
    """Give joints without a torque limit that of their actuators."""
    of_joints = model.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT
    for joint in spec.joints:
        which = model.joint(joint.name).id if joint.name else -1
        if which < 0 or model.jnt_actfrclimited[which]:
            continue
        own = np.flatnonzero(of_joints & (model.actuator_trnid[:, 0] == which))
        limit = sum(
            (
                np.sort(model.actuator_gear[a, 0] * _force_range(model, a))
                for a in own.tolist()
            ),
            np.zeros(2),
        )
        if limit.any() and np.isfinite(limit).all():
            joint.actfrcrange = limit
            joint.actfrclimited = mujoco.mjtLimited.mjLIMITED_TRUE


def _force_range(model: mujoco.MjModel, actuator: int) -> np.ndarray:
    """Return the least and largest force of an actuator [N, or N m without gear]."""
    low, high = -np.inf, np.inf
    if model.actuator_forcelimited[actuator]:
        low, high = model.actuator_forcerange[actuator]
    if (
        model.actuator_ctrllimited[actuator]
        and model.actuator_gaintype[actuator] == mujoco.mjtGain.mjGAIN_FIXED
        and model.actuator_biastype[actuator] == mujoco.mjtBias.mjBIAS_NONE
    ):
        # A motor: its control, times a gain, is the force.
        gain = model.actuator_gainprm[actuator, 0]
        least, largest = np.sort(gain * model.actuator_ctrlrange[actuator])
        low, high = max(low, least), min(high, largest)
    return np.array([low, high])


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


def _round_off(spec: mujoco.MjSpec) -> None:
    """Turn each cylinder into a capsule or, if it is flat, into a box."""
    cylinders = [g for g in spec.geoms if g.type == mujoco.mjtGeom.mjGEOM_CYLINDER]
    # Of one between two points, only the compiled model has length and pose.
    ends = [geom for geom in cylinders if not np.isnan(geom.fromto).any()]
    model = spec.compile() if ends else None
    for geom in cylinders:
        size = geom.size if model is None else model.geom_size[geom.id]
        kind, rounded = round_off(float(size[0]), float(size[1]))
        if model is not None and geom in ends:
            pose = model.geom_pos[geom.id], model.geom_quat[geom.id]
            set_shape(geom, type_of(kind), np.array(rounded), *pose)
        else:
            geom.type, geom.size = type_of(kind), rounded


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


def _exclude_overlaps(
    spec: mujoco.MjSpec, robot: RobotConfig, links: Collection[str]
) -> None:
    """Let links not collide with those that they overlap in the default pose.

    Args:
        spec: The robot, of primitives.
        robot: The robot.
        links: Links whose shapes are larger than those of the file.
    """
    if not links:
        return
    model = spec.compile()
    # The file's options are not those of the scene.
    model.opt.disableflags = 0
    data = mujoco.MjData(model)
    for joint, position in zip(robot.joints, robot.default_joint_pos, strict=True):
        data.joint(joint).qpos = position
    mujoco.mj_fwdPosition(model, data)
    pairs = {
        tuple(sorted(body_name(model, model.geom_bodyid[g]) for g in contact.geom))
        for contact in data.contact
    }
    for first, second in sorted(pairs):
        if first in links or second in links:
            spec.add_exclude(bodyname1=first, bodyname2=second)
