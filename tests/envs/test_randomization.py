"""Domain randomisation: what is drawn, its effects, and what stays exact."""

from __future__ import annotations

import dataclasses
import math
from unittest.mock import Mock

import mujoco
import numpy as np
import pytest
import torch

from egoskin.envs.dodgeball import DodgeballConfig, DodgeballEnv
from egoskin.envs.physics.mujoco import MujocoPhysics
from egoskin.envs.randomization import Randomization, RandomizationConfig
from egoskin.envs.rewards import TERMS
from egoskin.envs.standards import evaluation_task, standard_of
from egoskin.envs.throws import ThrowConfig
from egoskin.robots.builtin import H1_2
from throwing import assert_forgets, assert_same

NO_BALLS = ThrowConfig(first_delay=(100.0, 100.0))
EVERYTHING = RandomizationConfig(
    link_mass=(0.8, 1.2),
    friction=(0.5, 1.0),
    gains=(0.8, 1.2),
    torque_limit=(0.7, 1.0),
    delay_steps=(0, 2),
    push_speed=(0.5, 1.0),
    push_interval=(0.1, 0.2),
)
JOINTS = len(H1_2.joints)


def make(num_envs: int = 4, hold: bool = False, **ranges) -> DodgeballEnv:
    return DodgeballEnv(
        H1_2,
        DodgeballConfig(
            throws=NO_BALLS,
            randomization=RandomizationConfig(**ranges),
            start_joint_noise=0.0,
        ),
        num_envs=num_envs,
        seed=5,
        hold=hold,
    )


def model_of(env: DodgeballEnv, row: int) -> mujoco.MjModel:
    """Return the model with which MuJoCo simulates a row."""
    assert isinstance(env.physics, MujocoPhysics)
    return env.physics._batch.get_model(row)


def play(env: DodgeballEnv, steps: int, root=None):
    """Return the states under fixed flailing actions, ``[T]``, and the root."""
    root = env.reset() if root is None else root
    states = []
    for step in range(steps):
        angle = torch.arange(JOINTS) + 0.3 * step
        root["action"] = angle.sin().expand(env.batch_size[0], JOINTS).clone()
        one, root = env.step_and_maybe_reset(root)
        states.append(one["next"].clone())
    return torch.stack(states), root


def test_without_randomisation_nothing_is_expanded_or_remembered():
    env = make()
    play(env, 3)
    assert not env.physics._batch._expanded
    assert not env.randomization.state
    assert standard_of(env.config) == "custom"


def test_a_row_has_the_robot_that_its_variation_says():
    env = make(8, link_mass=(0.5, 2.0), friction=(0.1, 1.0), torque_limit=(0.2, 1.5))
    env.reset()
    scene = env.physics.model
    own = env.randomization.variation(*env._draws_of(torch.arange(8)))
    for row in range(8):
        model = model_of(env, row)
        for i, link in enumerate(H1_2.links):
            ratio = model.body(link).mass / scene.body(link).mass
            assert ratio == pytest.approx(float(own.link_mass[row, i]), rel=1e-6)
            ratio = model.body(link).inertia / scene.body(link).inertia
            assert ratio == pytest.approx(float(own.link_mass[row, i]), rel=1e-6)
        ratio = model.geom("floor").friction / scene.geom("floor").friction
        assert ratio == pytest.approx(float(own.friction[row]), rel=1e-6)
        for i, joint in enumerate(H1_2.joints):
            limit = H1_2.torque_limit[i] * float(own.torque_limit[row, i])
            low, high = model.actuator(joint).forcerange
            assert (-low, high) == pytest.approx((limit, limit), rel=1e-6)
            high = model.jnt_actfrcrange[model.joint(joint).id, 1]
            assert high == pytest.approx(limit, rel=1e-6)
        # Quantities derived from the masses change with them.
        mass = model.body_mass[model.body("pelvis").id :][: len(H1_2.links)].sum()
        assert model.body("pelvis").subtreemass == pytest.approx(mass)
    assert own.link_mass.std() > 0.1
    assert 0.5 <= own.link_mass.min() < own.link_mass.max() <= 2.0


def assert_uniform_and_independent(shares: torch.Tensor) -> None:
    """Assert that columns ``[n, k]`` are uniform in [0, 1], each on its own."""
    n = len(shares)
    assert (shares.amin(0) >= -1e-5).all()
    assert (shares.amin(0) < 0.01).all()
    assert (shares.amax(0) <= 1 + 1e-5).all()
    assert (shares.amax(0) > 0.99).all()
    # The correlation of n independent pairs has standard deviation 1/sqrt(n).
    correlation = np.corrcoef(shares.T.double().numpy())
    assert np.abs(correlation - np.eye(shares.shape[1])).max() < 5 / math.sqrt(n)


def test_every_factor_has_a_draw_of_its_own_in_each_episode():
    ranges = {
        "link_mass": (0.5, 2.0),
        "friction": (0.1, 1.0),
        "gains": (0.8, 1.3),
        "torque_limit": (0.2, 0.9),
    }
    config = RandomizationConfig(**ranges, delay_steps=(0, 100))
    drawn = Randomization(config, 4096, 3, 2, 60.0, torch.device("cpu"))
    row, physics, shares = torch.arange(4096), Mock(), []
    for episode in (0, 1):
        drawn.start(physics, row, 5, row, 0 * row + episode)
        _, robot = physics.vary.call_args.args
        for name, (low, high) in ranges.items():
            factor = getattr(robot, name).reshape(4096, -1)
            shares.append((factor - low) / (high - low))
        shares.append(drawn.state["delay"][:, None] / 100)
    # 3 links, friction, gains and limits of 2 joints, and the delay; two episodes.
    assert sum(x.shape[1] for x in shares) == 2 * (3 + 1 + 2 + 2 + 1)
    assert_uniform_and_independent(torch.cat(shares, 1))


def test_gains_scale_stiffness_and_damping_alike():
    env = make(gains=(1.5, 1.5))
    env.reset()
    kp, kd = H1_2.joint_gains(None)
    model = model_of(env, 2)
    for i, joint in enumerate(H1_2.joints):
        assert model.actuator(joint).gainprm[0] == pytest.approx(1.5 * kp[i])
        bias = model.actuator(joint).biasprm[1:3]
        assert bias == pytest.approx([-1.5 * kp[i], -1.5 * kd[i]])


def test_actions_come_late_by_whole_steps():
    plain, _ = play(make(), 12)
    for delay in (1, 2):
        late, _ = play(make(delay_steps=(delay, delay)), 12)
        # No action takes effect before the delay; then the first one does.
        env = make()
        root = env.reset()
        for step in range(12):
            angle = torch.arange(JOINTS) + 0.3 * (step - delay)
            action = angle.sin() if step >= delay else torch.zeros(JOINTS)
            root["action"] = action.expand(4, JOINTS).clone()
            one, root = env.step_and_maybe_reset(root)
            assert torch.equal(one["next", "joint_pos"], late[step]["joint_pos"])
        assert not torch.equal(late["joint_pos"], plain["joint_pos"])


def test_what_is_observed_and_paid_for_is_the_action_chosen_however_late_it_acts():
    env = make(delay_steps=(2, 2))
    root, before = env.reset(), torch.zeros(4, JOINTS)
    weight = env.config.reward.action_rate
    for action in torch.randn(4, 4, JOINTS, generator=torch.Generator().manual_seed(0)):
        step, root = env.step_and_maybe_reset(root.set("action", action))
        assert torch.equal(root["previous_action"], action)
        paid = step["next", "reward_terms"][:, TERMS.index("action_rate")]
        change = (action - before).square().mean(-1)
        torch.testing.assert_close(paid, weight * change)
        before = action


def test_delays_of_a_range_all_occur_and_last_an_episode():
    env = make(300, delay_steps=(0, 2))
    env.reset()
    delay = env.randomization.state["delay"].clone()
    counts = torch.bincount(delay, minlength=3)
    assert (counts > 70).all()
    play_one = env.reset()
    play_one["action"] = torch.zeros(300, JOINTS)
    before = env.randomization.state["delay"].clone()
    env.step(play_one)
    assert torch.equal(env.randomization.state["delay"], before)
    # Another episode, another delay.
    assert not torch.equal(before, delay)


def test_a_push_changes_the_velocity_of_the_base_by_its_speed():
    env, plain = make(push_speed=(0.8, 0.8), push_interval=(0.05, 0.05)), make()
    for one in (env, plain):
        one.reset()
    due = env.randomization.state["next_push_step"]
    # 0.05 s x 60 Hz.
    assert due.tolist() == [3] * 4
    before = env.physics.read().base_lin_vel_w
    rows = torch.arange(4)
    env.randomization.push(env.physics, rows, *env._draws_of(rows))
    change = env.physics.read().base_lin_vel_w - before
    assert change.norm(dim=-1).tolist() == pytest.approx([0.8] * 4, rel=1e-5)
    assert not change[:, 2].any()
    assert len({tuple(row) for row in change.tolist()}) == 4
    assert due.tolist() == [6] * 4


def test_pushes_come_at_their_step_and_from_everywhere():
    env = make(256, push_speed=(1.0, 1.0), push_interval=(0.05, 0.05))
    root = env.reset()
    for pushes in (0, 0, 0, 1):
        root["action"] = torch.zeros(256, JOINTS)
        root = env.step_mdp(env.step(root))
        assert (env.randomization.state["push"] == pushes).all()
    rows = torch.arange(256)
    before = env.physics.read().base_lin_vel_w
    env.randomization.push(env.physics, rows, *env._draws_of(rows))
    way = (env.physics.read().base_lin_vel_w - before)[:, :2]
    # The mean of 256 directions has a standard deviation of 0.044 in x and y.
    assert (way.mean(0).abs() < 0.2).all()
    assert (way.square().mean(0) - 0.5).abs().max() < 0.15


def test_every_push_has_a_direction_a_speed_and_a_wait_of_its_own():
    config = RandomizationConfig(push_speed=(0.5, 1.5), push_interval=(1.0, 3.0))
    pushed = Randomization(config, 4096, 3, 2, 1000.0, torch.device("cpu"))
    row, physics, shares = torch.arange(4096), Mock(), []
    draws = (5, row, 0 * row)
    pushed.start(physics, row, *draws)
    before = 0 * row
    for _ in range(3):
        at = pushed.state["next_push_step"].clone()
        pushed.push(physics, row, *draws)
        x, y, _ = physics.push.call_args.args[1].unbind(-1)
        turn = torch.atan2(y, x) / (2 * math.pi) % 1
        shares += [((at - before) / 1000 - 1) / 2, turn, torch.hypot(x, y) - 0.5]
        before = at
    assert_uniform_and_independent(torch.stack(shares, 1))


def test_a_robot_that_is_held_is_not_pushed():
    pushes = {"push_speed": (2.0, 2.0), "push_interval": (0.02, 0.02)}
    (one, _), (other, _) = play(make(hold=True, **pushes), 6), play(make(hold=True), 6)
    assert_same(one, other)


def test_an_episode_remembers_nothing_of_the_one_before():
    # Episode 1 after an episode 0 with pushes, and after one that never began.
    used, fresh = (make(**dataclasses.asdict(EVERYTHING)) for _ in range(2))
    play(used, 15)
    assert used.randomization.state["push"].any()
    assert used.randomization.state["late_actions"].any()
    assert_forgets(used, fresh)


def test_a_split_gives_the_same_bits_and_so_does_a_resume():
    config = DodgeballConfig(randomization=EVERYTHING)
    whole, root = play(DodgeballEnv(H1_2, config, num_envs=6, seed=2), 40)
    for offset in (0, 2, 4):
        part, _ = play(
            DodgeballEnv(H1_2, config, num_envs=2, seed=2, row_offset=offset), 40
        )
        for key in ("joint_pos", "base_pose", "torque_saturation"):
            assert torch.equal(part[key], whole[key][:, offset : offset + 2])
    env = DodgeballEnv(H1_2, config, num_envs=6, seed=2, num_threads=2)
    _, root = play(env, 25)
    saved, kept = env.simulation_state(), root.clone()
    rest, _ = play(env, 15, root)
    other = DodgeballEnv(H1_2, config, num_envs=6, seed=2)
    other.reset()
    other.load_simulation_state(saved)
    again, _ = play(other, 15, kept.clone())
    # A worker that resumes some of the rows.
    part = DodgeballEnv(H1_2, config, num_envs=4, seed=2, row_offset=2)
    part.reset()
    part.load_simulation_state(saved)
    rows, _ = play(part, 15, kept[2:].clone())
    for key in ("joint_pos", "base_pose", "torque_saturation", "reward"):
        assert torch.equal(rest[key], again[key])
        assert torch.equal(rest[key][:, 2:], rows[key])


def test_it_is_a_matter_of_training_a_standard_judges_the_model():
    task = DodgeballConfig(randomization=EVERYTHING)
    assert standard_of(task) == "2"
    judged = evaluation_task("2", task)
    assert judged.randomization == RandomizationConfig()


@pytest.mark.parametrize(
    ("ranges", "told"),
    [
        ({"gains": (1.2, 0.8)}, r"gains must be \(low, high\) with low <= high"),
        ({"link_mass": (0.0, 1.0)}, "at least 0.01"),
        ({"delay_steps": (0, 101)}, "at most 100"),
        ({"push_interval": (0.5, 1.0)}, "no effect without push_speed"),
    ],
)
def test_what_is_no_range_is_refused(ranges, told):
    with pytest.raises(ValueError, match=told):
        RandomizationConfig(**ranges)
