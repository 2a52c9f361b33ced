"""How a skin fits its robot in the default pose: what an edited file may get wrong."""

from __future__ import annotations

import numpy as np

from egoskin.progress import counted
from egoskin.robots.config import RobotConfig
from egoskin.robots.surface import default_frames, distance_to, points_b
from egoskin.sensors.skin.skin import Skin

FAR_OFF = 0.15
"""Sensors farther than this from the surface of their link are told [m]."""
# Sensors deeper than this in a shape of another link are told [m].
_DEEP = 1e-3
# Sensors closer to each other than this are told [m].
_CLOSE = 1e-3
# Shapes that are farther than the nearest by less than this meet it in a corner [m].
_CORNER = 0.02
# A step along the normal, which must lead away from the surface [m].
_STEP = 1e-3


def fit_notes(skin: Skin, robot: RobotConfig) -> list[str]:
    """Return what is unusual about the places of sensors, a line each.

    Links with shapes other than primitives are left out.

    Args:
        skin: The skin; its links are those of the robot.
        robot: The robot.
    """
    at = np.array([robot.links.index(link) for link in skin.links])
    shift, turn = frames = default_frames(robot)
    position = points_b(frames, at, skin.position)
    # Distance from the surface of the link, and each shape's with that after a step.
    own = np.full(len(skin), np.inf)
    shapes: list[tuple[np.ndarray, ...]] = []
    inside = np.zeros(len(skin), dtype=bool)
    for shape in robot.known_primitives:
        link = robot.links.index(shape.link)
        mine, others = np.flatnonzero(at == link), np.flatnonzero(at != link)
        distance = distance_to(shape, skin.position[mine])
        above = distance_to(shape, skin.position[mine] + _STEP * skin.normal[mine])
        shapes.append((mine, distance, above))
        own[mine] = np.minimum(own[mine], abs(distance))
        local = (position[others] - shift[link]) @ turn[link]
        inside[others] |= distance_to(shape, local) < -_DEEP
    # In a corner the normal leads away from one of the shapes nearby.
    inward = np.isfinite(own)
    for mine, distance, above in shapes:
        near = abs(distance) < own[mine] + _CORNER
        inward[mine] &= ~(near & (above >= distance))
    far = np.isfinite(own) & (own > FAR_OFF)
    found = [
        (far, f"farther than {FAR_OFF:g} m from the surface of their links"),
        (inward & ~far, "with a normal that points into their links"),
        (inside, "inside a shape of another link"),
        (_close(position), f"less than {1e3 * _CLOSE:g} mm from another one"),
    ]
    return [
        f"{counted(int(which.sum()), 'sensor')} {what}: {_some(which)}"
        for which, what in found
        if which.any()
    ]


def _close(position: np.ndarray) -> np.ndarray:
    """Return which points are close to another one, ``[n]`` bool."""
    from scipy.spatial import cKDTree  # Its import takes long.

    pairs = cKDTree(position).query_pairs(_CLOSE, output_type="ndarray")
    close = np.zeros(len(position), dtype=bool)
    close[pairs.reshape(-1)] = True
    return close


def _some(which: np.ndarray) -> str:
    """Return the first of some indices as text."""
    indices = np.flatnonzero(which).tolist()
    return ", ".join(map(str, indices[:5])) + ", ..." * (len(indices) > 5)
