"""Occlusion by the robot's body, compared with MuJoCo's rays."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial

import mujoco
import numpy as np
import pytest
import torch
from hypothesis import given, settings

from egoskin.robots.builtin import H1_2
from egoskin.robots.config import Primitive
from egoskin.robots.kinematics import rotate_inverse
from egoskin.sensors import FieldSensor, Ray, RaySensor, Skin, occlusion
from egoskin.shapes import Box, Capsule, Ellipsoid, Sphere
from sensing import SEED, measure, turned

RANGE = 2.0
SHAPES = (
    Sphere(radius=0.15),
    Box(half_extents=(0.1, 0.2, 0.05)),
    Capsule(radius=0.05, half_length=0.3),
    Ellipsoid(semi_axes=(0.2, 0.1, 0.15)),
)
BALL = SHAPES[0]
WIDE = Ray(grid=(4, 4), fov_deg=120)
BODY = H1_2.primitives


def crowd(random_state, seed: int, rows: int = 6):
    """States in float64 with four active objects at random orientations."""
    state = turned(random_state(rows, seed, torch.float64, objects=4), seed)
    state["object_active"][:] = True
    return state


def stands_in_the_way(model, data, geom, place, way, length) -> bool:
    def hit(direction) -> float:
        return mujoco.mju_rayGeom(
            data.geom_xpos[geom],
            data.geom_xmat[geom],
            model.geom_size[geom],
            place,
            direction,
            model.geom_type[geom],
        )

    # A path that starts inside meets the solid ahead and behind, however short it is.
    ahead = hit(way)
    return ahead >= 0 and (ahead < length or hit(-way) >= 0)


def mujoco_blocks(skin, state, row, sensor, ways, lengths, larger: float) -> np.ndarray:
    """Whether a robot larger by some length [m] stands in the way, ``[n]``.

    Paths are given by their row, sensor, direction in the sensor's frame and length.
    """
    spec = H1_2.spec()
    for geom in spec.geoms:
        geom.size = np.where(geom.size > 0, geom.size + larger, geom.size)
    model = spec.compile()
    data, frames = mujoco.MjData(model), skin.rotation()
    result = []
    for r, s, way, length in zip(row, sensor, ways, lengths, strict=True):
        data.qpos[:7], data.qpos[7:] = state["base_pose"][r], state["joint_pos"][r]
        mujoco.mj_kinematics(model, data)
        link = data.body(skin.links[s])
        turn = link.xmat.reshape(3, 3)
        way = turn @ frames[s] @ way
        # Off the surface that the sensor sits on.
        place = link.xpos + turn @ skin.position[s] + 1e-4 * way
        result.append(
            any(
                stands_in_the_way(model, data, geom, place, way, length)
                for geom in range(model.ngeom)
            )
        )
    return np.array(result, dtype=bool)


def assert_hidden_as_in_mujoco(hidden, *paths) -> None:
    """Blocked by a robot thinner by 5 mm: hidden; not even touched: seen."""
    surely, touched = (mujoco_blocks(*paths, larger) for larger in (-5e-3, 0.0))
    assert hidden[surely].all()
    assert not hidden[~touched].any()


@settings(max_examples=25)
@given(SEED)
def test_a_ray_sees_what_mujoco_sees_before_the_robot(skin, random_state, seed):
    some = skin.select(np.random.default_rng(seed).permutation(len(skin))[:16])
    state = crowd(random_state, seed)
    clear, solid = (
        measure(
            RaySensor(some, H1_2.chain, SHAPES, RANGE, WIDE, body=b, per_object=True),
            state,
        )[0]
        for b in ((), BODY)
    )
    # The same reading or no detection.
    assert (solid.isinf() | (solid == clear)).all()
    row, sensor, beam, _ = places = clear.isfinite().nonzero().unbind(1)
    hidden = solid[places].isinf().numpy()
    ways = WIDE.directions()[beam]
    assert_hidden_as_in_mujoco(hidden, some, state, row, sensor, ways, clear[places])


@settings(max_examples=25)
@given(SEED)
def test_a_field_sees_what_mujoco_sees_before_the_robot(skin, random_state, seed):
    some = skin.select(np.random.default_rng(seed).permutation(len(skin))[:32])
    state = crowd(random_state, seed)
    state["object_pose"] = state["object_pose"][:, :1]
    state["object_active"] = state["object_active"][:, :1]
    clear, solid = (
        FieldSensor(some, H1_2.chain, [BALL], RANGE, body=b) for b in ((), BODY)
    )
    distance, seen = measure(clear, state)[0], measure(solid, state)[0]
    assert (seen.isinf() | (seen == distance)).all()
    # The path to a ball's closest point leads to its centre.
    position, rotation = clear.poses_b(state["joint_pos"])
    offset = state["object_pose"][:, 0, :3] - state["base_pose"][:, :3]
    centre = rotate_inverse(state["base_pose"][:, 3:], offset)
    ways = torch.nn.functional.normalize(centre[:, None] - position, dim=-1)
    ways = (rotation.mT @ ways[..., None])[..., 0]
    near = distance.isfinite() & (distance > 1e-3)
    row, sensor = near.nonzero().unbind(1)
    assert_hidden_as_in_mujoco(
        seen[near].isinf().numpy(),
        *(some, state, row, sensor, ways[near].numpy(), distance[near]),
    )


# --- bit-identical results ------------------------------------------------------


@pytest.mark.parametrize("kind", [FieldSensor, partial(RaySensor, coverage=WIDE)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_leaving_parts_of_the_body_out_changes_nothing(
    skin, random_state, kind, dtype, monkeypatch
):
    state = crowd(random_state, 3, rows=64)
    state = state.apply(lambda x: x.to(dtype) if x.is_floating_point() else x)
    # Around a sensor, at its centre even.
    state["object_pose"][0, 0, :3] = state["base_pose"][0, :3]
    clear = kind(skin, H1_2.chain, SHAPES, math.inf, per_object=True)
    sensor = kind(skin, H1_2.chain, SHAPES, math.inf, body=BODY, per_object=True)
    distance, detected = measure(sensor, state)
    monkeypatch.setattr(occlusion, "_SLACK", math.inf)
    everything = measure(sensor, state)
    assert torch.equal(distance, everything[0])
    assert torch.equal(detected, everything[1])
    assert (distance.isinf() & measure(clear, state)[0].isfinite()).any()


# --- by hand --------------------------------------------------------------------


def chest(front: bool) -> Skin:
    """A sensor on the middle of the front or the back of the torso's box."""
    (box,) = (p for p in BODY if p.link == "torso_link" and p.kind == "box")
    x = np.array([1.0 if front else -1.0, 0, 0])
    return Skin(
        robot="h1_2",
        links=("torso_link",),
        position=(box.position + box.rotation @ (x * box.size))[None],
        normal=(box.rotation @ x)[None],
    )


def readings(sensor, way, quat=(1, 0, 0, 0)):
    """(distances, detected) of an object some way from a sensor, default pose."""
    joint_pos = torch.from_numpy(H1_2.default_joint_pos)[None]
    position, _ = sensor.poses_b(joint_pos)
    base = torch.tensor([[0, 0, 0, 1, 0, 0, 0]], dtype=torch.float64)
    centre = position[0, 0] + torch.tensor(way, dtype=torch.float64)
    pose = torch.cat((centre, torch.tensor(quat, dtype=torch.float64)))[None, None]
    return sensor.compute(base, joint_pos, pose, torch.ones(1, 1, dtype=torch.bool))


def look(sensor, way):
    """(distance, detected) of an object some way from a sensor, default pose."""
    distance, detected = readings(sensor, way)
    return distance.min().item(), detected.item()


def test_the_torso_hides_what_is_behind_it_from_its_front_alone():
    # The ball's centre is 1 m from the sensor; its surface 0.15 m nearer.
    for way, sees in (((1.0, 0, 0), True), ((-1.0, 0, 0), False)):
        skin = chest(front=True)
        clear, solid = (
            FieldSensor(skin, H1_2.chain, [BALL], RANGE, body=b) for b in ((), BODY)
        )
        distance, detected = look(clear, way)
        assert detected
        assert distance == pytest.approx(0.85, abs=1e-6)
        assert look(solid, way) == ((distance if sees else math.inf), sees)


def test_turned_to_the_back_the_same_ball_is_seen():
    skin, way = chest(front=False), (-1.0, 0, 0)
    for sensor in (
        FieldSensor(skin, H1_2.chain, [BALL], RANGE, body=BODY),
        RaySensor(skin, H1_2.chain, [BALL], RANGE, body=BODY),
    ):
        distance, detected = look(sensor, way)
        assert detected
        # No beam of an even grid runs along the normal.
        assert 0.85 - 1e-6 <= distance < 0.9


def test_a_part_of_the_body_beyond_the_centre_of_a_long_object_hides_its_far_end():
    skin, ray = chest(front=True), Ray(grid=(16, 16), fov_deg=45)
    # It lies along the view, from 0.3 to 2.3 m ahead. A small sphere of the body is
    # between the sensor and the far end, which is seen past the near end.
    rod, turn = Capsule(radius=0.15, half_length=1.0), (0.5**0.5, 0, 0.5**0.5, 0)
    ahead = np.array([1.75, 0.29, 0.0])
    part = Primitive(
        link="torso_link",
        kind="sphere",
        size=np.array([0.1]),
        position=skin.position[0] + ahead,
        rotation=np.eye(3),
    )
    clear, solid = (
        readings(
            RaySensor(skin, H1_2.chain, [rod], 5.0, ray, body=b), (1.3, 0.5, 0), turn
        )
        for b in ((), (part,))
    )
    distance, seen = clear[0].flatten(), solid[0].flatten()
    ways = ray.directions() @ skin.rotation()[0].T
    along = ways @ ahead
    beside = np.linalg.norm(ahead - along[:, None] * ways, axis=1)
    behind = torch.from_numpy((beside < 0.1) & (along < distance.numpy()))
    behind &= distance.isfinite()
    assert behind.sum() > 1
    assert torch.equal(seen.isinf(), distance.isinf() | behind)


def test_an_object_around_the_sensor_is_not_hidden():
    skin = chest(front=True)
    sensor = FieldSensor(skin, H1_2.chain, [Sphere(radius=0.5)], RANGE, body=BODY)
    assert look(sensor, (0.1, 0, 0)) == (0.0, True)


@pytest.mark.parametrize("depth", [0.0, 2e-3, 0.02, 0.1])
def test_the_solid_around_a_sensor_hides_only_what_is_behind_it(depth):
    on = chest(front=True)
    within = replace(on, position=on.position - depth * on.normal)
    for kind in (FieldSensor, RaySensor):
        sensor = kind(within, H1_2.chain, [BALL], RANGE, body=BODY)
        clear = kind(within, H1_2.chain, [BALL], RANGE)
        for way, sees in (((0.6, 0.1, 0.1), True), ((-0.6, 0.1, 0.1), False)):
            distance, detected = look(sensor, way)
            assert detected == sees
            assert not sees or distance == look(clear, way)[0]


def test_sensors_below_the_surface_see_as_much_as_those_on_it(skin, random_state):
    state = crowd(random_state, 5, rows=64)
    shares = [
        measure(FieldSensor(s, H1_2.chain, [*SHAPES], RANGE, body=BODY), state)[0]
        .isfinite()
        .double()
        .mean()
        .item()
        for s in (skin, skin.misplaced(5e-3, 0.0, seed=0))
    ]
    assert shares[1] == pytest.approx(shares[0], rel=0.1)
