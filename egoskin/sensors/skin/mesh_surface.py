"""The outer surface of a robot's meshes, to place skins on the real covers.

Meshes are `trimesh.Trimesh` objects in the frames of their links [m], by link: load,
scale and pose them with trimesh, or use `meshes_in_folder` and `meshes_of_mjcf`.
Meshes of real parts have many inner faces, so a point counts as outer only if enough
of the robot's surroundings is visible from it in the default pose.

trimesh and embreex are optional dependencies: ``pip install 'egoskin[design]'``.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from egoskin.robots.config import RobotConfig
from egoskin.robots.model import body_name, geom_mesh
from egoskin.robots.surface import (
    Patch,
    Surface,
    default_frames,
    outside_primitives,
    primitive_patch,
)
from egoskin.storage.files import check_regular

if TYPE_CHECKING:
    from trimesh import Trimesh

Meshes = Mapping[str, Sequence["Trimesh"]]
"""Meshes by link, in the frames of the links [m]."""

# Largest mesh file [bytes].
_LARGEST = 2**30
# Rays over the hemisphere of each point, and the share of them that must hit nothing:
# 0.15 rejects the bottom of a round hole deeper than 1.2 diameters.
_NUM_RAYS = 48
_MIN_OPENNESS = 0.15
# Distance of the start of a ray from its face [m].
_CLEARANCE = 1e-4
# Points whose rays are cast at once.
_CHUNK = 4096


def _trimesh() -> ModuleType:
    """Return the module trimesh, which casts rays with embreex.

    Raises:
        ImportError: If either is not installed; the text says how to install them.
    """
    try:
        # Without embreex, trimesh casts rays in Python: hours, and all of the memory.
        import embreex  # noqa: F401
        import trimesh
    except ImportError as error:
        raise ImportError(
            "meshes need trimesh and embreex (which has no wheel for Linux on ARM): "
            "pip install 'egoskin[design]'"
        ) from error
    return trimesh


def meshes_in_folder(folder: Path, links: Sequence[str]) -> dict[str, list[Trimesh]]:
    """Return the meshes of a folder whose files are named after links.

    Args:
        folder: Folder of files such as ``torso_link.STL``, each in the frame of its
            link, in metres; files with other names are ignored.
        links: Names of the links, usually ``RobotConfig.links``.

    Returns:
        Meshes by link; links without a file are missing.

    Raises:
        FileNotFoundError: If the folder is missing or no file is named after a link.
        ValueError: If two files are named after one link, or one cannot be read.
    """
    trimesh = _trimesh()
    formats = {f".{name}" for name in trimesh.available_formats()}
    meshes: dict[str, list[Trimesh]] = {}
    for path in sorted(Path(folder).iterdir()):
        if path.stem in links and path.suffix.lower() in formats:
            if path.stem in meshes:
                raise ValueError(
                    f"{folder} contains two meshes of {path.stem}: "
                    f"{meshes[path.stem][0].metadata['name']} and {path.name}"
                )
            check_regular(path, _LARGEST)
            try:
                mesh = trimesh.load_mesh(path)
            except Exception as error:  # of any kind, for a damaged file
                raise ValueError(
                    f"trimesh cannot read {path} as a mesh: {error}"
                ) from error
            if len(mesh.faces) == 0:
                raise ValueError(f"{path} contains no triangles")
            mesh.metadata["name"] = path.name
            meshes[path.stem] = [mesh]
    if not meshes:
        raise FileNotFoundError(
            f"no mesh in {folder} is named after a link, such as {links[0]}.STL"
        )
    return meshes


def meshes_of_mjcf(path: Path, group: int | None = None) -> dict[str, list[Trimesh]]:
    """Return the mesh geoms of a MuJoCo model, by body.

    Args:
        path: MJCF file.
        group: Take only geoms of this group (visual geoms usually have their own); None
            takes all. Duplicates are dropped.

    Returns:
        Meshes in the frames of the bodies [m], scaled and posed as in the model.

    Raises:
        ValueError: If MuJoCo cannot load the file, or no geom is a mesh.
    """
    trimesh = _trimesh()
    check_regular(path)
    try:
        spec = mujoco.MjSpec.from_file(str(path))
        # As `load_spec` does: the bodies are those of the robot.
        spec.compiler.fusestatic = False
        model = spec.compile()
    except ValueError as error:
        text = " ".join(str(error).split())
        raise ValueError(f"MuJoCo cannot load {path}: {text}") from error
    meshes: dict[str, list[Trimesh]] = {}
    seen = set()
    is_mesh = model.geom_type == mujoco.mjtGeom.mjGEOM_MESH
    for geom in map(int, np.flatnonzero(is_mesh)):
        asset, body = model.geom_dataid[geom], model.geom_bodyid[geom]
        position, quat = model.geom_pos[geom], model.geom_quat[geom]
        placed = (asset, body, *position, *quat)
        if placed in seen or group not in (None, model.geom_group[geom]):
            continue
        seen.add(placed)
        turn = np.empty(9)
        mujoco.mju_quat2Mat(turn, quat)
        vertices, faces = geom_mesh(model, geom)
        mesh = trimesh.Trimesh(
            vertices @ turn.reshape(3, 3).T + position,
            faces,
            metadata={"name": _asset_name(model, asset)},
        )
        meshes.setdefault(body_name(model, body), []).append(mesh)
    if not meshes:
        where = "" if group is None else f" in group {group}"
        raise ValueError(f"{path} has no mesh geoms{where}")
    return meshes


def _asset_name(model: mujoco.MjModel, mesh: int) -> str:
    """File name of a mesh asset, or its asset name if it has no file."""
    start = model.mesh_pathadr[mesh]
    if start < 0:
        return model.mesh(mesh).name
    return Path(model.paths[start:].split(b"\0")[0].decode()).name


def triangle_patch(link: str, triangles: np.ndarray) -> Patch:
    """Return the surface of triangles on a link.

    Args:
        link: Name of the link.
        triangles: Corners in the frame of the link [m], ``[F, 3, 3]``; normals follow
            the right-hand rule.

    Raises:
        ValueError: If the triangles have no area.
    """
    origin, along, across = (
        triangles[:, 0],
        triangles[:, 1] - triangles[:, 0],
        triangles[:, 2] - triangles[:, 0],
    )
    cross = np.cross(along, across)
    double_area = np.linalg.norm(cross, axis=-1)
    if not double_area.any():
        raise ValueError(f"the meshes of {link} have no area")

    def sample(n: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        face = rng.choice(len(triangles), n, p=double_area / double_area.sum())
        # Points of the parallelogram beyond the diagonal are mirrored at its centre.
        u, v = rng.random((2, n, 1))
        u, v = np.where(u + v > 1, (1 - u, 1 - v), (u, v))
        points = origin[face] + u * along[face] + v * across[face]
        return points, cross[face] / double_area[face, None]

    return Patch(link=link, area=float(double_area.sum() / 2), sample=sample)


def openness(mesh: Trimesh, points: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Return the share of a mesh's surroundings that is visible from points on it.

    Args:
        mesh: The mesh that blocks the view.
        points: Points in the frame of the mesh [m], ``[n, 3]``.
        normals: Unit normals there, ``[n, 3]``.

    Returns:
        Share of the cosine-weighted rays over the hemisphere of the normal that hit no
        face, 0 to 1, ``[n]``.
    """
    _trimesh()
    # Points evenly spread over the unit sphere along a golden-angle spiral.
    k = np.arange(_NUM_RAYS) + 0.5
    z, angle = 1.0 - 2.0 * k / _NUM_RAYS, k * math.pi * (3.0 - math.sqrt(5.0))
    ring = np.sqrt(1.0 - z**2)
    sphere = np.stack([ring * np.cos(angle), ring * np.sin(angle), z], axis=-1)
    share = np.empty(len(points))
    for first in range(0, len(points), _CHUNK):
        chunk = slice(first, first + _CHUNK)
        # Lambert: normal + uniform unit vector points along a cosine-weighted ray.
        rays = normals[chunk, None] + sphere
        start = (points[chunk] + _CLEARANCE * normals[chunk])[:, None]
        start = np.broadcast_to(start, rays.shape)
        hit = mesh.ray.intersects_any(start.reshape(-1, 3), rays.reshape(-1, 3))
        share[chunk] = 1.0 - hit.reshape(-1, _NUM_RAYS).mean(-1)
    return share


def mesh_surface(robot: RobotConfig, links: Sequence[str], meshes: Meshes) -> Surface:
    """Return the outer surface of the meshes of some links, in the default pose.

    A link without meshes keeps its primitives. A point of a mesh or primitive is outer
    if it is inside no such primitive and at least 15 % of the cosine-weighted rays over
    the hemisphere of its normal hit no mesh of the robot. The normal is that of the
    side with more visibility, whatever the winding of the face.

    Args:
        robot: The robot.
        links: Names of the links to sample.
        meshes: Meshes of the robot; those of links not sampled still block the view.

    Raises:
        ValueError: If the robot lacks a mesh's link or a sampled link, the links carry
            no shape, or a link without meshes has a collision shape that is not a
            primitive.
    """
    for link, on_link in meshes.items():
        if not on_link:
            raise ValueError(f"meshes: empty list for {link!r}; remove the entry")
        if link not in robot.links:
            raise ValueError(
                f"{robot.name} has no link {link!r} for a mesh; its links are "
                f"{', '.join(robot.links)}"
            )
    frames = {
        link: (turn, shift)
        for link, shift, turn in zip(robot.links, *default_frames(robot), strict=True)
    }
    corners = {
        link: np.concatenate([np.asarray(m.vertices)[m.faces] for m in on_link])
        for link, on_link in meshes.items()
    }
    base = np.concatenate(
        [c @ frames[k][0].T + frames[k][1] for k, c in corners.items()]
    )
    faces = np.arange(base.size // 3).reshape(-1, 3)
    whole = _trimesh().Trimesh(base.reshape(-1, 3), faces, process=False)
    rest = robot.primitives_on([link for link in robot.links if link not in meshes])
    outside = outside_primitives(robot, rest)

    def sees(points: np.ndarray, normals: np.ndarray, stand_off: float) -> np.ndarray:
        share = openness(whole, points, normals)
        if stand_off:
            at = points + stand_off * normals
            share = np.minimum(share, openness(whole, at, normals))
        return share * outside(points, normals, stand_off)

    def side(points: np.ndarray, normals: np.ndarray, stand_off: float) -> np.ndarray:
        front = sees(points, normals, stand_off)
        back = sees(points, -normals, stand_off)
        outer = np.maximum(front, back) >= _MIN_OPENNESS
        return outer * np.where(front >= back, 1.0, -1.0)

    patches = [triangle_patch(link, triangles) for link, triangles in corners.items()]
    return Surface(robot, links, patches + [primitive_patch(s) for s in rest], side)
