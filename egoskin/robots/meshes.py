"""Primitives around the collision meshes and ellipsoids of a robot.

MuJoCo collides the convex hull of a mesh. A primitive around it is faster, and its
distance to a sensor or ball has a closed form.
"""

from __future__ import annotations

import functools
from collections.abc import Collection
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import mujoco
import numpy as np
from scipy.spatial import ConvexHull, QhullError

from egoskin.robots.config import Primitive
from egoskin.robots.model import body_name, geom_mesh

_MESH = mujoco.mjtGeom.mjGEOM_MESH
_ELLIPSOID = mujoco.mjtGeom.mjGEOM_ELLIPSOID
_QUAT = mujoco.mjtOrientation.mjORIENTATION_QUAT
# Half the least thickness of a primitive [m].
_THINNEST = 5e-4
# Each primitive is larger by this [m]: an MJCF has six digits, and no gap may open
# between two parts of a mesh.
_ROUNDING = 2e-5
# A primitive turned relative to its link, or a second one, must save this share of the
# volume: one along the link's axes is alike on both sides of the robot, and a sole
# stays level; each one costs time in every step.
_SAVING = 0.2
# A mesh is cut at one of the planes between this many slabs.
_SLABS = 12
# Faces from pole to pole of a polyhedron around a sphere, which is 1 % larger.
_LATITUDES = 16
# Attributes of a geom that the parts of a mesh share.
_LIKE = (
    *("contype", "conaffinity", "condim", "priority", "group", "material", "rgba"),
    *("friction", "solmix", "solref", "solimp"),
)


@dataclass(frozen=True, kw_only=True, eq=False)
class MeshFit:
    """Primitives in place of a collision mesh or ellipsoid."""

    primitives: tuple[Primitive, ...]
    """The primitives, on one link."""
    excess: float
    """Their volume relative to that of its convex hull; infinite if flat."""

    @property
    def link(self) -> str:
        """Link that carries them."""
        return self.primitives[0].link


def around_mesh(
    link: str,
    vertices: np.ndarray,
    faces: np.ndarray,
    own_axes: np.ndarray,
    *,
    may_cut: bool = True,
) -> MeshFit:
    """Return one or two primitives around a mesh.

    Each is the smallest sphere, capsule or box around its part of the mesh, along the
    axes of the link or, if that saves more than a fifth of the volume, along those of
    the mesh. The mesh is cut across an axis if that saves more than a fifth, too.

    Args:
        link: Name of the link.
        vertices: Vertices in the link frame [m], ``[n, 3]``.
        faces: Vertices of each triangle, ``[f, 3]``.
        own_axes: Rotation from the mesh's own axes to the link frame, ``[3, 3]``.
        may_cut: Whether there may be two.
    """

    def volume(parts: list[tuple[float, Primitive]]) -> float:
        return sum(part[0] for part in parts)

    best = [_around(link, vertices, own_axes)]
    if may_cut:
        halves = min(
            (
                [
                    _around(link, np.concatenate(half), own_axes)
                    for half in (slabs[:cut], slabs[cut:])
                ]
                for slabs in (_slabs(vertices, faces, axis) for axis in range(3))
                for cut in range(1, _SLABS)
            ),
            key=volume,
        )
        if volume(halves) < (1 - _SAVING) * volume(best):
            best = halves
    try:
        excess = volume(best) / float(ConvexHull(vertices).volume)
    except QhullError:
        excess = np.inf
    return MeshFit(primitives=tuple(part[1] for part in best), excess=excess)


def _slabs(vertices: np.ndarray, faces: np.ndarray, axis: int) -> list[np.ndarray]:
    """Return points whose convex hulls are those of a mesh's slabs along an axis."""
    height = vertices[:, axis]
    cuts = np.linspace(height.min(), height.max(), _SLABS + 1)
    edges = faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    rise = np.diff(height[edges])
    edges = np.where(rise > 0, edges, edges[:, ::-1])[rise[:, 0] != 0]
    low, high = height[edges].T
    start, way = vertices[edges[:, 0]], np.diff(vertices[edges], axis=1)[:, 0]
    on_cut = []
    for cut in cuts:
        across = (low < cut) & (cut < high)
        share = ((cut - low) / (high - low))[across, None]
        on_cut.append(start[across] + share * way[across])
    return [
        _outermost(np.concatenate((vertices[inside], *on_cut[i : i + 2])))
        for i, (low, high) in enumerate(pairwise(cuts))
        for inside in [(low <= height) & (height <= high)]
    ]


def _outermost(points: np.ndarray) -> np.ndarray:
    """Return the vertices of the convex hull of points, or all points if flat."""
    try:
        return points[ConvexHull(points).vertices]
    except (QhullError, ValueError):
        return points


def _around(
    link: str, points: np.ndarray, own_axes: np.ndarray
) -> tuple[float, Primitive]:
    """Return the volume [m^3] of the smallest primitive around points, and it.

    Args:
        link: Name of the link.
        points: Points in the link frame [m], ``[n, 3]``.
        own_axes: Rotation from other axes to the link frame, ``[3, 3]``.
    """
    level = _along(link, points, np.eye(3))
    turned = _along(link, points, own_axes)
    return turned if turned[0] < (1 - _SAVING) * level[0] else level


def _along(link: str, points: np.ndarray, axes: np.ndarray) -> tuple[float, Primitive]:
    """Return the volume [m^3] of the smallest primitive along given axes, and it.

    Args:
        link: Name of the link.
        points: Points in the link frame [m], ``[n, 3]``; the primitive is centred in
            their box.
        axes: Rotation from the axes to the link frame, ``[3, 3]``.
    """
    local = points @ axes
    low, high = local.min(0), local.max(0)
    centre, half = (low + high) / 2, np.maximum((high - low) / 2, _THINNEST)
    half += _ROUNDING
    local -= centre
    shapes = [(8 * half.prod(), "box", half, np.eye(3))]
    for axis in range(3):
        along = np.abs(local[:, axis])
        square = (local**2).sum(1) - along**2
        radius = max(np.sqrt(square.max()), _THINNEST) + _ROUNDING
        # Each point is below the cap at its distance from the axis.
        caps = np.sqrt(np.maximum(radius**2 - square, 0))
        length = max((along - caps).max(), _THINNEST)
        volume = np.pi * radius**2 * (2 * length + 4 / 3 * radius)
        size, turned = [radius, length, 0], np.roll(np.eye(3), 2 - axis, axis=1)
        shapes.append((volume, "capsule", np.array(size), turned))
    radius = max(np.linalg.norm(local, axis=1).max(), _THINNEST) + _ROUNDING
    size = np.array([radius, 0, 0])
    shapes.append((4 / 3 * np.pi * radius**3, "sphere", size, np.eye(3)))
    volume, kind, size, turned = min(shapes, key=lambda each: each[0])
    primitive = Primitive(
        link=link,
        kind=kind,
        size=size,
        position=axes @ centre,
        rotation=axes @ turned,
    )
    return float(volume), primitive


def type_of(kind: str) -> mujoco.mjtGeom:
    """Return MuJoCo's type of a kind of primitive."""
    return getattr(mujoco.mjtGeom, f"mjGEOM_{kind.upper()}")


def set_shape(
    geom: mujoco.MjsGeom,
    type_: mujoco.mjtGeom,
    size: np.ndarray,
    position: np.ndarray,
    quat: np.ndarray,
) -> None:
    """Give a geom a type, MuJoCo's sizes [m] and a pose in the frame of its link."""
    geom.type, geom.size, geom.meshname = type_, size, ""
    geom.pos, geom.quat, geom.alt.type = position, quat, _QUAT
    geom.fromto = np.full(6, np.nan)
    # Else the pose would be relative to a frame of the file.
    geom.set_frame(geom.parent.add_frame())


def _set_primitive(geom: mujoco.MjsGeom, primitive: Primitive) -> None:
    """Give a geom of a link the kind, size and pose of a primitive."""
    quat = np.empty(4)
    mujoco.mju_mat2Quat(quat, primitive.rotation.ravel())
    pose = primitive.position, quat
    set_shape(geom, type_of(primitive.kind), primitive.size, *pose)


def _same_contacts(geom: mujoco.MjsGeom) -> mujoco.MjsGeom:
    """Return a new geom of the same link that collides and looks alike."""
    other = geom.parent.add_geom()
    for name in _LIKE:
        setattr(other, name, getattr(geom, name))
    return other


def fit_meshes(spec: mujoco.MjSpec, in_pairs: Collection[str]) -> list[MeshFit]:
    """Replace the collision meshes and ellipsoids of a robot by primitives around them.

    Args:
        spec: The robot. Primitives that MuJoCo itself fits to meshes get sizes and
            poses of their own.
        in_pairs: Names of geoms that collide whatever their bits.

    Returns:
        The primitives in place of others.
    """
    replaced = (_MESH, _ELLIPSOID)
    fitted = [g for g in spec.geoms if g.meshname and g.type not in replaced]
    meshes = [
        geom
        for geom in spec.geoms
        if geom.type in replaced
        # Floor and scenery are not kept.
        and geom.parent.name != "world"
        and (geom.contype or geom.conaffinity or geom.name in in_pairs)
    ]
    if not fitted and not meshes:
        return []
    # It numbers the geoms, and moves those of meshes.
    model = spec.compile()
    # The pairs of a geom are of its name: a second one would have none.
    fits = [_fit(model, geom.id, may_cut=geom.name not in in_pairs) for geom in meshes]
    for geom in fitted:
        size, position = model.geom_size[geom.id], model.geom_pos[geom.id]
        set_shape(geom, geom.type, size, position, model.geom_quat[geom.id])
    for geom, fit in zip(meshes, fits, strict=True):
        _set_primitive(geom, fit.primitives[0])
        for primitive in fit.primitives[1:]:
            _set_primitive(_same_contacts(geom), primitive)
    return fits


def add_urdf_meshes(spec: mujoco.MjSpec, path: Path) -> tuple[list[MeshFit], list[str]]:
    """Add primitives around the collision meshes of a URDF.

    A mesh is looked for by its path, without ``package://`` and as much of its
    beginning as necessary, from the folder of the URDF and the two above it.

    Args:
        spec: The robot, without its meshes.
        path: Its URDF.

    Returns:
        The primitives, and the links with meshes that are not found or that MuJoCo
        cannot read.
    """
    fits: list[MeshFit] = []
    lost: list[str] = []
    file = mujoco.MjSpec.from_file(str(path))
    for geom in file.geoms:
        link = spec.body(geom.parent.name)
        visual = not geom.contype and not geom.conaffinity
        if geom.type != _MESH or visual or link is None:
            continue
        mesh, alone = file.mesh(geom.meshname), mujoco.MjSpec()
        found = _find(path.resolve().parent, mesh.file, file.meshdir)
        try:
            alone.add_mesh(
                name="mesh",
                file=str(found or ""),
                scale=mesh.scale,
                # The volume of a mesh that is not closed may be 0.
                inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX,
            )
            body = alone.worldbody.add_body(name=link.name)
            body.add_geom(type=_MESH, meshname="mesh", pos=geom.pos, quat=geom.quat)
            fits.append(_fit(alone.compile(), 0))
        except ValueError:
            lost.append(link.name)
            continue
        for primitive in fits[-1].primitives:
            _set_primitive(link.add_geom(), primitive)
    return fits, list(dict.fromkeys(lost))


def _find(folder: Path, file: str, meshdir: str) -> Path | None:
    """Return the file of a mesh, or None."""
    parts = Path(file.partition("://")[2] or file).parts
    for root in (folder / meshdir, folder, folder.parent, folder.parent.parent):
        for first in range(len(parts)):
            if (found := root.joinpath(*parts[first:])).is_file():
                return found
    return None


def _fit(model: mujoco.MjModel, geom: int, *, may_cut: bool = True) -> MeshFit:
    """Return the primitives around a geom that is a mesh or an ellipsoid."""
    if model.geom_type[geom] == _ELLIPSOID:
        unit, faces = _around_unit_sphere()
        vertices = unit * model.geom_size[geom]
    else:
        vertices, faces = geom_mesh(model, geom)
    rotation = np.empty(9)
    mujoco.mju_quat2Mat(rotation, model.geom_quat[geom])
    own_axes = rotation.reshape(3, 3)
    points = vertices.astype(float) @ own_axes.T + model.geom_pos[geom]
    link = body_name(model, int(model.geom_bodyid[geom]))
    return around_mesh(link, points, faces, own_axes, may_cut=may_cut)


@functools.cache
def _around_unit_sphere() -> tuple[np.ndarray, np.ndarray]:
    """Return vertices and faces of a polyhedron that contains the unit sphere."""
    polar = np.linspace(0, np.pi, _LATITUDES + 1)
    azimuth = np.linspace(0, 2 * np.pi, 2 * _LATITUDES, endpoint=False)
    t, f = (each.ravel() for each in np.meshgrid(polar[1:-1], azimuth))
    poles = np.array([[0, 0, 1.0], [0, 0, -1.0]])
    ring = np.stack((np.sin(t) * np.cos(f), np.sin(t) * np.sin(f), np.cos(t)), -1)
    points = np.concatenate((poles, ring))
    hull = ConvexHull(points)
    # The nearest face touches the sphere.
    return points / -hull.equations[:, 3].max(), hull.simplices
