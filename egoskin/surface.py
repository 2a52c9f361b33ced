"""Points on a robot's outer surface: where skin sits and where throws are aimed.

The outer surface is that of the union of the robot's primitives in its default pose:
what lies inside another primitive belongs to no surface.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from egoskin.kinematics import LinkKinematics
from egoskin.robots import Primitive, RobotConfig

# A sampled point is inside another primitive if it is deeper than this [m].
_INSIDE = 1e-6
# Rounds of sampling that must find some outer surface.
_MAX_ROUNDS = 1000


@dataclass(frozen=True, kw_only=True, eq=False)
class SurfacePoints:
    """Points on links, with outward normals, in the frames of the links."""

    link: np.ndarray
    """Index of each point's link in ``RobotConfig.links``, ``[n]``."""
    position: np.ndarray
    """Positions [m], ``[n, 3]``."""
    normal: np.ndarray
    """Unit outward normals, ``[n, 3]``."""


def area(shape: Primitive) -> float:
    """Surface area of a primitive [m^2]."""
    a, b, c = shape.size
    if shape.kind == "sphere":
        return float(4 * np.pi * a**2)
    if shape.kind == "capsule":
        return float(4 * np.pi * a * (a + b))
    return float(8 * (a * b + b * c + a * c))


def distance_to(shape: Primitive, points: np.ndarray) -> np.ndarray:
    """Signed distance from points to a primitive, negative inside.

    Args:
        shape: The primitive.
        points: Points in the link frame of the primitive [m], ``[n, 3]``.

    Returns:
        Distance [m], ``[n]``.
    """
    local = (points - shape.position) @ shape.rotation
    if shape.kind == "box":
        q = np.abs(local) - shape.size
        return np.linalg.norm(np.maximum(q, 0), axis=-1) + np.minimum(q.max(-1), 0)
    if shape.kind == "capsule":
        half = shape.size[1]
        local[:, 2] -= np.clip(local[:, 2], -half, half)
    return np.linalg.norm(local, axis=-1) - shape.size[0]


def _sample_primitive(
    shape: Primitive, n: int, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Area-uniform (points, normals) in the link frame, ``[n, 3]`` each."""
    if shape.kind == "box":
        size = shape.size
        face_area = np.array([size[1] * size[2], size[0] * size[2], size[0] * size[1]])
        axis = rng.choice(3, n, p=face_area / face_area.sum())
        local = rng.uniform(-1, 1, (n, 3))
        normal = np.zeros((n, 3))
        sign = rng.choice([-1.0, 1.0], n)
        local[np.arange(n), axis] = normal[np.arange(n), axis] = sign
        local *= size
    else:
        normal = rng.normal(size=(n, 3))
        normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
        radius = shape.size[0]
        half = shape.size[1] if shape.kind == "capsule" else 0.0
        local = normal * radius
        local[:, 2] += np.sign(normal[:, 2]) * half
        # Archimedes: cap and side have areas in proportion radius : half length.
        side = rng.uniform(size=n) < half / (half + radius)
        flat = normal[side] * [1, 1, 0]
        flat /= np.linalg.norm(flat, axis=-1, keepdims=True)
        normal[side] = flat
        local[side] = flat * radius
        local[side, 2] = rng.uniform(-half, half, side.sum())
    return local @ shape.rotation.T + shape.position, normal @ shape.rotation.T


def sample_surface(
    robot: RobotConfig, links: Sequence[str], n: int, seed: int
) -> SurfacePoints:
    """Return points spread uniformly by area over the outer surface of some links.

    Args:
        robot: The robot.
        links: Names of the links to sample.
        n: Number of points.
        seed: Seed of the sampling.

    Returns:
        Points in random order.

    Raises:
        ValueError: If n is not positive, a link is not the robot's, or the links
            have no outer surface.
    """
    if n < 1:
        raise ValueError(f"the number of points must be positive, got {n}")
    unknown = [name for name in links if name not in robot.links]
    if unknown:
        raise ValueError(
            f"{robot.name} has no link {unknown[0]!r}; its links are "
            f"{', '.join(robot.links)}"
        )
    shapes = [s for s in robot.primitives if s.link in links]
    if not shapes:
        raise ValueError(f"the links {', '.join(links)} carry no collision shape")
    pose = torch.from_numpy(robot.default_joint_pos)[None]
    position, rotation = LinkKinematics(robot.chain, robot.links).poses_b(pose)
    frames = {
        name: (rotation[0, i].numpy(), position[0, i].numpy())
        for i, name in enumerate(robot.links)
    }
    rng = np.random.default_rng(seed)
    weight = np.array([area(s) for s in shapes])
    kept: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
    found = 0
    while found < n:
        if len(kept) >= _MAX_ROUNDS and found == 0:
            raise ValueError(
                f"the shapes of {', '.join(links)} lie inside others: they have no "
                "outer surface"
            )
        counts = rng.multinomial(2 * n, weight / weight.sum())
        parts = []
        for shape, count in zip(shapes, counts, strict=True):
            points, normals = _sample_primitive(shape, count, rng)
            turn, shift = frames[shape.link]
            base = points @ turn.T + shift
            outside = np.ones(count, dtype=bool)
            for other in robot.primitives:
                if other is not shape:
                    other_turn, other_shift = frames[other.link]
                    local = (base - other_shift) @ other_turn
                    outside &= distance_to(other, local) > -_INSIDE
            link = np.full(count, robot.links.index(shape.link))
            parts.append((link[outside], points[outside], normals[outside]))
        link, points, normals = (np.concatenate(p) for p in zip(*parts, strict=True))
        order = rng.permutation(len(link))
        kept.append((link[order], points[order], normals[order]))
        found += len(link)
    link, points, normals = (np.concatenate(p)[:n] for p in zip(*kept, strict=True))
    return SurfacePoints(link=link, position=points, normal=normals)
