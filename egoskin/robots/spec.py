"""MuJoCo specifications of robots.

Contract: what a model file says about masses acts on the robot alone, also after balls
and a floor are added to its specification.
"""

from __future__ import annotations

import re
from pathlib import Path

import mujoco
import numpy as np

from egoskin.robots.model import body_id, body_name, joint_name
from egoskin.storage.files import read_regular

# Settings of MuJoCo's compiler that change the masses of all bodies of a model.
_MASS_SETTINGS = (
    *("settotalmass", "inertiafromgeom", "inertiagrouprange"),
    *("boundmass", "boundinertia"),
)
# Lower bound of masses and inertias in a URDF [kg, kg m^2]; every ball is above it.
_LEAST = 1e-6


def load_spec(source: Path | str, what: str) -> mujoco.MjSpec:
    """Return the editable specification of a robot.

    Links on fixed joints are kept. In a URDF, meshes are left out, and masses may be.
    Unnamed bodies and joints get the names that the robot's chain uses.

    Args:
        source: Path of an MJCF or URDF, or an MJCF as text.
        what: What is loaded, for the error text.

    Raises:
        ValueError: If MuJoCo cannot read the model.
        OSError: If there is no such file.
    """
    urdf = isinstance(source, Path) and is_urdf(source)
    try:
        if isinstance(source, Path):
            spec = mujoco.MjSpec.from_file(str(source))
        else:
            spec = mujoco.MjSpec.from_string(source)
        # Else the links on fixed joints would be merged with those that carry them.
        spec.compiler.fusestatic = False
        if urdf:
            _prepare_urdf(spec)
        _name_all(spec)
        _fix_masses(spec)
    except ValueError as error:
        raise _unreadable(what, error) from error
    return spec


def compile_robot(spec: mujoco.MjSpec, what: str) -> mujoco.MjModel:
    """Return the compiled model of a specification.

    Args:
        spec: Specification of the robot.
        what: What is compiled, for the error text.

    Raises:
        ValueError: If MuJoCo refuses the model.
    """
    try:
        return spec.compile()
    except ValueError as error:
        raise _unreadable(what, error) from error


def is_urdf(path: Path) -> bool:
    """Return whether a file is a URDF, by its root element.

    Raises:
        OSError: If there is no such file.
    """
    content = re.sub(rb"<!--.*?-->", b"", read_regular(path), flags=re.DOTALL)
    tag = re.search(rb"<([A-Za-z][\w:.-]*)", content)
    return tag is not None and tag[1] == b"robot"


def set_inertia(body: mujoco.MjsBody, model: mujoco.MjModel) -> None:
    """Set the inertia of a body to that of the compiled model."""
    which = body_id(model, body.name)
    body.mass = model.body_mass[which]
    body.ipos, body.iquat = model.body_ipos[which], model.body_iquat[which]
    body.inertia = model.body_inertia[which]
    body.fullinertia = np.full(6, np.nan)
    body.explicitinertial = True


def _unreadable(what: str, error: ValueError) -> ValueError:
    """Return the error for a model that MuJoCo cannot read, on one line."""
    text = " ".join(str(error).split())
    return ValueError(f"MuJoCo cannot load {what} as a robot: {text}")


def _prepare_urdf(spec: mujoco.MjSpec) -> None:
    """Leave out meshes, and permit links without mass."""
    meshes = [g for g in spec.geoms if g.type == mujoco.mjtGeom.mjGEOM_MESH]
    for element in (*meshes, *spec.meshes):
        spec.delete(element)
    # A URDF may leave out masses, but MuJoCo requires them for moving bodies.
    spec.compiler.boundmass = spec.compiler.boundinertia = _LEAST
    spec.compiler.balanceinertia = True


def _name_all(spec: mujoco.MjSpec) -> None:
    """Give unnamed bodies and joints the names that the robot's chain uses."""
    bodies = [body for body in spec.bodies if not body.name]
    joints = [
        joint
        for joint in spec.joints
        if not joint.name and joint.type != mujoco.mjtJoint.mjJNT_FREE
    ]
    if bodies or joints:
        model = spec.compile()
        for body in bodies:
            body.name = body_name(model, body.id)
        for joint in joints:
            joint.name = joint_name(model, joint.id)


def _fix_masses(spec: mujoco.MjSpec) -> None:
    """Replace settings that would also change the masses of balls by their effect."""
    own, plain = spec.compiler, mujoco.MjSpec().compiler
    values, usual = (
        np.hstack([np.asarray(getattr(each, name), float) for name in _MASS_SETTINGS])
        for each in (own, plain)
    )
    if np.abs(values - usual).max() <= _LEAST:
        return
    model = spec.compile()
    for body in spec.bodies:
        if body.name != "world":
            set_inertia(body, model)
    for name in _MASS_SETTINGS:
        setattr(own, name, getattr(plain, name))
