"""Measure how well the H1-2's collision primitives fit the official meshes.

Skin sits on the outside of the robot, so the outer surfaces are compared, in the
default pose. A point of a mesh is *outer* if at least ``min_openness`` of the
cosine-weighted rays over its outward hemisphere leave the robot without hitting any
mesh: 0.15 rejects the floor of a round pit deeper than 1.2 diameters. Points of the
primitives are those that skin is placed on (`egoskin.robots.surface`). Distances are
between nearest outer points of a region, in both directions. Surfaces are sampled, so
distances are too high, never too low: a perfect fit gives half the point spacing.

    python scripts/fit_shell.py --meshes DIR

``DIR`` holds the STL files of Unitree's H1-2, one for each link, named ``<link>.STL``.
"""

from __future__ import annotations

from egoskin.interrupts import end_quietly

if __name__ == "__main__":
    end_quietly()

# isort: split

import math
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import mujoco
import numpy as np
import trimesh
import tyro
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from egoskin.commands.errors import clear_errors
from egoskin.robots.config import H1_2
from egoskin.robots.surface import sample_surface

Array = NDArray[np.float64]
Scene = tuple[mujoco.MjModel, mujoco.MjData]
Span = tuple[float, float]  # lowest and highest z in the world [m]

# The torso's mesh includes neck and head. Its trunk is a box that ends here [m].
NECK_HEIGHT = 0.485

# Distance between the start of a ray and the face that it leaves [m].
CLEARANCE = 1e-4

# Number of rays over the hemisphere of each mesh point.
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
    """Compare the H1-2's collision primitives with its meshes."""

    meshes: Path
    """Directory of the official meshes, ``<link>.STL``."""
    samples: int = 8000
    """Points sampled on the meshes of a region; primitives get more."""
    min_openness: float = 0.15
    """Share of the rays that must escape for a mesh point to be outer, 0 to 1."""
    limit_mm: float = 15.0
    """Largest accepted mean distance of a region, over both directions [mm]."""
    seed: int = 0
    """Seed of the sampled points."""


class Fit(NamedTuple):
    """Distances between nearest points of a region's outer surfaces [m]."""

    region: str
    ours_to_mesh: Array  # of each outer point of the primitives, [N]
    mesh_to_ours: Array  # of each outer point of the meshes, [M]
    inner_share: float  # of the mesh points that are not outer, 0 to 1
    num_primitives: int  # whose centre is in the region


def mesh_file(directory: Path, link: str) -> Path:
    """Return the path of a link's mesh; both wrist yaw links share one file.

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


def default_pose() -> Scene:
    """Return the robot in its default pose, with its kinematics computed."""
    model = H1_2.model
    data = mujoco.MjData(model)
    data.qpos[7:] = H1_2.default_joint_pos
    mujoco.mj_kinematics(model, data)
    return model, data


def mesh_scene(data: mujoco.MjData, meshes: Path) -> Scene:
    """Return a static scene of the links' meshes in the pose, for ray casts."""
    spec = mujoco.MjSpec()
    for link in H1_2.links:
        mesh = spec.add_mesh(name=link, file=str(mesh_file(meshes, link).resolve()))
        # A shell has an inertia even if its surface is not closed.
        mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
        geom = spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=link)
        geom.pos, geom.quat = data.body(link).xpos, data.body(link).xquat
        geom.contype = geom.conaffinity = 0  # saves computing convex hulls
    scene = spec.compile()
    scene_data = mujoco.MjData(scene)
    mujoco.mj_forward(scene, scene_data)
    return scene, scene_data


def openness(scene: Scene, points: Array, normals: Array) -> Array:
    """Return the share of cosine-weighted outward rays that hit no mesh, ``[N]``.

    Points on the meshes [m] and unit normals there are ``[N, 3]``, world frame.
    """
    # Evenly spread over the unit sphere along a golden-angle spiral.
    k = np.arange(RAYS) + 0.5
    z, angle = 1.0 - 2.0 * k / RAYS, k * math.pi * (3.0 - math.sqrt(5.0))
    ring = np.sqrt(1.0 - z**2)
    sphere = np.stack([ring * np.cos(angle), ring * np.sin(angle), z], axis=-1)
    share = np.empty(len(points))
    geom, distance = np.empty(RAYS, dtype=np.int32), np.empty(RAYS)
    for i, (point, normal) in enumerate(zip(points, normals, strict=True)):
        # Lambert: normal + uniform unit vector gives a cosine-weighted direction.
        ray = normal + sphere
        ray /= np.linalg.norm(ray, axis=1, keepdims=True)
        start = point + CLEARANCE * normal
        mujoco.mj_multiRay(
            *scene, start, ray.ravel(), None, 1, -1, geom, distance, None, RAYS, 10.0
        )
        share[i] = np.mean(geom < 0)
    return share


def within(points: Array, span: Span) -> NDArray[np.bool_]:
    """Return whether the heights of points lie in a span, ``[N]``."""
    return (points[:, 2] >= span[0]) & (points[:, 2] < span[1])


def primitive_points(
    data: mujoco.MjData, links: list[str], span: Span, options: Options
) -> Array:
    """Return outer points of the links' primitives, uniform, world [m], ``[N, 3]``."""
    # Many points are cheap, because no rays are cast.
    surface = sample_surface(H1_2, links, 20 * options.samples, options.seed)
    frames = [data.body(link) for link in H1_2.links]
    turn = np.stack([frame.xmat.reshape(3, 3) for frame in frames])[surface.link]
    shift = np.stack([frame.xpos for frame in frames])[surface.link]
    points = (turn @ surface.position[..., None])[..., 0] + shift
    return points[within(points, span)]


def mesh_points(
    data: mujoco.MjData, scene: Scene, links: list[str], span: Span, options: Options
) -> tuple[Array, NDArray[np.bool_]]:
    """Return points of the links' meshes, uniform, world [m], and which are outer."""
    meshes = []
    for link in links:
        frame, transform = data.body(link), np.eye(4)
        transform[:3, :3], transform[:3, 3] = frame.xmat.reshape(3, 3), frame.xpos
        mesh = trimesh.load_mesh(mesh_file(options.meshes, link))
        meshes.append(mesh.apply_transform(transform))
    mesh = trimesh.util.concatenate(meshes)
    # Enough for a span with a tenth of the area.
    count, seed = 10 * options.samples, options.seed
    points, faces = trimesh.sample.sample_surface(mesh, count, seed=seed)[:2]
    kept = np.flatnonzero(within(points, span))[: options.samples]
    points, normals = points[kept], mesh.face_normals[faces[kept]]
    return points, openness(scene, points, normals) >= options.min_openness


def measure(options: Options) -> Iterator[Fit]:
    """Yield the fit of each region."""
    model, data = default_pose()
    scene = mesh_scene(data, options.meshes)
    # The pose is upright, so heights in the torso's frame are heights in the world.
    neck = data.body("torso_link").xpos[2] + NECK_HEIGHT
    spans = {"torso": (-np.inf, neck), "head": (neck, np.inf)}
    for region, links in REGIONS.items():
        span = spans.get(region, (-np.inf, np.inf))
        ours = primitive_points(data, links, span, options)
        points, outer = mesh_points(data, scene, links, span, options)
        mesh = points[outer]
        on_links = np.isin(model.geom_bodyid, [model.body(k).id for k in links])
        yield Fit(
            region=region,
            ours_to_mesh=cKDTree(mesh).query(ours)[0],
            mesh_to_ours=cKDTree(ours).query(mesh)[0],
            inner_share=1.0 - float(outer.mean()),
            num_primitives=int((on_links & within(data.geom_xpos, span)).sum()),
        )


def main(options: Options) -> int:
    """Print the table of fits; return 0, 1 (poor fit) or 2 (error)."""
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
    with clear_errors():
        sys.exit(main(tyro.cli(Options, description=__doc__)))
