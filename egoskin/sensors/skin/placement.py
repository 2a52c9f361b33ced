"""Placement of sensors on a robot.

Contract: sensors lie on the outer surface of the robot in its default pose, their
normals point outward, and the same arguments give the same skin.
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Mapping, Sequence
from typing import Literal

import numpy as np

from egoskin.hints import matching
from egoskin.robots.config import RobotConfig, resolve
from egoskin.robots.surface import points_b, primitive_surface
from egoskin.sensors.skin.mesh_surface import Meshes, mesh_surface
from egoskin.sensors.skin.skin import FARTHEST, Skin

# Candidates per sensor for sample elimination (Yuksel 2015, section 4).
_CANDIDATES = 5
# Darts thrown per square of the spacing. A full cover has 0.70 sensors per square, and
# then less than 1 % of the surface is farther than the spacing from a sensor.
_DARTS_PER_SQUARE = 40
# Largest number of darts to find as many sensors as fit: some minutes on meshes. For a
# given number of sensors more are thrown, in batches of this size.
_MAX_DARTS = 2_000_000
# The candidates of more sensors would not fit in memory.
MAX_SENSORS = _MAX_DARTS // _CANDIDATES
# Bounds of the spacing [m]: the squares of some numbers beyond are 0 or overflow.
_FINEST, _COARSEST = 1e-9, 1e9
# Points to estimate the outer area and the rejected shares.
_AREA_POINTS = 4000


# Points whose neighbours are looked up at once.
_CHUNK = 4096
# The search for neighbours goes a little farther; distances are compared after it.
_MARGIN = 1 + 1e-9


def throw_darts(points: np.ndarray, radius: np.ndarray, most: int) -> np.ndarray:
    """Return a subset of points whose discs are disjoint (dart throwing).

    Each point in turn is taken unless its disc overlaps that of one taken before.

    Args:
        points: Points in random order [m], ``[n, 3]``.
        radius: Radius of the disc around each point, half of its spacing [m], ``[n]``.
        most: Largest number of points to take.

    Returns:
        Indices of the points taken, in order.
    """
    from scipy.spatial import cKDTree  # Its import takes long.

    tree, reach = cKDTree(points), 2 * radius.max() * _MARGIN
    free = np.ones(len(points), dtype=bool)
    taken: list[int] = []
    for i in range(len(points)):
        if len(taken) == most:
            break
        if not free[i]:
            continue
        taken.append(i)
        near = tree.query_ball_point(points[i], reach)
        distance = np.linalg.norm(points[near] - points[i], axis=-1)
        free[near] &= distance >= radius[near] + radius[i]
    return np.array(taken)


def eliminate(
    points: np.ndarray, scale: np.ndarray, count: int, area: float
) -> np.ndarray:
    """Return an evenly spread subset of points (sample elimination).

    The most crowded points are removed one by one.

    Args:
        points: Points in random order [m], ``[n, 3]``.
        scale: Relative spacing around each point, ``[n]``.
        count: Number of points to keep, at most n.
        area: Area that the points cover, each part divided by its squared scale [m^2].

    Returns:
        Indices of the points kept, ascending, ``[count]``.

    Source: Yuksel, "Sample Elimination for Generating Poisson Disk Sample Sets",
        Computer Graphics Forum 34(2), 2015.
    """
    # Largest spacing of count discs in the plane: r_max^2 = A / (2 sqrt(3) N).
    widest = 2 * math.sqrt(area / (2 * math.sqrt(3) * count))
    # r_min = r_max (1 - (N / M)^gamma) beta with gamma = 1.5 and beta = 0.65.
    closest = widest * (1 - (count / len(points)) ** 1.5) * 0.65
    kept = _eliminated(points, scale, count, widest, closest)
    # Pairs closer than r_min count as if they were at r_min, which is below the spacing
    # that is reached on a plane. On thin links it need not be: discs overlap across
    # them, and such pairs would be left.
    reached = least_spacing(points[kept], scale[kept])
    if reached < closest:
        others = _eliminated(points, scale, count, widest, 0.0)
        if least_spacing(points[others], scale[others]) > reached:
            return others
    return kept


def least_spacing(points: np.ndarray, scale: np.ndarray) -> float:
    """Return the smallest distance of two points relative to their scale [m].

    Args:
        points: Points [m], ``[n, 3]``.
        scale: Relative spacing around each point, ``[n]``.

    Returns:
        The distance, infinite for a single point.
    """
    from scipy.spatial import cKDTree  # Its import takes long.

    if len(points) < 2:
        return math.inf
    tree = cKDTree(points)
    nearest, at = tree.query(points, k=2)
    # The closest pair is not farther relative to its scale than this one.
    reach = float((nearest[:, 1] * 2 / (scale + scale[at[:, 1]])).min()) * scale.max()
    one, other = tree.query_pairs(reach * _MARGIN, output_type="ndarray").T
    distance = np.linalg.norm(points[one] - points[other], axis=-1)
    return float((distance * 2 / (scale[one] + scale[other])).min())


def _eliminated(
    points: np.ndarray, scale: np.ndarray, count: int, widest: float, closest: float
) -> np.ndarray:
    """Return the points kept, as in `eliminate`.

    Args:
        points: As there.
        scale: As there.
        count: As there.
        widest: Distance from which on two points do not crowd each other [m].
        closest: Distance below which all crowd each other alike [m].
    """
    from scipy.spatial import cKDTree  # Its import takes long.

    total = np.zeros(len(points))
    tree, reach = cKDTree(points), widest * scale.max() * _MARGIN
    neighbours: list[np.ndarray] = []
    crowding: list[np.ndarray] = []
    for first in range(0, len(points), _CHUNK):
        found = tree.query_ball_point(points[first : first + _CHUNK], reach)
        which = np.repeat(np.arange(len(found)), [len(each) for each in found])
        near, point = np.concatenate(found), first + which
        distance = np.linalg.norm(points[near] - points[point], axis=-1)
        distance = distance * 2 / (scale[near] + scale[point])
        close = distance < widest
        which, near, distance = which[close], near[close], distance[close]
        # w_ij = (1 - d_ij / (2 r_max))^alpha with alpha = 8.
        weight = (1 - distance.clip(closest, widest) / widest) ** 8
        # In sequence: another order of summation would change the rounding.
        np.add.at(total, near, weight)
        ends = np.searchsorted(which, np.arange(1, len(found)))
        neighbours += np.split(near.astype(np.int32), ends)
        crowding += np.split(weight, ends)

    # Mutual neighbours tie. Rounded, so that machine-dependent rounding errors do not
    # decide.
    heap = [(-value, i) for i, value in enumerate(total.round(12).tolist())]
    heapq.heapify(heap)
    for _ in range(len(points) - count):
        # Totals only decrease, so an outdated heap entry is too close to the front.
        while -heap[0][0] > (value := float(total[heap[0][1]].round(12))):
            heapq.heapreplace(heap, (-value, heap[0][1]))
        _, worst = heapq.heappop(heap)
        total[neighbours[worst]] -= crowding[worst]
        total[worst] = -np.inf
    return np.flatnonzero(total > -np.inf)


def _link_weights(
    links: Sequence[str], density: Mapping[str, float]
) -> dict[str, float]:
    """Return the weight of each link from weights by shell pattern; 1 without a match.

    Raises:
        ValueError: If a weight is negative or not finite, a pattern matches no link, or
            a link matches several.
    """
    for pattern, weight in density.items():
        if not 0 <= weight < math.inf:
            raise ValueError(
                f"density: the weight of {pattern!r} must be finite and not negative, "
                f"got {weight}"
            )
    weights = resolve(density, tuple(links), "density", 1.0)
    return dict(zip(links, weights, strict=True))


def _num_darts(area: float, spacing: float, num_sensors: int | None) -> int:
    """Return the number of darts to fill an area [m^2] or to find ``num_sensors``.

    Raises:
        ValueError: If there are too many.
    """
    darts = math.ceil(_DARTS_PER_SQUARE * area / spacing**2)
    if num_sensors is not None:
        # Where 100 per sensor are fewer, less than 0.4 sensors per square are wanted,
        # and 0.7 fit.
        return min(darts, 100 * num_sensors)
    if darts > _MAX_DARTS:
        finest = math.sqrt(_DARTS_PER_SQUARE * area / _MAX_DARTS)
        raise ValueError(
            f"a spacing of {spacing:g} m allows too many sensors to find them all: "
            f"use at least {finest:.2g} m on these links, or give num_sensors"
        )
    return darts


def _check(
    num_sensors: int | None,
    seed: int,
    method: str,
    spacing: float | None,
    stand_off: float,
) -> None:
    """Raise ValueError for arguments that are invalid or contradict each other."""
    if method not in ("area_uniform", "poisson_disk"):
        raise ValueError(
            f"method must be 'area_uniform' or 'poisson_disk', got {method!r}"
        )
    if spacing is not None and (method != "poisson_disk" or not 0 < spacing < math.inf):
        raise ValueError(
            "spacing must be positive and needs method='poisson_disk', got "
            f"{spacing} with {method!r}"
        )
    if spacing is not None and not _FINEST <= spacing <= _COARSEST:
        raise ValueError(
            f"spacing must be from {_FINEST:g} to {_COARSEST:g} m, got {spacing}"
        )
    if num_sensors is None and spacing is None:
        raise ValueError("num_sensors=None needs a spacing")
    if num_sensors is not None and num_sensors < 1:
        raise ValueError(f"the number of sensors must be positive, got {num_sensors}")
    if num_sensors is not None and num_sensors > MAX_SENSORS:
        raise ValueError(
            f"the number of sensors must be at most {MAX_SENSORS:,}, got {num_sensors}"
        )
    if seed < 0:
        raise ValueError(f"the seed of a placement must not be negative, got {seed}")
    if not 0 <= stand_off < math.inf:
        raise ValueError(f"stand_off must be finite and not negative, got {stand_off}")


def _check_metres(
    robot: RobotConfig, link: np.ndarray, position: np.ndarray, meshes: Meshes
) -> None:
    """Raise ValueError if a sensor is implausibly far from its link's origin."""
    away = np.linalg.norm(position, axis=-1)
    if away.max() > FARTHEST:
        name = robot.links[link[away.argmax()]]
        hint = f": are the meshes of {name} in metres?" if name in meshes else ""
        raise ValueError(
            f"a sensor would be {away.max():.3g} m from the origin of {name}, farther "
            f"than the limit of {FARTHEST:g} m{hint}"
        )


def place_sensors(
    robot: RobotConfig,
    num_sensors: int | None = 64,
    seed: int = 0,
    *,
    method: Literal["area_uniform", "poisson_disk"] = "area_uniform",
    links: Sequence[str] | None = None,
    density: Mapping[str, float] | None = None,
    spacing: float | None = None,
    stand_off: float = 0.0,
    meshes: Meshes | None = None,
) -> Skin:
    """Return a skin of sensors placed on the outer surface of a robot.

    ``area_uniform`` places every sensor independently at random. ``poisson_disk`` keeps
    them apart: by ``spacing`` if given, else as far as possible (sample elimination).
    Distances are straight-line distances in the default pose.

    Args:
        robot: The robot.
        num_sensors: Number of sensors ``S``; None takes as many as fit at the spacing.
        seed: Seed of the placement.
        method: Placement method.
        links: Links to cover, by name or shell pattern; the robot's ``skin_links``
            (upper body) by default.
        density: Relative number of sensors per area by link or shell pattern
            (``*_wrist_*``); 1 for links not named, 0 for no sensors.
        spacing: Minimum distance between sensors [m] (``poisson_disk``). A link of
            density w has spacing / sqrt(w); between two links the mean applies.
        stand_off: Distance of the sensors from the surface along the normal [m].
        meshes: Meshes to use instead of the robot's primitives, by link
            (`mesh_surface`); links without meshes use their primitives.

    Returns:
        Sensors with z along the outward normal. The provenance holds the arguments and
        the share of each link's samples that were not on the outer surface.

    Raises:
        ValueError: If an argument is out of range, the robot lacks a link or pattern,
            the links have no outer surface, a link without meshes has a collision shape
            that is not a primitive, or the sensors do not fit.
    """
    if not isinstance(robot, RobotConfig):
        raise ValueError(
            "robot must be a RobotConfig (read_robot for a file), got "
            f"{type(robot).__name__}"
        )
    _check(num_sensors, seed, method, spacing, stand_off)
    covered = robot.skin_links
    if links is not None:
        covered = matching(links, robot.links, "link")
    if not covered:
        raise ValueError("place_sensors needs at least one link to cover")
    weights = _link_weights(covered, density or {})
    if not meshes:
        surface = primitive_surface(robot, covered)
    else:
        surface = mesh_surface(robot, covered, meshes)

    measured = surface.sample(_AREA_POINTS, seed, weights, stand_off)
    # As the spacing is proportional to 1 / sqrt(w), areas are weighted by w.
    area = sum(weights[link] * size for link, size in measured.area.items())
    if spacing is not None:
        number = _num_darts(area, spacing, num_sensors)
        wanted = number if num_sensors is None else num_sensors
    else:
        assert num_sensors is not None
        number = num_sensors * (_CANDIDATES if method == "poisson_disk" else 1)
        wanted = num_sensors

    link, position, normal = np.empty(0, int), np.empty((0, 3)), np.empty((0, 3))
    for first in range(0, number, _MAX_DARTS):
        if first and len(link) == wanted:
            break
        points = surface.sample(
            min(_MAX_DARTS, number - first),
            # A different random stream for each batch, whatever the seed.
            seed + (first << 64),
            weights,
            stand_off,
        )
        # Skin files have six decimals: a saved and loaded skin is identical.
        at = (points.position + stand_off * points.normal).round(6)
        _check_metres(robot, points.link, at, meshes or {})
        link = np.concatenate((link, points.link))
        position = np.concatenate((position, at))
        normal = np.concatenate((normal, points.normal.round(6)))
        if method == "poisson_disk":
            places = points_b(surface.frames, link, position)
            scale = np.array([weights[robot.links[i]] for i in link]) ** -0.5
            if spacing is None:
                chosen = eliminate(places, scale, wanted, area)
            else:
                # Points taken before come first and are therefore taken again.
                chosen = throw_darts(places, scale * spacing / 2, wanted)
            link, position, normal = link[chosen], position[chosen], normal[chosen]
    if num_sensors is not None and len(link) < num_sensors:
        raise ValueError(
            f"only {len(link)} sensors fit at a spacing of {spacing:g} m, not "
            f"{num_sensors}: lower the spacing or num_sensors, or cover more links"
        )
    return Skin(
        robot=robot.name,
        links=tuple(robot.links[i] for i in link),
        position=position,
        normal=normal,
        provenance={
            "method": method,
            "num_sensors": num_sensors,
            "seed": seed,
            "links": list(covered),
            "density": dict(density or {}),
            "spacing": spacing,
            "stand_off": stand_off,
            "rejected": {k: round(share, 4) for k, share in measured.rejected.items()},
            "meshes": {
                link: [mesh.metadata.get("name", "unnamed") for mesh in on_link]
                for link, on_link in (meshes or {}).items()
            },
        },
    )
