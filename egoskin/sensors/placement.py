"""Placing sensors on a robot."""

from __future__ import annotations

from collections.abc import Sequence

from egoskin.robots import RobotConfig
from egoskin.sensors.skin import Skin
from egoskin.surface import sample_surface


def place_area_uniform(
    robot: RobotConfig,
    num_sensors: int,
    seed: int,
    links: Sequence[str] | None = None,
) -> Skin:
    """Return a skin of sensors placed at random, uniformly by area.

    Args:
        robot: The robot.
        num_sensors: Number of sensors ``S``.
        seed: Seed of the placement.
        links: Links to cover; the robot's ``skin_links`` (upper body) by default.

    Returns:
        Sensors on the outer surface of the robot's primitives, z along the outward
        normal.

    Raises:
        ValueError: If the number is not positive, a link is not the robot's, or none
            of the links shows any surface.
    """
    covered = tuple(links or robot.skin_links)
    points = sample_surface(robot, covered, num_sensors, seed)
    return Skin(
        robot=robot.name,
        links=tuple(robot.links[i] for i in points.link),
        # What the file can hold, so that a saved skin is the same skin.
        position=points.position.round(6),
        normal=points.normal.round(6),
        provenance={"placement": "area_uniform", "seed": seed, "links": list(covered)},
    )
