"""An interactive session: throws on request, masks, other sensors, errors."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
import torch

from egoskin.evaluation.throw_set import standard_task
from egoskin.make import make_worker_env
from egoskin.policies.policy import load_policy
from egoskin.viewer.web.session import Session, Throw
from making import remove_critic


@pytest.fixture(scope="module")
def session() -> Session:
    """Return a shared session; tests that need a new episode reset it."""
    return Session("field_proximity")


def play(session: Session, steps: int) -> list:
    return [session.step() for _ in range(steps)]


def test_nothing_is_thrown_unless_asked_for(session: Session):
    session.reset()
    assert not any(frame.active.any() for frame in play(session, 150))


def test_a_ball_comes_with_the_speed_from_the_height_and_side_asked_for(
    session: Session,
):
    session.reset()
    throw = Throw(speed=5.0, height=1.5, azimuth=math.pi / 2, distance=4.0)
    session.throw(throw)
    before = session.frame.qpos
    first, second = play(session, 2)
    assert first.active.tolist() == [True, False]
    start = first.balls[0]
    assert start[2] == pytest.approx(1.5)
    # From the left of its heading: half the heading is the angle of (w, z).
    heading = 2 * math.atan2(before[6], before[3])
    offset = start[:2] - first.qpos[:2]
    bearing = math.atan2(offset[1], offset[0]) - heading
    assert math.remainder(bearing - math.pi / 2, 2 * math.pi) == pytest.approx(
        0, abs=0.1
    )
    assert np.linalg.norm(offset) == pytest.approx(4.0, abs=1e-3)
    speed = np.linalg.norm(second.balls[0] - start) * session.hz
    assert speed == pytest.approx(5.0, abs=1e-3)


def test_a_ball_is_thrown_at_the_point_nearest_to_a_place(session: Session):
    session.reset()
    play(session, 3)
    session.body.place(session.frame.qpos)
    hand = session.body.data.body("left_wrist_roll_link").xpos.copy()
    target = session.target_near(hand)
    # The robot only stands: the ball flies straight to its hand.
    session.throw(
        Throw(speed=8.0, height=1.2, azimuth=0.0, distance=3.0, target=target)
    )
    frame = session.step()
    start, end = frame.balls[0], session.step().balls[0]
    way = (end - start) / np.linalg.norm(end - start)
    beside = (hand - start) - (hand - start) @ way * way
    assert np.linalg.norm(beside) < 0.2


def test_balls_at_a_box_are_thrown_at_all_of_it(session: Session, monkeypatch):
    session.reset()
    thrower = session._thrower
    throws = dataclasses.replace(thrower.config, aim="box")
    monkeypatch.setattr(thrower, "config", throws)

    def target_of(number: float, throw: int) -> torch.Tensor:
        thrower.wanted = Throw(target=number)
        zero = torch.zeros(1, dtype=torch.int64)
        return thrower.draw(0, zero, zero, zero + throw).target[0]

    numbers = np.random.default_rng(0).uniform(size=200).tolist()
    targets = torch.stack([target_of(number, 0) for number in numbers])
    # In all parts of it.
    assert len((4 * targets).long().unique(dim=0)) == 16
    # Alike for another robot, whose episode began at another time.
    assert torch.equal(targets[0], target_of(numbers[0], 3))


def test_readings_are_what_the_policy_is_given(session: Session):
    session.reset()
    session.throw(Throw(speed=6.0, azimuth=0.0, distance=3.0, target=0.5))
    seen = 0
    for _ in range(40):
        frame = session.step()
        # Proximity is 1 for nothing.
        signal = session._root["signal"][0].numpy()
        np.testing.assert_allclose(frame.reading, 1 - signal, atol=1e-6)
        np.testing.assert_array_equal(np.isfinite(frame.line[:, 0]), signal < 1)
        seen += int((signal < 1).any())
    assert seen > 5
    # A line ends on the surface of a ball.
    ends = frame.line[np.isfinite(frame.line[:, 0])]
    away = np.linalg.norm(ends[:, None] - frame.balls, axis=-1).min(-1)
    np.testing.assert_allclose(away, 0.15, atol=1e-5)


def test_masked_sensors_read_nothing_and_others_as_before(session: Session):
    def readings(masked: set[int]) -> np.ndarray:
        session.reset()
        session.mask(masked)
        session.throw(Throw(speed=6.0, azimuth=0.0, distance=3.0, target=0.5))
        # Before anything is detected the robots move alike.
        for _ in range(60):
            frame = session.step()
            if frame.reading.any():
                break
        return frame.reading

    first = readings(set()).nonzero()[0]
    masked = readings({int(first[0])})
    assert masked[first[0]] == 0
    session.mask(set(range(64)))
    assert not session.step().reading.any()
    session.mask(set())
    np.testing.assert_array_equal(readings(set()).nonzero()[0], first)


def test_a_reset_repeats_the_readings_of_real_sensors():
    session = Session("field_proximity")
    sensor = session.readable(corruption="acoustic")
    assert sensor is not None
    session.configure(sensor)
    first, second = (
        [session.reset().reading, *(frame.reading for frame in play(session, 10))]
        for _ in range(2)
    )
    np.testing.assert_array_equal(first, second)


def test_a_ray_meets_the_sensor_that_is_in_its_way(session: Session):
    session.reset()
    session.mask(set())
    skin = session.skin
    assert skin is not None
    session.body.place(session.frame.qpos)
    points = session.body.sensor_points(skin)
    normals = session.body.sensor_normals(skin)
    for i in (3, 17, 40):
        origin = points[i] + 2 * normals[i]
        assert session.sensor_at(origin, -normals[i], 1e-6) == i
        # From behind, the body hides it.
        assert session.sensor_at(points[i] - 2 * normals[i], normals[i], 1e-6) != i


def test_an_episode_ends_and_the_next_begins_alike(session: Session):
    start = session.reset()
    session.mask(set(range(64)))
    for _ in range(600):
        if session.frame.ending is not None:
            break
        if session.frame.step % 40 == 0:
            session.throw(Throw(speed=8.0, azimuth=0.0, distance=3.0, target=0.5))
        session.step()
    assert session.frame.ending in ("hit", "fall")
    assert session.frame.survived > 0
    session.mask(set())
    again = session.reset()
    np.testing.assert_array_equal(start.qpos, again.qpos)
    assert (again.step, again.survived, again.ending) == (0, 0.0, None)


def test_survival_is_the_time_since_the_first_throw(session: Session):
    session.reset()
    assert play(session, 10)[-1].survived == 0
    session.throw(Throw(speed=1.0, azimuth=0.0, distance=8.0))
    play(session, 15)
    session.throw(Throw(speed=1.0, azimuth=0.0, distance=8.0))
    # 30 steps at 60 Hz.
    assert play(session, 15)[-1].survived == pytest.approx(0.5)


def test_a_line_is_as_long_as_the_distance_that_its_sensor_measures(session: Session):
    session.reset()
    # Of two balls, one far behind and one near in front.
    session.throw(Throw(speed=1.0, azimuth=math.pi, distance=8.0))
    session.step()
    session.throw(Throw(speed=1.0, azimuth=0.0, distance=1.8, height=1.0))
    frame = play(session, 5)[-1]
    assert frame.active.all()
    assert session.skin is not None
    session.body.place(frame.qpos)
    points = session.body.sensor_points(session.skin)
    length = np.linalg.norm(frame.line - points, axis=-1)
    seen = frame.reading > 0
    assert seen.any()
    # Of a range of 2 m; the reading is 1 at contact.
    np.testing.assert_allclose(length[seen], 2 * (1 - frame.reading[seen]), atol=1e-4)


def test_a_binary_sensor_without_limit_detects_only_what_is_there(session: Session):
    own = session.config.sensor
    sensor = session.readable(signal="binary", range=math.inf)
    assert sensor is not None
    session.configure(sensor)
    assert not session.step().reading.any()
    session.throw(Throw(speed=6.0, azimuth=0.0, distance=3.0, target=0.5))
    assert session.step().reading.any()
    session.configure(own)


def test_a_policy_that_cannot_be_played_changes_nothing(session: Session, monkeypatch):
    session.reset()
    before = dict(vars(session))

    def refuse(*args, **kwargs):
        raise ValueError("no such engine here")

    with monkeypatch.context() as patch:
        patch.setattr("egoskin.viewer.web.session.make_worker_env", refuse)
        with pytest.raises(ValueError, match="no such engine"):
            session.load("blind")
    assert vars(session) == before
    session.step()


def test_only_sensors_that_the_policy_can_read_are_taken(session: Session):
    assert session.readable(signal="localization") is None
    assert session.readable(coverage="ray") is None
    sensor = session.readable(coverage="ray", reduce="min", signal="binary", range=1.0)
    assert sensor is not None
    session.configure(sensor)
    session.throw(Throw(speed=6.0, azimuth=0.0, distance=3.0, target=0.5))
    readings = np.stack([frame.reading for frame in play(session, 40)])
    assert set(np.unique(readings)) <= {0.0, 1.0}
    own = session.policy.env_config.sensor
    with pytest.raises(ValueError, match="reads 64 numbers from its skin, but"):
        session.configure(dataclasses.replace(own, signal="localization"))
    assert session.config.sensor == sensor
    session.configure(own)


def test_policies_and_runs_have_a_critic_but_for_old_policies(trained, tmp_path):
    policy = max((trained / "policies").iterdir())
    for source in (trained, policy):
        session = Session(str(source))
        assert session.critic is not None
        values = [frame.value for frame in play(session, 3)]
        assert np.isfinite(values).all()
        assert len(set(values)) == 3
    remove_critic(policy, tmp_path / "old.safetensors")
    session = Session(str(tmp_path / "old.safetensors"))
    assert session.critic is None
    assert math.isnan(session.reset().value)


def test_the_value_is_the_critics_of_the_checkpoint(trained):
    from egoskin.policies.policy import PolicySpec, load_agent_tensors
    from egoskin.storage.tensor_file import load_tensors, part

    session = Session(str(trained))
    frame = session.step()
    tensors, header = load_tensors(trained / "checkpoint.safetensors")
    agent = PolicySpec.from_header(header["policy"], "").build_agent()
    load_agent_tensors(agent, part("agent", tensors), "")
    with torch.no_grad():
        expected = agent.critic(agent.encode(agent.sense(session._root)))
    assert frame.value == pytest.approx(float(expected["state_value"]))


def test_an_action_that_is_not_finite_is_an_error(session: Session, monkeypatch):
    session.reset()
    monkeypatch.setattr(
        session, "policy", lambda td: td.set("action", torch.full((1, 21), torch.nan))
    )
    with pytest.raises(ValueError, match="not finite"):
        session.step()


@pytest.mark.parametrize("name", ["blind", "localization"])
def test_other_policies_are_played_too(name: str):
    session = Session(name)
    session.throw(Throw(speed=6.0, azimuth=0.0))
    frames = play(session, 20)
    assert frames[-1].active.any()
    assert (session.skin is None) == (name == "blind")


def test_what_the_task_draws_for_others_is_as_it_was(session: Session):
    """The thrower of a session changes nothing in other environments."""
    policy = load_policy("field_proximity")
    # The first ball is thrown in the first step.
    config = standard_task(policy.env_config)
    thrown = []
    for _ in range(2):
        env = make_worker_env(config, policy.skin, num_envs=2, seed=3, keep_raw=True)
        td = env.rollout(1, policy)[:, 0]["next"]
        assert td["object_active"].any()
        thrown.append(td.select("object_pose", "object_lin_vel_w"))
        session.reset()
        session.throw(Throw(speed=1.0))
        session.step()
    for key in thrown[0].keys():
        assert torch.equal(thrown[0][key], thrown[1][key])
