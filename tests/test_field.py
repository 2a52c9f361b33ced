"""Field sensors against MuJoCo's own distances, and what no skin may change."""

from __future__ import annotations

import math

import mujoco
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from egoskin.kinematics import quat_to_matrix, rotate
from egoskin.robots import H1_2
from egoskin.sensors import FieldSensor, Skin
from egoskin.shapes import Sphere

BALLS = (Sphere(radius=0.15), Sphere(radius=0.08))
RANGE = 1.2
# Stands for a point: MuJoCo measures distances between geoms.
TINY = 1e-9
KEYS = ("base_pose", "joint_pos", "object_pose", "object_active")


@pytest.fixture(scope="module")
def sensor(skin) -> FieldSensor:
    return FieldSensor(skin, H1_2.chain, BALLS, RANGE)


def measure(sensor, state):
    """(distance, detected) of a state."""
    return sensor.compute(*(state[key] for key in KEYS))


# --- MuJoCo as the oracle -------------------------------------------------------


@pytest.fixture(scope="module")
def scene(skin) -> mujoco.MjModel:
    """The robot with a speck at each sensor, and the balls."""
    spec = H1_2.spec()
    for i, (link, position) in enumerate(zip(skin.links, skin.position, strict=True)):
        spec.body(link).add_geom(name=f"sensor_{i}", size=[TINY, 0, 0], pos=position)
    for i, ball in enumerate(BALLS):
        body = spec.worldbody.add_body(name=f"ball_{i}", mocap=True)
        ball.add_geom(body, name=f"ball_{i}")
    return spec.compile()


def mujoco_distances(model, state) -> np.ndarray:
    """Distance from every sensor to every ball, 0 inside, ``[n, O, S]``."""
    data, unused = mujoco.MjData(model), np.zeros(6)
    # Geoms are numbered body by body, sensors are not.
    names = [model.geom(i).name for i in range(model.ngeom)]
    count = sum(name.startswith("sensor_") for name in names)
    sensors = [names.index(f"sensor_{i}") for i in range(count)]
    balls = [model.geom(f"ball_{i}").id for i in range(len(BALLS))]
    result = np.zeros((len(state), len(balls), len(sensors)))
    for row, values in zip(result, state.unbind(0), strict=True):
        data.qpos[:7] = values["base_pose"]
        data.qpos[7:] = values["joint_pos"]
        data.mocap_pos[:] = values["object_pose"][:, :3]
        mujoco.mj_kinematics(model, data)
        for o, ball in enumerate(balls):
            for s, point in enumerate(sensors):
                row[o, s] = mujoco.mj_geomDistance(model, data, point, ball, 99, unused)
    return np.maximum(result + TINY, 0)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_distance_equals_that_of_mujoco(sensor, scene, random_state, dtype):
    state = random_state(1000, seed=1, dtype=dtype)
    truth = mujoco_distances(scene, state)
    truth[~state["object_active"].numpy()] = np.inf
    truth_detected = (truth <= RANGE).any(-1)
    truth[truth > RANGE] = np.inf
    distance, detected = measure(sensor, state)
    assert distance.dtype == dtype
    assert distance.shape == (1000, 64)
    # Within rounding of the range either side may say "nothing": leave those out.
    clear = np.abs(truth.min(1) - RANGE) > 1e-5
    clear &= ~((distance.numpy() > RANGE - 1e-5) & np.isfinite(distance.numpy()))
    assert clear.mean() > 0.99
    np.testing.assert_allclose(distance[clear], truth.min(1)[clear], 0, 1e-5)
    np.testing.assert_array_equal(detected, truth_detected)
    # The sample covers what matters: balls in and out of range, sensors inside balls.
    assert 0.1 < np.isfinite(truth.min(1)).mean() < 0.9
    assert (truth == 0).any()


def test_sensors_sit_where_the_skin_says(sensor, scene, random_state):
    state = random_state(20, seed=2, dtype=torch.float64)
    points = sensor.points_b(state["joint_pos"])
    data = mujoco.MjData(scene)
    for row, values in zip(points, state.unbind(0), strict=True):
        data.qpos[3] = 1
        data.qpos[:3] = 0
        data.qpos[7:] = values["joint_pos"]
        mujoco.mj_kinematics(scene, data)
        expected = [data.geom(f"sensor_{i}").xpos for i in range(len(row))]
        np.testing.assert_allclose(row, expected, 0, 1e-6)


# --- one sensor, by hand --------------------------------------------------------


def one_sensor(max_range: float, objects=BALLS[:1]) -> FieldSensor:
    """A sensor at the origin of the base."""
    skin = Skin(
        robot="h1_2",
        links=("pelvis",),
        position=np.zeros((1, 3)),
        normal=np.array([[0.0, 0, 1]]),
    )
    return FieldSensor(skin, H1_2.chain, objects, max_range)


def look(sensor, *centres, active=None, dtype=torch.float64):
    """(distance, detected) for balls at the given places, base at the origin."""
    pose = torch.zeros(1, len(centres), 7, dtype=dtype)
    pose[0, :, :3] = torch.tensor(centres, dtype=dtype)
    if active is None:
        active = [True] * len(centres)
    distance, detected = sensor.compute(
        torch.tensor([[0, 0, 0, 1, 0, 0, 0]], dtype=dtype),
        torch.zeros(1, len(H1_2.joints), dtype=dtype),
        pose,
        torch.tensor([active]),
    )
    return distance.item(), detected[0].tolist()


def test_distance_is_to_the_surface():
    # |(3, 0, 4)| = 5, less the radius .15
    assert look(one_sensor(9), (3, 0, 4)) == (pytest.approx(4.85), [True])


def test_a_sensor_inside_the_ball_reads_zero():
    sensor = one_sensor(2)
    assert look(sensor, (0, 0, 0)) == (0, [True])
    assert look(sensor, (0.1, 0, 0)) == (0, [True])


def test_the_range_itself_counts_as_detected():
    ball = (Sphere(radius=0.25),)
    # All numbers are exact in binary: 1.75 - .25 = 1.5.
    assert look(one_sensor(1.5, ball), (0, 1.75, 0)) == (1.5, [True])
    assert look(one_sensor(1.5, ball), (0, 1.75 + 2**-20, 0)) == (math.inf, [False])
    assert look(one_sensor(1.5 - 2**-20, ball), (0, 1.75, 0)) == (math.inf, [False])


def test_an_infinite_range_sees_everything_active():
    assert look(one_sensor(math.inf), (3e5, 0, 4e5)) == (
        pytest.approx(5e5 - 0.15),
        [True],
    )
    assert look(one_sensor(math.inf), (1, 0, 0), active=[False]) == (math.inf, [False])


def test_the_nearest_of_two_balls_is_measured():
    sensor = one_sensor(2, BALLS)
    # Surfaces at 1 - .15 = .85 and 1 - .08 = .92: the nearer surface, not centre.
    assert look(sensor, (0, 1, 0), (1, 0, 0)) == (pytest.approx(0.85), [True, True])
    assert look(sensor, (0, 1, 0), (0.9, 0, 0)) == (pytest.approx(0.82), [True, True])
    assert look(sensor, (0, 9, 0), (1, 0, 0)) == (pytest.approx(0.92), [False, True])


def test_an_inactive_ball_is_sensed_by_nothing():
    sensor = one_sensor(2, BALLS)
    places = ((0, 1, 0), (1, 0, 0))
    assert look(sensor, *places, active=[False, True]) == (
        pytest.approx(0.92),
        [False, True],
    )
    assert look(sensor, *places, active=[False, False]) == (math.inf, [False, False])


# --- invariances ----------------------------------------------------------------

ANGLE = st.floats(-math.pi, math.pi)
UNIT_QUAT = (
    st.tuples(*[st.floats(-1, 1)] * 4)
    .filter(lambda q: np.linalg.norm(q) > 0.1)
    .map(lambda q: torch.from_numpy(np.array(q) / np.linalg.norm(q)))
)


def quat_product(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    w = a[..., :1] * b[..., :1] - (a[..., 1:] * b[..., 1:]).sum(-1, keepdim=True)
    v = a[..., :1] * b[..., 1:] + b[..., :1] * a[..., 1:]
    return torch.cat((w, v + torch.linalg.cross(a[..., 1:], b[..., 1:])), -1)


@given(UNIT_QUAT, st.tuples(*[st.floats(-5, 5)] * 3))
def test_moving_robot_and_balls_together_changes_nothing(
    sensor, random_state, quat, shift
):
    state = random_state(16, seed=3, dtype=torch.float64)
    distance, detected = measure(sensor, state)
    moved = state.clone()
    shift = torch.tensor(shift, dtype=torch.float64)
    for key in ("base_pose", "object_pose"):
        place = state[key][..., :3]
        moved[key][..., :3] = rotate(quat.expand(*place.shape[:-1], 4), place) + shift
    turn = quat.expand(16, 4)
    moved["base_pose"][:, 3:] = quat_product(turn, state["base_pose"][:, 3:])
    moved_distance, moved_detected = measure(sensor, moved)
    torch.testing.assert_close(moved_distance, distance, rtol=0, atol=1e-9)
    assert torch.equal(moved_detected, detected)


@given(st.permutations(range(40)))
def test_permuting_the_rows_permutes_the_result(sensor, random_state, order):
    state = random_state(40, seed=4)
    distance, detected = measure(sensor, state)
    other_distance, other_detected = measure(sensor, state[list(order)])
    assert torch.equal(other_distance, distance[list(order)])
    assert torch.equal(other_detected, detected[list(order)])


@given(st.permutations(range(64)))
def test_permuting_the_sensors_permutes_the_result(skin, sensor, random_state, order):
    order = list(order)
    shuffled = Skin(
        robot=skin.robot,
        links=tuple(skin.links[i] for i in order),
        position=skin.position[order],
        normal=skin.normal[order],
    )
    state = random_state(16, seed=5)
    distance, detected = measure(sensor, state)
    other = FieldSensor(shuffled, H1_2.chain, BALLS, RANGE)
    other_distance, other_detected = measure(other, state)
    assert torch.equal(other_distance, distance[:, order])
    assert torch.equal(other_detected, detected)


@given(st.integers(0, 1000), st.floats(0.05, 5))
def test_distances_of_two_sensors_differ_by_no_more_than_their_gap(
    skin, random_state, seed, max_range
):
    # Triangle inequality, between sensors that both see the only ball.
    sensor = FieldSensor(skin, H1_2.chain, BALLS[:1], max_range)
    state = random_state(4, seed=seed, dtype=torch.float64, objects=1)
    distance, detected = measure(sensor, state)
    points = sensor.points_b(state["joint_pos"])
    gap = (points[:, :, None] - points[:, None]).norm(dim=-1)
    difference = (distance[:, :, None] - distance[:, None]).abs()
    both = distance.isfinite()[:, :, None] & distance.isfinite()[:, None]
    assert (difference <= gap + 1e-9)[both].all()
    assert (distance[distance.isfinite()] <= max_range).all()
    assert (distance >= 0).all()
    assert torch.equal(detected[:, 0], distance.isfinite().any(-1))


@given(st.floats(0.1, 2), st.floats(0.1, 2))
def test_a_longer_range_only_adds_detections(skin, random_state, a, b):
    state = random_state(8, seed=6)
    short, long = (
        measure(FieldSensor(skin, H1_2.chain, BALLS, r), state)[0]
        for r in sorted((a, b))
    )
    seen = short.isfinite()
    assert torch.equal(short[seen], long[seen])
    assert (long[~seen] > min(a, b)).all()


def test_the_way_a_ball_is_turned_does_not_matter(sensor, random_state):
    state = random_state(16, seed=7)
    turned = state.clone()
    turned["object_pose"][..., 3:] = torch.tensor([0.5, 0.5, -0.5, 0.5])
    for a, b in zip(measure(sensor, state), measure(sensor, turned), strict=True):
        assert torch.equal(a, b)


def test_points_in_the_world_and_quaternions_agree(sensor, random_state):
    # The same distances from world positions, by rotation matrices.
    state = random_state(32, seed=8, dtype=torch.float64, objects=2)
    points = sensor.points_b(state["joint_pos"])
    turn = quat_to_matrix(state["base_pose"][:, 3:])
    points_w = points @ turn.mT + state["base_pose"][:, None, :3]
    gap = (points_w[:, None] - state["object_pose"][:, :, None, :3]).norm(dim=-1)
    radius = torch.tensor([b.radius for b in BALLS]).double()[:, None]
    expected = (gap - radius).clamp(min=0)
    expected[~state["object_active"]] = torch.inf
    expected = expected.min(1).values
    expected[expected > RANGE] = torch.inf
    torch.testing.assert_close(measure(sensor, state)[0], expected)


# --- errors ---------------------------------------------------------------------


@pytest.mark.parametrize("max_range", [0.0, -1.0, math.nan])
def test_a_range_that_is_not_positive_is_refused(skin, max_range):
    with pytest.raises(ValueError, match="max_range must be positive, got"):
        FieldSensor(skin, H1_2.chain, BALLS, max_range)


def test_a_skin_of_another_robot_is_refused(small_robot, skin):
    with pytest.raises(ValueError, match=r"sensor 0 sits on .* Its links are base"):
        FieldSensor(skin, small_robot("<geom size='1'/>").chain, BALLS, RANGE)


def test_another_number_of_objects_is_refused(sensor, random_state):
    with pytest.raises(ValueError, match="made for 2 objects, 'object_pose' holds 3"):
        measure(sensor, random_state(4, objects=3))
