"""Batched simulation against a loop over single MuJoCo simulations."""

from __future__ import annotations

from dataclasses import fields, replace

import mujoco
import numpy as np
import pytest
import torch

from egoskin.envs.physics import PhysicsConfig, Scene
from egoskin.envs.physics.mujoco import MujocoPhysics
from egoskin.robots.builtin import H1_2
from egoskin.shapes import Sphere
from simple_physics import SimplePhysics

BALLS = (Sphere(),) * 2
DEFAULT = torch.from_numpy(H1_2.default_joint_pos).float()
FEET = {"left_ankle_roll_link", "right_ankle_roll_link"}


def make(
    num_envs: int,
    config: PhysicsConfig = PhysicsConfig(),  # noqa: B008
    *,
    threads: int = 1,
    hold: bool = False,
    weightless: bool = False,
) -> MujocoPhysics:
    """Return simulations of the standing robot with parked balls."""
    scene = Scene(
        robot=H1_2,
        objects=BALLS,
        config=config,
        weightless_objects=weightless,
        link_contacts=True,
        hold=hold,
    )
    physics = MujocoPhysics(scene, num_envs, num_threads=threads)
    put(physics)
    return physics


def put(physics: MujocoPhysics, height: float = 0.0, joint_pos=DEFAULT) -> None:
    """Put all robots at rest, by default standing at the origin."""
    n = physics.num_envs
    pose = torch.tensor([0, 0, H1_2.default_base_height + height, 1, 0, 0, 0])
    physics.reset(torch.arange(n), pose.expand(n, 7), joint_pos.expand(n, len(DEFAULT)))


def throw(physics: MujocoPhysics, ball: int, position, velocity=(0.0, 0, 0)) -> None:
    """Release one ball in all rows."""
    n = physics.num_envs
    physics.throw(
        torch.arange(n),
        torch.full((n,), ball),
        torch.tensor(position).float().expand(n, 3),
        torch.tensor(velocity).float().expand(n, 3),
    )


def step(physics: MujocoPhysics, target=DEFAULT, active=(True, True)):
    n = physics.num_envs
    return physics.step(
        target.expand(n, len(DEFAULT)), torch.tensor(active).expand(n, 2)
    )


def names(flags: torch.Tensor) -> set[str]:
    return {name for name, flag in zip(H1_2.links, flags, strict=True) if flag}


@pytest.fixture(scope="module")
def crown() -> np.ndarray:
    """Return the highest point of the robot in its default pose at the origin."""
    model, data = H1_2.model, mujoco.MjData(H1_2.model)
    data.qpos[2] = H1_2.default_base_height
    data.qpos[7:] = H1_2.default_joint_pos
    mujoco.mj_kinematics(model, data)
    down, geom = np.array([0.0, 0, -1]), np.zeros(1, np.int32)
    tops = []
    for g in range(model.ngeom):
        above = data.geom_xpos[g] + [0, 0, 3]
        drop = mujoco.mj_ray(model, data, above, down, None, 1, -1, geom)
        tops.append(above + drop * down)
    return max(tops, key=lambda top: top[2])


# --- the oracle -----------------------------------------------------------------


@pytest.mark.parametrize(("rate", "substeps"), [(120, 1), (60, 2), (60, 4)])
def test_steps_equal_a_loop_over_single_simulations(rate, substeps):
    # Stiff enough to throw the arms against the body.
    config = PhysicsConfig(control_hz=rate, substeps=substeps, gains="real")
    physics = make(8, config)
    simple = SimplePhysics(physics.scene, 8)
    rng = np.random.default_rng(0)
    # Balls fly at the falling robots from all sides.
    side = rng.normal(size=(8, 2, 3)) * [1, 1, 0.2]
    side /= np.linalg.norm(side, axis=-1, keepdims=True)
    for ball in range(2):
        position = torch.from_numpy([0, 0, 1.0] + 1.2 * side[:, ball])
        velocity = torch.from_numpy(-5.0 * side[:, ball])
        physics.throw(torch.arange(8), torch.full((8,), ball), position, velocity)
    simple.load_state(physics.state())
    seen = {}
    for _ in range(rate):
        noise = torch.from_numpy(rng.normal(size=(8, len(DEFAULT)))).float()
        result, expected = (
            one.step(DEFAULT + 0.6 * noise, torch.ones(8, 2, dtype=torch.bool))
            for one in (physics, simple)
        )
        for field in fields(result):
            got, value = (getattr(x, field.name) for x in (result, expected))
            assert torch.equal(got, value), field.name
            seen[field.name] = seen.get(field.name, False) | bool(value.any())
        assert torch.equal(physics.state(), simple.state())
    assert not seen.pop("diverged")
    assert all(seen.values()), seen


def test_results_do_not_depend_on_the_number_of_threads():
    generator = torch.Generator().manual_seed(0)
    targets = DEFAULT + 0.3 * torch.randn(60, 16, len(DEFAULT), generator=generator)
    runs = []
    for threads in (1, 2):
        physics = make(16, threads=threads)
        throw(physics, 0, (2.0, 0, 1.2), (-6.0, 0, 1))
        results = [
            physics.step(target, torch.tensor([True, False]).expand(16, 2))
            for target in targets
        ]
        runs.append((physics.state(), results))
    assert torch.equal(runs[0][0], runs[1][0])
    for one, two in zip(runs[0][1], runs[1][1], strict=True):
        for field in fields(one):
            assert torch.equal(getattr(one, field.name), getattr(two, field.name))


# --- contacts -------------------------------------------------------------------


def test_a_standing_robot_touches_the_floor_with_its_feet_alone():
    physics = make(1)
    for _ in range(5):
        result = step(physics)
    assert names(result.link_contact[0]) == FEET
    assert not result.object_hit.any()
    assert not result.fallen.any()
    assert not result.self_contact.any()


def test_a_robot_in_the_air_touches_nothing():
    physics = make(1)
    put(physics, height=1.0)
    result = step(physics)
    assert not result.link_contact.any()
    assert not result.self_contact.any()


def test_a_ball_on_the_head_touches_the_head_alone(crown):
    physics = make(1, hold=True)
    throw(physics, 1, np.add(crown, [0, 0, 0.14]))
    result = step(physics)
    assert names(result.link_contact[0]) == {"torso_link"} | FEET
    assert result.object_hit.tolist() == [[False, True]]
    throw(physics, 1, np.add(crown, [0, 0, 0.2]))
    assert not step(physics).object_hit.any()


@pytest.mark.parametrize("where", ["first", "second", "neither"])
def test_a_contact_in_a_single_substep_is_seen(crown, where):
    # The ball crosses half a metre in a substep (60 m/s at 120 Hz), weightless and
    # sideways above the head: it is near in a single state.
    travel = 60 / 120
    start = {"first": 0.0, "second": -travel, "neither": -2 * travel}[where]
    physics = make(1, hold=True, weightless=True)
    throw(physics, 0, np.add(crown, [0, start, 0.14]), (0.0, 60, 0))
    result = step(physics)
    assert result.object_hit[0, 0].item() == (where != "neither")
    # The final state belongs to the next step: no contact is missed between the two.
    result = step(physics)
    assert result.object_hit[0, 0].item() == (where == "neither")


@pytest.fixture(scope="module")
def arms_in_trunk() -> torch.Tensor:
    """Return a pose, found at random, in which an arm is deep inside the trunk."""
    model, data = H1_2.model, mujoco.MjData(H1_2.model)
    arms = [i for i, n in enumerate(H1_2.joints) if "shoulder" in n or "elbow" in n]
    low, high = model.jnt_range[1:][arms].T
    rng = np.random.default_rng(0)
    for _ in range(1000):
        pose = H1_2.default_joint_pos.copy()
        pose[arms] = rng.uniform(low, high)
        data.qpos[7:] = pose
        mujoco.mj_forward(model, data)
        if any(contact.dist < -0.02 for contact in data.contact):
            return torch.from_numpy(pose).float()
    raise AssertionError("no such pose")


def test_a_robot_that_touches_itself_is_told_from_one_hit_or_standing(
    crown, arms_in_trunk
):
    physics = make(1, hold=True)
    put(physics, height=-0.005, joint_pos=arms_in_trunk)
    result = step(physics)
    assert result.self_contact.all()
    assert names(result.link_contact[0]) == FEET
    throw(physics, 0, np.add(crown, [0, 0, 0.14]))
    assert step(physics).object_hit[0, 0]
    put(physics, height=-0.005)
    assert not step(physics).self_contact.any()


def test_an_inactive_object_is_parked_and_touches_nothing(crown):
    physics = make(1, hold=True)
    throw(physics, 0, crown)
    throw(physics, 1, crown)
    result = step(physics, active=(False, True))
    assert result.object_hit.tolist() == [[False, True]]
    assert physics.read().object_pose[0, 0, 2] > 900


def test_an_object_falls_through_the_floor():
    physics = make(1, hold=True)
    throw(physics, 0, (3.0, 3, 0.3))
    for _ in range(60):
        assert not step(physics, active=(True, False)).fallen.any()
    # One second: g/2 below.
    height = physics.read().object_pose[0, 0, 2].item()
    assert height == pytest.approx(0.3 - 4.9, abs=0.1)


def test_contacts_by_link_are_told_only_if_asked():
    scene = make(1).scene
    bare = MujocoPhysics(replace(scene, link_contacts=False), 1)
    # Contact with each ball, itself, the floor; floor contact of each foot.
    assert bare.model.nsensor == 2 + 1 + 1 + len(H1_2.feet)
    put(bare)
    assert step(bare).link_contact is None


def test_weightless_objects_fly_straight():
    physics = make(1, weightless=True, hold=True)
    throw(physics, 0, (3.0, 0, 1), (0.0, 4, 0.5))
    for _ in range(60):
        step(physics)
    place = physics.read().object_pose[0, 0, :3]
    torch.testing.assert_close(place, torch.tensor([3.0, 4, 1.5]), atol=1e-4, rtol=0)


# --- actuation ------------------------------------------------------------------


def test_torque_is_the_clipped_pd_law_in_every_gain_set():
    rng = np.random.default_rng(0)
    for gains in H1_2.gains:
        physics = make(1, PhysicsConfig(gains=gains))
        model, data = physics.model, mujoco.MjData(physics.model)
        kp, kd = H1_2.joint_gains(gains)
        n = len(kp)
        clipped = 0
        for _ in range(50):
            q, target, qd = rng.normal(size=(3, n)) * [[0.5], [1.0], [5.0]]
            data.qpos[7 : 7 + n], data.qvel[6 : 6 + n], data.ctrl[:] = q, qd, target
            mujoco.mj_forward(model, data)
            wanted = kp * (target - q) - kd * qd
            torque = np.clip(wanted, -H1_2.torque_limit, H1_2.torque_limit)
            np.testing.assert_allclose(data.actuator_force, torque, atol=1e-9)
            np.testing.assert_allclose(data.qfrc_actuator[6 : 6 + n], torque, atol=1e-9)
            clipped += (torque != wanted).mean() / 50
        assert 0.05 < clipped < 0.95


@pytest.mark.parametrize("target_velocity", ["zero", "finite_difference"])
def test_torque_of_a_step_includes_the_velocity_target(target_velocity):
    config = PhysicsConfig(substeps=1, target_velocity=target_velocity)
    physics = make(4, config)
    put(physics, height=1.0)
    kp, kd = (torch.from_numpy(g) for g in H1_2.joint_gains(config.gains))
    limit = torch.from_numpy(H1_2.torque_limit)
    generator = torch.Generator().manual_seed(0)
    # The target before the first step is the initial pose.
    last = DEFAULT.expand(4, -1)
    for _ in range(5):
        before = physics.read()
        target = DEFAULT + 0.05 * torch.randn(4, len(DEFAULT), generator=generator)
        step(physics, target)
        # torque = kp (q* - q) + kd (qdot* - qdot)
        rate = (target - last) * config.control_hz
        if target_velocity == "zero":
            rate = torch.zeros_like(rate)
        torque = kp * (target - before.joint_pos) + kd * (rate - before.joint_vel)
        torque = torque.clamp(-limit, limit)
        got = torch.from_numpy(physics._torque.copy())
        torch.testing.assert_close(got, torque, atol=1e-3, rtol=1e-4)
        last = target


def test_stiff_joints_swing_out_at_the_default_rate():
    # The damping of these gains is too strong for a step that is explicit in it.
    physics = make(1, PhysicsConfig(gains="real"))
    put(physics, height=3.0)
    swing = np.random.default_rng(0).normal(size=len(DEFAULT))
    physics._qvel[0, 6 : 6 + len(DEFAULT)] = swing
    for _ in range(30):
        step(physics)
    assert np.abs(swing).max() > 1
    assert physics.read().joint_vel.abs().max() < 0.5


def test_a_held_robot_stays_where_it_is_put(crown):
    physics = make(2, hold=True)
    before = physics.read()
    throw(physics, 0, np.add(crown, [0, 0, 0.1]), (0.0, 0, -5))
    for _ in range(30):
        step(physics, DEFAULT + 1)
    after = physics.read()
    assert torch.equal(after.base_pose, before.base_pose)
    assert torch.equal(after.joint_pos, before.joint_pos)
    assert not after.joint_vel.any()


# --- state ----------------------------------------------------------------------


@pytest.mark.parametrize("num_envs", [1, 5])
def test_read_returns_copies_never_views(num_envs):
    physics = make(num_envs)
    throw(physics, 0, (2.0, 1, 1), (1.0, 2, 3))
    step(physics)
    first = physics.read()
    kept = {f.name: getattr(first, f.name).clone() for f in fields(first)}
    raw = physics.state()
    step(physics, DEFAULT + 0.3)
    for name, value in kept.items():
        assert torch.equal(getattr(first, name), value)
        assert value.dtype == torch.float32
    physics.load_state(raw)
    # Writing to the tensors read changes neither the simulation nor other tensors.
    for field in fields(first):
        getattr(first, field.name).fill_(7)
    again = physics.read()
    for name, value in kept.items():
        assert torch.equal(getattr(again, name), value)


def test_read_gives_the_state_of_mujoco():
    physics = make(3)
    generator = np.random.default_rng(0)
    qpos, qvel = generator.normal(size=(3, 34)), generator.normal(size=(3, 33))
    physics._qpos[:], physics._qvel[:] = qpos, qvel
    state = physics.read()
    # Layout of the scene: free joint 7 and 6, 21 hinges, then x, y, z of each ball.
    np.testing.assert_allclose(state.base_pose, qpos[:, :7], rtol=1e-6)
    np.testing.assert_allclose(state.joint_pos, qpos[:, 7:28], rtol=1e-6)
    balls = qpos[:, 28:].reshape(3, 2, 3)
    np.testing.assert_allclose(state.object_pose[..., :3], balls, rtol=1e-6)
    assert (state.object_pose[..., 3:] == torch.tensor([1.0, 0, 0, 0])).all()
    np.testing.assert_allclose(state.base_lin_vel_w, qvel[:, :3], rtol=1e-6)
    np.testing.assert_allclose(state.base_ang_vel_b, qvel[:, 3:6], rtol=1e-6)
    np.testing.assert_allclose(state.joint_vel, qvel[:, 6:27], rtol=1e-6)
    balls = qvel[:, 27:].reshape(3, 2, 3)
    np.testing.assert_allclose(state.object_lin_vel_w, balls, rtol=1e-6)
    some = physics.read(torch.tensor([2, 0]))
    assert torch.equal(some.joint_pos, state.joint_pos[[2, 0]])


def test_velocities_are_those_of_the_positions():
    # Finite differences of a robot in free fall; they also show the frame of each.
    physics = make(1, PhysicsConfig(substeps=1, control_hz=10_000))
    physics._qpos[0, :7] = 0, 0, 3, 0.5, 0.5, -0.5, 0.5
    physics._qvel[0, :6] = 1, 2, 3, 0.4, -0.5, 0.6
    before = physics.read()
    step(physics)
    middle = physics.read()
    dt = 1e-4
    moved = (middle.base_pose - before.base_pose)[0, :3] / dt
    torch.testing.assert_close(moved, middle.base_lin_vel_w[0], atol=2e-2, rtol=0)
    turned, q = np.zeros(3), before.base_pose[0, 3:].double().numpy()
    mujoco.mju_subQuat(turned, middle.base_pose[0, 3:].double().numpy(), q)
    np.testing.assert_allclose(turned / dt, middle.base_ang_vel_b[0], atol=2e-2)


@pytest.mark.parametrize("target_velocity", ["zero", "finite_difference"])
def test_a_loaded_state_continues_bit_for_bit(target_velocity):
    config = PhysicsConfig(target_velocity=target_velocity)
    generator = torch.Generator().manual_seed(0)
    targets = DEFAULT + 0.2 * torch.randn(40, 4, len(DEFAULT), generator=generator)
    active = torch.ones(4, 2, dtype=torch.bool)
    first = make(4, config)
    throw(first, 0, (1.5, 0, 1.2), (-6.0, 0, 0))
    for target in targets[:20]:
        first.step(target, active)
    saved = first.state()
    second = make(4, config)
    second.load_state(saved)
    assert torch.equal(second.state(), saved)
    for target in targets[20:]:
        one, two = first.step(target, active), second.step(target, active)
        for field in fields(one):
            assert torch.equal(getattr(one, field.name), getattr(two, field.name))
    assert torch.equal(first.state(), second.state())


def test_a_reset_row_remembers_nothing():
    fresh, used = make(4), make(4)
    generator = torch.Generator().manual_seed(0)
    for _ in range(20):
        target = DEFAULT + 0.3 * torch.randn(4, len(DEFAULT), generator=generator)
        used.step(target, torch.ones(4, 2, dtype=torch.bool))
    others = used.state()[[0, 1, 3]]
    pose = fresh.read().base_pose[:1]
    used.reset(torch.tensor([2]), pose, DEFAULT[None])
    assert torch.equal(used.state()[[0, 1, 3]], others)
    # The whole integration state is as new, including warm start and time.
    assert torch.equal(used.state()[2], fresh.state()[2])


BAD = [np.nan, np.inf, 1e12]


@pytest.mark.parametrize("value", BAD)
@pytest.mark.parametrize("array", ["_qvel", "_qpos"])
@pytest.mark.parametrize("hold", [False, True])
def test_a_diverged_row_is_told_and_finite_and_harms_no_other(
    array, value, hold, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)  # MuJoCo writes its log where the process runs
    reference, physics = make(4, hold=hold), make(4, hold=hold)
    for one in (reference, physics):
        step(one, DEFAULT + 0.1)
    getattr(physics, array)[1, 8] = value
    expected, result = step(reference, DEFAULT), step(physics, DEFAULT)
    assert result.diverged.tolist() == [False, True, False, False]
    state, truth = physics.read(), reference.read()
    for field in fields(state):
        got = getattr(state, field.name)
        assert got.isfinite().all()
        assert torch.equal(got[[0, 2, 3]], getattr(truth, field.name)[[0, 2, 3]])
    assert torch.equal(result.power[[0, 2, 3]], expected.power[[0, 2, 3]])
    assert result.power.isfinite().all()
    # After a reset the row continues like any other.
    pose = torch.tensor([[0, 0, H1_2.default_base_height, 1, 0, 0, 0]])
    for one in (reference, physics):
        one.reset(torch.tensor([1]), pose, DEFAULT[None])
    for _ in range(10):
        assert not step(physics).diverged.any()
        step(reference)
    assert torch.equal(physics.state(), reference.state())


# --- errors ---------------------------------------------------------------------


@pytest.mark.parametrize("name", ["control_hz", "substeps"])
@pytest.mark.parametrize("value", [0, -1])
def test_rates_that_are_not_positive_are_refused(name, value):
    with pytest.raises(ValueError, match=f"{name} must be at least 1, got {value}"):
        PhysicsConfig(**{name: value})


@pytest.mark.parametrize("name", ["control_hz", "substeps"])
@pytest.mark.parametrize("value", [2**31, 10**400])
def test_rates_and_counts_that_mujoco_cannot_hold_are_refused(name, value):
    with pytest.raises(ValueError, match=f"{name} must .*, got {value}"):
        PhysicsConfig(**{name: value})


def test_an_unknown_gain_set_is_refused_with_those_there_are():
    with pytest.raises(
        ValueError, match="no gain set 'soft'; it has rotor_inertia, real"
    ):
        make(1, PhysicsConfig(gains="soft"))
