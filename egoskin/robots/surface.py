"""Points on a robot's outer surface, for placing skin and aiming throws.

The outer surface is that of the union of the robot's shapes in its default pose: parts
inside another shape are excluded. The shapes here are the robot's primitives;
`egoskin.sensors.skin.mesh_surface` builds the same surface from meshes.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch

from egoskin.hints import matching
from egoskin.robots.config import Primitive, RobotConfig
from egoskin.robots.kinematics import LinkKinematics
from egoskin.shapes import shape_of

# A sampled point is inside another primitive if it is deeper than this [m].
_INSIDE = 1e-6
# Two surfaces in one place touch flush if the cosine between their normals is below the
# negative of this.
_OPPOSED = 0.99
# Sampling fails if this many rounds find no outer surface.
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
    area: Mapping[str, float]
    """Outer area of each link sampled [m^2], estimated by the share of samples kept."""
    rejected: Mapping[str, float]
    """Share of each link's samples that are not on the outer surface (see `Surface`), 0
    to 1."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Patch:
    """The surface of one shape on a link, whether or not others cover it."""

    link: str
    """Link that carries it."""
    area: float
    """Area [m^2]."""
    sample: Callable[[int, np.random.Generator], tuple[np.ndarray, np.ndarray]]
    """Function of (n, generator): area-uniform points [m] and unit normals, in the
    frame of the link, ``[n, 3]`` each."""


def area(shape: Primitive) -> float:
    """Return the surface area of a primitive [m^2]."""
    a, b, c = shape.size
    if shape.kind == "sphere":
        return float(4 * np.pi * a**2)
    if shape.kind == "capsule":
        return float(4 * np.pi * a * (a + b))
    return float(8 * (a * b + b * c + a * c))


def distance_to(shape: Primitive, points: np.ndarray) -> np.ndarray:
    """Return the signed distance from points to a primitive, negative inside.

    Args:
        shape: The primitive.
        points: Points in the link frame of the primitive [m], ``[n, 3]``.

    Returns:
        Distance [m], ``[n]``.
    """
    local = torch.from_numpy((points - shape.position) @ shape.rotation)
    solid = shape_of(shape.kind, shape.size.tolist())
    return solid.signed_distance(*local.unbind(-1)).numpy()


def _sample_primitive(
    shape: Primitive, n: int, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Return area-uniform (points, normals) in the link frame, ``[n, 3]`` each."""
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


class Surface:
    """The outer surface of some links, made of patches that may be partly covered.

    Args:
        robot: The robot.
        links: Names of the links to sample.
        patches: Patches of the robot; those on other links are not sampled.
        side: Function of points [m] and normals in the base frame, ``[n, 3]``, and a
            stand-off [m]: 1 where both a point and the point at the stand-off along its
            normal are outside all shapes, -1 where that holds for the reversed normal,
            else 0, ``[n]``.

    Raises:
        ValueError: If the robot has no such link, or the links carry no patch.
    """

    def __init__(
        self,
        robot: RobotConfig,
        links: Sequence[str],
        patches: Sequence[Patch],
        side: Callable[[np.ndarray, np.ndarray, float], np.ndarray],
    ) -> None:
        self.links = matching(links, robot.links, "link")
        self.robot = robot
        self._patches = [patch for patch in patches if patch.link in self.links]
        if not self._patches:
            hint = ""
            if robot.is_urdf:
                hint = ": meshes of a URDF are left out; give them as meshes (--meshes)"
            raise ValueError(
                f"the links {', '.join(self.links)} have no collision shape{hint}"
            )
        self._link_index = [robot.links.index(patch.link) for patch in self._patches]
        self.frames = default_frames(robot)
        """Result of `default_frames`."""
        self._side = side

    def sample(
        self,
        n: int,
        seed: int,
        weights: Mapping[str, float] | None = None,
        stand_off: float = 0.0,
    ) -> SurfacePoints:
        """Return random points on the outer surface, uniform by area.

        Args:
            n: Number of points.
            seed: Seed of the sampling.
            weights: Points per area of each link, relative to the others; 1 for links
                not named.
            stand_off: Distance along the normal at which it must also be outside [m].

        Returns:
            Points in random order.

        Raises:
            ValueError: If n is not positive or there is no outer surface.
        """
        if n < 1:
            raise ValueError(f"the number of points must be positive, got {n}")
        weights = weights or {}
        density = np.array([p.area * weights.get(p.link, 1.0) for p in self._patches])
        if not density.any():
            raise ValueError(f"the weights place no sensors on {', '.join(self.links)}")
        rng = np.random.default_rng(seed)
        kept: list[tuple[np.ndarray, ...]] = []
        tried, outer = np.zeros((2, len(self._patches)))
        while outer.sum() < n:
            if len(kept) >= _MAX_ROUNDS and not outer.any():
                raise ValueError(
                    f"the shapes of {', '.join(self.links)} lie inside other shapes "
                    "and have no outer surface"
                )
            counts = rng.multinomial(2 * n, density / density.sum())
            parts = [
                self._sample_patch(i, count, rng, stand_off)
                for i, count in enumerate(counts)
            ]
            tried += counts
            outer += [len(part[0]) for part in parts]
            joined = [np.concatenate(p) for p in zip(*parts, strict=True)]
            order = rng.permutation(len(joined[0]))
            kept.append(tuple(column[order] for column in joined))
        link, position, normal = (
            np.concatenate(p)[:n] for p in zip(*kept, strict=True)
        )
        patch_area = [patch.area for patch in self._patches]
        total, tried, outer = (
            np.bincount(self._link_index, column)
            for column in (patch_area, tried, outer)
        )
        shares = {self.robot.links[i]: outer[i] / tried[i] for i in tried.nonzero()[0]}
        areas = dict(zip(self.robot.links, total, strict=False))
        return SurfacePoints(
            link=link,
            position=position,
            normal=normal,
            area={name: float(areas[name] * share) for name, share in shares.items()},
            rejected={name: float(1 - share) for name, share in shares.items()},
        )

    def _sample_patch(
        self, index: int, n: int, rng: np.random.Generator, stand_off: float
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return (link, position, normal) of those of n points on the outer surface."""
        points, normals = self._patches[index].sample(n, rng)
        shift, turn = (a[self._link_index[index]] for a in self.frames)
        side = self._side(points @ turn.T + shift, normals @ turn.T, stand_off)
        outer = side != 0
        link = np.full(outer.sum(), self._link_index[index])
        return link, points[outer], (side[:, None] * normals)[outer]


def default_frames(robot: RobotConfig) -> tuple[np.ndarray, np.ndarray]:
    """Return the links' frames in the base frame, in the default pose.

    Args:
        robot: The robot.

    Returns:
        Positions [m] ``[L, 3]`` and rotations ``[L, 3, 3]``, in the order of
        ``RobotConfig.links``.
    """
    pose = torch.from_numpy(robot.default_joint_pos)[None]
    position, rotation = LinkKinematics(robot.chain, robot.links).poses_b(pose)
    return position[0].numpy(), rotation[0].numpy()


def points_b(
    frames: tuple[np.ndarray, np.ndarray], link: np.ndarray, position: np.ndarray
) -> np.ndarray:
    """Return points of links in the base frame, in the default pose.

    Args:
        frames: Result of `default_frames`.
        link: Indices of the links in ``RobotConfig.links``, ``[n]``.
        position: Positions in the frames of the links [m], ``[n, 3]``.

    Returns:
        Positions [m], ``[n, 3]``.
    """
    shift, turn = frames
    return (turn[link] @ position[..., None])[..., 0] + shift[link]


def primitive_patch(shape: Primitive) -> Patch:
    """Return the surface of a primitive."""
    return Patch(
        link=shape.link, area=area(shape), sample=partial(_sample_primitive, shape)
    )


def outside_primitives(
    robot: RobotConfig, shapes: Sequence[Primitive]
) -> Callable[[np.ndarray, np.ndarray, float], np.ndarray]:
    """Return a test whether points are outside primitives, in the default pose.

    Args:
        robot: The robot.
        shapes: Primitives of the robot.

    Returns:
        The ``side`` of `Surface`: 1 outside all of the shapes, else 0. What another
        shape touches flush is not outside.
    """
    shift, turn = default_frames(robot)
    frames = [robot.links.index(shape.link) for shape in shapes]
    centres = [
        shift[i] + turn[i] @ shape.position
        for shape, i in zip(shapes, frames, strict=True)
    ]

    def side(points: np.ndarray, normals: np.ndarray, stand_off: float) -> np.ndarray:
        outside = np.ones(len(points))
        for height in {0.0, stand_off}:
            at = points + height * normals
            for shape, i, centre in zip(shapes, frames, centres, strict=True):
                # No shape reaches farther from its centre than the sum of its sizes.
                away = at - centre
                reach = shape.size.sum()
                near = np.flatnonzero(np.einsum("ij,ij->i", away, away) < reach**2)
                local = (at[near] - shift[i]) @ turn[i]
                distance = distance_to(shape, local)
                outside[near] *= distance > -_INSIDE
                # A shape that touches flush, from outside, covers the point, too.
                here = np.abs(distance) <= _INSIDE
                if height or not here.any():
                    continue
                above = local[here] + _INSIDE * normals[near[here]] @ turn[i]
                rise = distance_to(shape, above) - distance[here]
                outside[near[here]] *= rise > -_OPPOSED * _INSIDE
        return outside

    return side


def primitive_surface(robot: RobotConfig, links: Sequence[str]) -> Surface:
    """Return the outer surface of the primitives of some links.

    Args:
        robot: The robot.
        links: Names of the links.

    Raises:
        ValueError: If the robot has no such link, the links have no primitives, or any
            link of the robot has a collision shape that is not a primitive.
    """
    patches = [primitive_patch(shape) for shape in robot.primitives]
    return Surface(robot, links, patches, outside_primitives(robot, robot.primitives))


def sample_surface(
    robot: RobotConfig, links: Sequence[str], n: int, seed: int
) -> SurfacePoints:
    """Return random points on the outer surface of primitives, uniform by area.

    Args:
        robot: The robot.
        links: Names of the links to sample.
        n: Number of points.
        seed: Seed of the sampling.

    Returns:
        Points in random order.

    Raises:
        ValueError: If n is not positive, the robot has no such link, or the links have
            no outer surface.
    """
    return primitive_surface(robot, links).sample(n, seed)
