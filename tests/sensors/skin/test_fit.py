"""What is told about the places of sensors on their robot."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from egoskin.robots.builtin import G1, H1_2
from egoskin.sensors import Skin, place_sensors
from egoskin.sensors.skin.fit import fit_notes

# A box with an arm on its +x side, a ball on a stick.
ROBOT = (
    "<geom type='box' size='.1 .1 .1'/><body name='arm' pos='.2 0 0'><joint/>"
    "<geom size='.05'/></body><body name='bare' pos='0 0 1'><joint/>"
    "<inertial mass='1' pos='0 0 0' diaginertia='1 1 1'/></body>"
)


def skin_of(*sensors: tuple[str, tuple, tuple]) -> Skin:
    links, position, normal = zip(*sensors, strict=True)
    return Skin(
        robot="small",
        links=links,
        position=np.array(position, float),
        normal=np.array(normal, float),
    )


def test_placed_sensors_have_nothing_unusual():
    for robot in (H1_2, G1):
        for stand_off in (0.0, 0.01):
            skin = place_sensors(robot, 64, method="poisson_disk", stand_off=stand_off)
            assert fit_notes(skin, robot) == []


def test_each_mistake_is_told_with_its_sensors(small_robot):
    robot = small_robot(ROBOT)
    good = ("base", (0, 0, 0.1), (0, 0, 1)), ("arm", (0, 0, 0.05), (0, 0, 1))
    assert fit_notes(skin_of(*good), robot) == []
    for sensors, note in (
        (
            [("base", (0, 0, 0.4), (0, 0, 1))],
            "1 sensor farther than 0.15 m from the surface of their links: 2",
        ),
        (
            [("base", (0, -0.1, 0), (0, 1, 0)), ("arm", (0, 0, -0.05), (0, 0, 1))],
            "2 sensors with a normal that points into their links: 2, 3",
        ),
        # In the ball of the arm, 0.07 m off its own link.
        (
            [("base", (0.17, 0, 0.02), (0, 0, 1))],
            "1 sensor inside a shape of another link: 2",
        ),
        ([good[0]], "2 sensors less than 1 mm from another one: 0, 2"),
        # Without a shape nothing is known of the surface.
        ([("bare", (0, 0, 0.5), (0, 0, -1))], None),
    ):
        found = fit_notes(skin_of(*good, *sensors), robot)
        assert found == ([note] if note else [])


def test_of_many_sensors_the_first_are_named(small_robot):
    robot = small_robot(ROBOT)
    skin = place_sensors(robot, 40, seed=0)
    (note,) = fit_notes(replace(skin, normal=-skin.normal), robot)
    assert note.startswith("40 sensors with a normal that points into")
    assert note.endswith(": 0, 1, 2, 3, 4, ...")
