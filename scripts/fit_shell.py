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

import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import mujoco
import numpy as np
import trimesh
import tyro
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from trimesh import Trimesh

from egoskin.commands.errors import clear_errors
from egoskin.robots.builtin import H1_2
from egoskin.robots.surface import sample_surface
from egoskin.sensors.skin.mesh_surface import openness

Array = NDArray[np.float64]
Span = tuple[float, float]  # lowest and highest z in the world [m]

# The torso's mesh includes neck and head. Its trunk is a box that ends here [m].
NECK_HEIGHT = 0.485

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


def default_data() -> mujoco.MjData:
    """Return the robot in its default pose, with its kinematics computed."""
    data = mujoco.MjData(H1_2.model)
    data.qpos[7:] = H1_2.default_joint_pos
    mujoco.mj_kinematics(H1_2.model, data)
    return data


def posed_mesh(data: mujoco.MjData, directory: Path, links: Sequence[str]) -> Trimesh:
    """Return the meshes of some links in the pose, in the world [m], as one."""
    meshes = []
    for link in links:
        frame, transform = data.body(link), np.eye(4)
        transform[:3, :3], transform[:3, 3] = frame.xmat.reshape(3, 3), frame.xpos
        mesh = trimesh.load_mesh(mesh_file(directory, link))
        meshes.append(mesh.apply_transform(transform))
    whole = trimesh.util.concatenate(meshes)
    assert isinstance(whole, Trimesh)
    return whole


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
    mesh: Trimesh, robot: Trimesh, span: Span, options: Options
) -> tuple[Array, NDArray[np.bool_]]:
    """Return points of a mesh, uniform [m], and which are outer points of the robot."""
    # Enough for a span with a tenth of the area.
    count, seed = 10 * options.samples, options.seed
    points, faces = trimesh.sample.sample_surface(mesh, count, seed=seed)[:2]
    kept = np.flatnonzero(within(points, span))[: options.samples]
    points, normals = points[kept], mesh.face_normals[faces[kept]]
    return points, openness(robot, points, normals) >= options.min_openness


def measure(options: Options) -> Iterator[Fit]:
    """Yield the fit of each region."""
    model, data = H1_2.model, default_data()
    robot = posed_mesh(data, options.meshes, H1_2.links)
    # The pose is upright, so heights in the torso's frame are heights in the world.
    neck = data.body("torso_link").xpos[2] + NECK_HEIGHT
    spans = {"torso": (-np.inf, neck), "head": (neck, np.inf)}
    for region, links in REGIONS.items():
        span = spans.get(region, (-np.inf, np.inf))
        ours = primitive_points(data, links, span, options)
        mesh = posed_mesh(data, options.meshes, links)
        points, outer = mesh_points(mesh, robot, span, options)
        theirs = points[outer]
        on_links = np.isin(model.geom_bodyid, [model.body(k).id for k in links])
        yield Fit(
            region=region,
            ours_to_mesh=cKDTree(theirs).query(ours)[0],
            mesh_to_ours=cKDTree(ours).query(theirs)[0],
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
