"""Shapes and poses of a robot, for drawing and for picking with a click."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import mujoco
import numpy as np
import trimesh

from egoskin.robots.config import RobotConfig
from egoskin.robots.model import body_name, geom_mesh, joint_name
from egoskin.sensors import Skin
from egoskin.shapes import Shape

# Geom groups below this are drawn, as by default in MuJoCo's viewer; groups from 3 on
# hold collision geoms.
_SHOWN_GROUPS = 3
_SEGMENTS = 24
# Half the size of a link in the bounds of a robot, if it has no shape there [m].
_LINK_SIZE = 0.05
_GREY = (0.5, 0.5, 0.5, 1.0)
"""MuJoCo's default colour of a geom."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Part:
    """Shapes of one colour on one link."""

    body: int
    """Index of the link's body in the model."""
    vertices: np.ndarray
    """Vertices in the frame of the body [m], ``[V, 3]``."""
    faces: np.ndarray
    """Indices of vertices, ``[F, 3]``."""
    rgba: tuple[float, float, float, float]
    """Colour and opacity."""


class Body:
    """A robot that can be put into poses.

    Args:
        robot: The robot; its base may be fixed.

    Raises:
        ValueError: If the robot's model has no bodies.
    """

    def __init__(self, robot: RobotConfig) -> None:
        self.robot, self.model = robot, robot.model
        self.data = mujoco.MjData(self.model)
        model = self.model
        if model.nbody == 1:
            raise ValueError(f"the model of {robot.name} has no bodies to show")
        self._bodies = {body_name(model, i): i for i in range(1, model.nbody)}
        joints = {joint_name(model, i): i for i in range(model.njnt)}
        self._joint = model.jnt_qposadr[[joints[name] for name in robot.joints]]
        self.floats = robot.floats
        """Whether its base is free to move."""
        self.place(self.standing(robot.default_joint_pos))

    def standing(self, joint_pos: np.ndarray) -> np.ndarray:
        """Return base pose and joint positions, ``[7 + J]``, standing on the floor.

        Args:
            joint_pos: Joint positions [rad], [m] for slide joints, ``[J]``.
        """
        base = np.array([0.0, 0, 0, 1, 0, 0, 0])
        if self.floats:
            base[2] = self.robot.base_height(joint_pos)
        return np.concatenate((base, joint_pos))

    def place(self, qpos: np.ndarray) -> None:
        """Put the robot into a pose.

        Args:
            qpos: Base pose (ignored if the base is fixed) and joint positions,
                ``[7 + J]``.
        """
        if self.floats:
            self.data.qpos[:7] = qpos[:7]
        self.data.qpos[self._joint] = qpos[7:]
        mujoco.mj_kinematics(self.model, self.data)

    def sensor_points(self, skin: Skin) -> np.ndarray:
        """Return the positions of sensors in the world [m], ``[S, 3]``."""
        return (
            self._turned(skin, skin.position) + self.data.xpos[self.link_indices(skin)]
        )

    def sensor_normals(self, skin: Skin) -> np.ndarray:
        """Return the normals of sensors in the world, ``[S, 3]``."""
        return self._turned(skin, skin.normal)

    def link_indices(self, skin: Skin) -> list[int]:
        """Return the index of the body that each of the ``S`` sensors is on."""
        return [self._bodies[name] for name in skin.links]

    def _turned(self, skin: Skin, vectors: np.ndarray) -> np.ndarray:
        rotation = self.data.xmat[self.link_indices(skin)].reshape(-1, 3, 3)
        return (rotation @ vectors[:, :, None])[..., 0]

    def bounds(self) -> np.ndarray:
        """Return a box in the world that contains all shapes of the robot [m].

        It also contains the origins of the links: meshes of a URDF are left out, and
        there may be no other shapes.

        Returns:
            Lower and upper corner, ``[2, 3]``; the box may be slightly too large.
        """
        shown = self.model.geom_type != mujoco.mjtGeom.mjGEOM_PLANE
        links = self.data.xpos[1:]
        centre = np.concatenate((self.data.geom_xpos[shown], links))
        reach = np.append(self.model.geom_rbound[shown], [_LINK_SIZE] * len(links))
        reach = reach[:, None]
        return np.stack(((centre - reach).min(0), (centre + reach).max(0)))

    def hit(self, origin: np.ndarray, direction: np.ndarray) -> float:
        """Return the distance along a ray to the robot [m]; infinite if it misses.

        Args:
            origin: Start of the ray in the world [m], ``[3]``.
            direction: Its direction, of length 1, ``[3]``.
        """
        geom = np.zeros(1, np.int32)
        away = mujoco.mj_ray(
            self.model, self.data, origin, direction, None, 1, -1, geom
        )
        return math.inf if away < 0 else away

    def parts(self) -> list[Part]:
        """Return the robot's shapes, merged by link and colour."""
        merged: dict[tuple[int, tuple], list[trimesh.Trimesh]] = {}
        for body, rgba, mesh in self._shapes():
            merged.setdefault((body, rgba), []).append(mesh)
        found = []
        for (body, rgba), meshes in merged.items():
            whole = trimesh.util.concatenate(meshes)
            found.append(
                Part(
                    body=body,
                    vertices=np.asarray(whole.vertices),
                    faces=np.asarray(whole.faces),
                    rgba=rgba,
                )
            )
        return found

    def _shapes(self) -> Iterator[tuple[int, tuple, trimesh.Trimesh]]:
        """Yield body, colour and mesh (in the body's frame) of each drawn geom."""
        model = self.model
        groups = model.geom_group
        shown = groups < _SHOWN_GROUPS
        if not shown.any():
            shown = ~shown
        for geom in np.flatnonzero(shown):
            mesh = _mesh(model, int(geom))
            rgba, material = model.geom_rgba[geom], model.geom_matid[geom]
            if material >= 0 and tuple(rgba) == _GREY:
                rgba = model.mat_rgba[material]
            if mesh is None or rgba[3] == 0:
                continue
            place = np.eye(4)
            rotation = np.zeros(9)
            mujoco.mju_quat2Mat(rotation, model.geom_quat[geom])
            place[:3, :3], place[:3, 3] = rotation.reshape(3, 3), model.geom_pos[geom]
            mesh.apply_transform(place)
            yield int(model.geom_bodyid[geom]), tuple(map(float, rgba)), mesh


def mesh_of(shape: Shape) -> trimesh.Trimesh:
    """Return the mesh of an object, in its own frame."""
    spec = mujoco.MjSpec()
    shape.add_geom(spec.worldbody)
    mesh = _mesh(spec.compile(), 0)
    assert mesh is not None
    return mesh


def _mesh(model: mujoco.MjModel, geom: int) -> trimesh.Trimesh | None:
    """Return a geom's mesh in its own frame; None for a plane or unsupported type."""
    kinds, make = mujoco.mjtGeom, trimesh.creation
    kind, size = model.geom_type[geom], model.geom_size[geom]
    if kind == kinds.mjGEOM_SPHERE:
        return make.icosphere(subdivisions=3, radius=size[0])
    if kind == kinds.mjGEOM_CAPSULE:
        mesh = make.capsule(2 * size[1], size[0], count=[_SEGMENTS, _SEGMENTS])
        mesh.apply_translation(-mesh.bounds.mean(0))
        return mesh
    if kind == kinds.mjGEOM_ELLIPSOID:
        mesh = make.icosphere(subdivisions=3)
        mesh.apply_scale(size)
        return mesh
    if kind == kinds.mjGEOM_CYLINDER:
        mesh = make.cylinder(size[0], 2 * size[1], sections=_SEGMENTS)
    elif kind == kinds.mjGEOM_BOX:
        mesh = make.box(2 * size)
    elif kind == kinds.mjGEOM_MESH:
        mesh = trimesh.Trimesh(*geom_mesh(model, geom), process=False)
    else:
        return None
    # Edges are shaded sharp if faces share no vertices.
    mesh.unmerge_vertices()
    return mesh
