"""Thrown objects of any shape: their hits, misses and landings follow the shape."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from egoskin.envs.dodgeball import DodgeballConfig, DodgeballEnv
from egoskin.envs.throws import ThrowConfig
from egoskin.make import EnvConfig, make_worker_env
from egoskin.robots.builtin import H1_2
from egoskin.robots.kinematics import LinkKinematics, rotate
from egoskin.robots.surface import sample_surface
from egoskin.sensors.config import SensorConfig
from egoskin.shapes import Box, Capsule, Ellipsoid, Shape, Sphere

ROWS = 24
# Half of them pass beside the robot, above it or between its legs.
WIDE = ThrowConfig(
    num_balls=1,
    first_delay=(0.0, 0.0),
    aim="box",
    box_half_width=0.8,
    box_height=(0.4, 2.0),
    distance=(1.5, 2.0),
)
# Elongated across the flight direction of some throws, along that of others.
SHAPES = {
    Sphere(radius=0.15): WIDE,
    Box(half_extents=(0.05, 0.3, 0.1)): replace(
        WIDE, shape="box", size=(0.05, 0.3, 0.1)
    ),
    Capsule(radius=0.06, half_length=0.25): replace(
        WIDE, shape="capsule", size=(0.06, 0.25)
    ),
    Ellipsoid(semi_axes=(0.05, 0.3, 0.12)): replace(
        WIDE, shape="ellipsoid", size=(0.05, 0.3, 0.12)
    ),
}


def body_points(base_pose: torch.Tensor, joint_pos: torch.Tensor) -> torch.Tensor:
    """Return points on the robots' surfaces in the world frame, ``[B, n, 3]``."""
    points = sample_surface(H1_2, H1_2.links, 1500, seed=0)
    position, rotation = LinkKinematics(H1_2.chain, H1_2.links).poses_b(joint_pos)
    local = torch.from_numpy(points.position).float()
    link = torch.from_numpy(points.link)
    in_base = (rotation[:, link] @ local[..., None])[..., 0] + position[:, link]
    quat = base_pose[:, None, 3:].expand(-1, len(link), 4)
    return rotate(quat, in_base) + base_pose[:, None, :3]


@pytest.mark.parametrize("shape", SHAPES, ids=lambda shape: type(shape).__name__)
def test_a_thrown_shape_hits_or_misses_as_its_own_signed_distance_says(shape: Shape):
    config = DodgeballConfig(throws=SHAPES[shape])
    env = DodgeballEnv(H1_2, config, num_envs=ROWS, hold=True)
    root = env.reset()
    start, velocity = root["object_pose"][:, 0, :3], root["object_lin_vel_w"][:, 0]
    points = body_points(root["base_pose"], root["joint_pos"])

    flying = torch.ones(ROWS, dtype=torch.bool)
    hit = ~flying
    counts = torch.zeros(2, ROWS)
    for _ in range(50):
        root["action"] = torch.zeros(ROWS, len(H1_2.joints))
        step, root = env.step_and_maybe_reset(root)
        after = step["next"]
        for own, key in zip(counts, ("balls_arrived", "balls_avoided"), strict=True):
            own[flying] = after[key][flying, 0]
        hit |= flying & after["hit"][:, 0]
        flying &= ~after["done"][:, 0]

    gap = torch.full((ROWS,), torch.inf)
    # At 120 Hz, the rate at which the physics checks for contacts.
    for number in range(80):
        centre = start + velocity * number / 120
        near = (centre - points.mean(1)).norm(dim=-1) < 1.2
        x, y, z = (points[near] - centre[near, None]).unbind(-1)
        least = shape.signed_distance(x, y, z).amin(-1)
        gap[near] = torch.minimum(gap[near], least)
    # A body point inside the object is a touch; points are about 3 cm apart.
    assert hit[gap < 0].all()
    assert not hit[gap > 0.04].any()
    assert (gap < 0).sum() > ROWS / 6
    assert (gap > 0.04).sum() > ROWS / 6
    # A miss that has passed counts as avoided.
    assert counts[0].all()
    assert torch.equal(counts[1].bool(), ~hit)


@pytest.mark.parametrize("shape", SHAPES, ids=lambda shape: type(shape).__name__)
def test_a_shape_is_out_of_play_when_its_lowest_point_is_on_the_ground(shape: Shape):
    config = DodgeballConfig(throws=SHAPES[shape])
    env = DodgeballEnv(H1_2, config, num_envs=2, hold=True)
    root = env.reset()
    # Weightless, at rest, a centimetre above the ground and a centimetre in it.
    lowest = shape.half_height + torch.tensor([0.01, -0.01])
    place = torch.stack((3 + 0 * lowest, 0 * lowest, lowest), -1)
    rows = torch.arange(2)
    env.physics.throw(rows, 0 * rows, place, 0 * place)
    step = env.step(root.set("action", torch.zeros(2, len(H1_2.joints))))["next"]
    assert step["object_active"].tolist() == [[True], [False]]


@pytest.mark.parametrize("shape", SHAPES, ids=lambda shape: type(shape).__name__)
def test_the_sensors_read_the_distance_of_the_shape_that_is_thrown(shape: Shape):
    throws = replace(SHAPES[shape], num_balls=2, interval=(0.1, 0.1))
    config = EnvConfig(
        task=DodgeballConfig(throws=throws), sensor=SensorConfig(range=1.3)
    )
    skin = config.skin.build(H1_2)
    env = make_worker_env(config, skin, num_envs=ROWS, seed=0, hold=True, keep_raw=True)
    root = env.reset()
    for _ in range(12):
        root["action"] = torch.zeros(ROWS, len(H1_2.joints))
        _, root = env.step_and_maybe_reset(root)
    assert root["object_active"].all(-1).any()

    sensors = LinkKinematics(H1_2.chain, skin.links)
    position, rotation = sensors.poses_b(root["joint_pos"])
    local = torch.from_numpy(skin.position).float()[..., None]
    quat = root["base_pose"][:, None, 3:].expand(-1, len(skin), 4)
    points = rotate(quat, (rotation @ local)[..., 0] + position)
    points = points + root["base_pose"][:, None, :3]
    # The axes of an object are those of the world.
    gap = points[:, None] - root["object_pose"][:, :, None, :3]
    distance = shape.signed_distance(*gap.unbind(-1)).clamp(min=0.0)
    distance[~root["object_active"]] = torch.inf
    nearest = distance.amin(1)
    expected = torch.where(nearest > config.sensor.range, torch.inf, nearest)
    assert 0.1 < expected.isfinite().float().mean() < 0.9
    torch.testing.assert_close(root["distance"], expected, rtol=0, atol=1e-5)
