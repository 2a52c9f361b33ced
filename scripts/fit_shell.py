"""How well the H1-2's primitive collision shell fits the official meshes.

Skin sits on the outside of the robot, so outsides are compared, in the default pose.
A point of a mesh is *outer* if at least ``min_openness`` of the cosine-weighted rays
over its outward hemisphere leave the robot without meeting any mesh: 0.15 rejects the
floor of a round pit deeper than 1.2 diameters. A point of a primitive is outer if no
other primitive of the robot contains it. Distances run between the outer points of
one region, nearest to nearest, both ways. Points stand for surfaces, so a figure is
too high, never too low: a perfect fit gives half the spacing of the points.

    python scripts/fit_shell.py --meshes DIR

``DIR`` holds the STL files of Unitree's H1-2, one for each link, named ``<link>.STL``.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import mujoco
import numpy as np
import trimesh
import tyro
from mujoco import mjtGeom as Kind
from numpy.typing import NDArray
from scipy.spatial import cKDTree

Array = NDArray[np.float64]
Scene = tuple[mujoco.MjModel, mujoco.MjData]
Span = tuple[float, float]  # lowest and highest z in the world [m]
Frame = Any  # a body or geom view of MjData: has xpos [3] and xmat [9]

MODEL = Path(__file__).parents[1] / "egoskin" / "assets" / "h1_2.xml"

# Unitree's default pose [rad]; every other joint is at 0.
POSE = {
    "hip_pitch": -0.16,
    "knee": 0.36,
    "ankle_pitch": -0.2,
    "shoulder_pitch": 0.4,
    "elbow": 0.3,
}

# The torso's mesh carries neck and head. Its trunk is a box that ends here [m].
NECK_HEIGHT = 0.485

# Closer than this is the same surface: it keeps rays off the face they leave [m].
TOUCH = 1e-4

# Rays over the hemisphere of each mesh point.
RAYS = 48

UPPER_ARM = ("shoulder_pitch_link", "shoulder_roll_link", "shoulder_yaw_link")
LOWER_ARM = ("elbow_link", "wrist_roll_link", "wrist_pitch_link", "wrist_yaw_link")
REGIONS = {"torso": ["torso_link"], "head": ["torso_link"]} | {
    f"{arm} {side}": [f"{side}_{link}" for link in links]
    for arm, links in (("upper arm", UPPER_ARM), ("lower arm", LOWER_ARM))
    for side in ("left", "right")
}


@dataclass(frozen=True, kw_only=True)
class Options:
    """What to compare, and how finely."""

    meshes: Path
    """Directory of the official meshes, ``<link>.STL``."""
    model: Path = MODEL
    """The robot's MJCF, with primitive shapes."""
    samples: int = 8000
    """Points drawn on the meshes of a region; primitives, which are cheap, get more."""
    min_openness: float = 0.15
    """Share of the rays that must escape for a mesh point to be outer, 0 to 1."""
    limit_mm: float = 15.0
    """Largest accepted mean distance of a region, over both directions [mm]."""
    seed: int = 0
    """Seed of the points drawn."""


class Fit(NamedTuple):
    """Distances between the two outsides of one region, nearest to nearest [m]."""

    region: str
    ours_to_mesh: Array  # of each outer point of the primitives, [N]
    mesh_to_ours: Array  # of each outer point of the meshes, [M]
    inner_share: float  # of the mesh points that are not outer, 0 to 1
    num_primitives: int  # that show in the region


def mesh_file(directory: Path, link: str) -> Path:
    """Path of a link's mesh; left and right share the one of the wrist's last link.

    Raises:
        FileNotFoundError: If the directory or the file does not exist.
    """
    if not directory.is_dir():
        raise FileNotFoundError(f"no such mesh directory: {directory}")
    stem = "wrist_yaw_link" if link.endswith("wrist_yaw_link") else link
    path = directory / f"{stem}.STL"
    if not path.is_file():
        raise FileNotFoundError(f"mesh of {link} is missing: expected {path}")
    return path


def default_pose(model: mujoco.MjModel) -> mujoco.MjData:
    """Data of the robot in its default pose, kinematics computed."""
    data = mujoco.MjData(model)
    for joint, angle in POSE.items():
        for side in ("left", "right"):
            data.joint(f"{side}_{joint}_joint").qpos[:] = angle
    mujoco.mj_kinematics(model, data)
    return data


def place(mesh: trimesh.Trimesh, frame: Frame) -> trimesh.Trimesh:
    """The mesh, moved in place from a body's or geom's frame into the world's."""
    transform = np.eye(4)
    transform[:3, :3], transform[:3, 3] = frame.xmat.reshape(3, 3), frame.xpos
    return mesh.apply_transform(transform)


def mesh_scene(model: mujoco.MjModel, data: mujoco.MjData, meshes: Path) -> Scene:
    """A static scene of every link's mesh where the pose puts it, for ray casts."""
    spec = mujoco.MjSpec()
    for body in range(1, model.nbody):
        link = model.body(body).name
        mesh = spec.add_mesh(name=link, file=str(mesh_file(meshes, link).resolve()))
        # A shell has an inertia even where its surface is not closed.
        mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
        geom = spec.worldbody.add_geom(type=Kind.mjGEOM_MESH, meshname=link)
        geom.pos, geom.quat = data.xpos[body], data.xquat[body]
        geom.contype = geom.conaffinity = 0  # spares the convex hulls
    scene = spec.compile()
    scene_data = mujoco.MjData(scene)
    mujoco.mj_forward(scene, scene_data)
    return scene, scene_data


def openness(scene: Scene, points: Array, normals: Array) -> Array:
    """Share of the cosine-weighted outward rays that meet no mesh, ``[N]``.

    Points on the meshes [m] and unit normals there are ``[N, 3]``, world frame.
    """
    # Even spread over the unit sphere along a golden-angle spiral.
    k = np.arange(RAYS) + 0.5
    z, angle = 1.0 - 2.0 * k / RAYS, k * math.pi * (3.0 - math.sqrt(5.0))
    ring = np.sqrt(1.0 - z**2)
    sphere = np.stack([ring * np.cos(angle), ring * np.sin(angle), z], axis=-1)
    share = np.empty(len(points))
    geom, distance = np.empty(RAYS, dtype=np.int32), np.empty(RAYS)
    for i, (point, normal) in enumerate(zip(points, normals, strict=True)):
        # Lambert: normal + uniform unit vector points along a cosine-weighted ray.
        ray = normal + sphere
        ray /= np.linalg.norm(ray, axis=1, keepdims=True)
        start = point + TOUCH * normal
        mujoco.mj_multiRay(
            *scene, start, ray.ravel(), None, 1, -1, geom, distance, None, RAYS, 10.0
        )
        share[i] = np.mean(geom < 0)
    return share


def primitive_mesh(kind: int, size: Array) -> trimesh.Trimesh:
    """Fine triangle mesh of a sphere, capsule or box about its own origin.

    Raises:
        ValueError: If the geom type is another one.
    """
    if kind == Kind.mjGEOM_SPHERE:
        return trimesh.creation.icosphere(subdivisions=4, radius=size[0])
    if kind == Kind.mjGEOM_CAPSULE:
        mesh = trimesh.creation.capsule(2 * size[1], size[0], count=[64, 64])
        return mesh.apply_translation(-mesh.bounds.mean(axis=0))
    if kind == Kind.mjGEOM_BOX:
        return trimesh.creation.box(2 * size)
    raise ValueError(f"expected spheres, capsules and boxes, got {Kind(kind).name}")


def contains(kind: int, size: Array, points: Array) -> NDArray[np.bool_]:
    """Whether a sphere, capsule or box about the origin holds the points, ``[N]``."""
    if kind == Kind.mjGEOM_BOX:
        return np.all(np.abs(points) < size - TOUCH, axis=1)
    half = size[1] if kind == Kind.mjGEOM_CAPSULE else 0.0
    # Distance to the capsule's core segment, which runs along z.
    z = points[:, 2] - np.clip(points[:, 2], -half, half)
    return np.hypot(np.hypot(points[:, 0], points[:, 1]), z) < size[0] - TOUCH


def draw(mesh: trimesh.Trimesh, span: Span, count: int, seed: int) -> tuple:
    """Points even by area (``[count, 3]``) in a span of heights, and their faces."""
    # Enough for a span that holds a tenth of the area.
    points, faces = trimesh.sample.sample_surface(mesh, 10 * count, seed=seed)
    within = np.flatnonzero((points[:, 2] >= span[0]) & (points[:, 2] < span[1]))
    return points[within[:count]], faces[within[:count]]


def primitive_points(
    robot: Scene, links: list[str], span: Span, options: Options
) -> tuple[Array, NDArray[np.int64]]:
    """Outer points (world [m], ``[N, 3]``) of the links' primitives and their geoms."""
    model, data = robot
    kind, size = model.geom_type, model.geom_size
    bodies = [model.body(link).id for link in links]
    geoms = np.flatnonzero(np.isin(model.geom_bodyid, bodies))
    meshes = [place(primitive_mesh(kind[g], size[g]), data.geom(g)) for g in geoms]
    mesh = trimesh.util.concatenate(meshes)
    points, faces = draw(mesh, span, 5 * options.samples, options.seed)
    owner = np.repeat(geoms, [len(mesh.faces) for mesh in meshes])[faces]
    outer = np.ones(len(points), dtype=bool)
    for g in range(model.ngeom):
        local = (points - data.geom_xpos[g]) @ data.geom_xmat[g].reshape(3, 3)
        outer &= ~contains(kind[g], size[g], local) | (owner == g)
    return points[outer], owner[outer]


def mesh_points(
    robot: Scene, scene: Scene, links: list[str], span: Span, options: Options
) -> tuple[Array, NDArray[np.bool_]]:
    """Points (world [m], ``[N, 3]``) of the links' meshes, and which are outer."""
    files = {link: mesh_file(options.meshes, link) for link in links}
    meshes = [place(trimesh.load_mesh(f), robot[1].body(k)) for k, f in files.items()]
    mesh = trimesh.util.concatenate(meshes)
    # Not the primitives' seed: equal draws on equal surfaces would hide the spacing.
    points, faces = draw(mesh, span, options.samples, options.seed + 1)
    share = openness(scene, points, mesh.face_normals[faces])
    return points, share >= options.min_openness


def measure(options: Options) -> Iterator[Fit]:
    """Yields the fit of each region; raises as its parts do."""
    model = mujoco.MjModel.from_xml_path(str(options.model))
    data = default_pose(model)
    scene = mesh_scene(model, data, options.meshes)
    # The pose is upright, so heights in the torso's frame are heights in the world.
    neck = data.body("torso_link").xpos[2] + NECK_HEIGHT
    spans = {"torso": (-np.inf, neck), "head": (neck, np.inf)}
    for region, links in REGIONS.items():
        span = spans.get(region, (-np.inf, np.inf))
        ours, owner = primitive_points((model, data), links, span, options)
        points, outer = mesh_points((model, data), scene, links, span, options)
        mesh = points[outer]
        yield Fit(
            region=region,
            ours_to_mesh=cKDTree(mesh).query(ours)[0],
            mesh_to_ours=cKDTree(ours).query(mesh)[0],
            inner_share=1.0 - float(outer.mean()),
            num_primitives=len(np.unique(owner)),
        )


def main(options: Options) -> int:
    """Prints the table of fits; exit status 0, 1 (poor fit) or 2 (error)."""
    print("[mm]             ours->mesh    mesh->ours      both ways  inner  primi-")
    print("region           mean    p95   mean    p95   mean    p95  share  tives")
    worst = 0.0
    try:
        for fit in measure(options):
            ways = 1e3 * fit.ours_to_mesh, 1e3 * fit.mesh_to_ours
            rows = np.array([(d.mean(), np.percentile(d, 95)) for d in ways])
            both = rows.mean(axis=0)
            cells = "".join(f"{x:7.1f}" for x in (*rows.ravel(), *both))
            share = f"{fit.inner_share:7.0%}{fit.num_primitives:7d}"
            print(f"{fit.region:15s}{cells}{share}", flush=True)
            worst = max(worst, both[0])
    except (FileNotFoundError, ValueError) as error:
        print("fit_shell:", " ".join(str(error).split()), file=sys.stderr)
        return 2
    if worst > options.limit_mm:
        message = f"a mean of {worst:.1f} mm is over the {options.limit_mm:g} mm limit"
        print("fit_shell:", message, file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Options, description=__doc__)))
