"""The task: episodes, contacts, counts and rewards, reproducible for each row."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import check_env_specs

from egoskin.envs.dodgeball import DodgeballConfig, DodgeballEnv
from egoskin.envs.physics import PhysicsConfig
from egoskin.envs.randomization import RandomizationConfig
from egoskin.envs.rewards import TERMS, RewardConfig, reward_terms
from egoskin.envs.throws import ThrowConfig
from egoskin.robots.builtin import H1_2
from egoskin.robots.surface import sample_surface
from throwing import AT_ONCE, assert_forgets, assert_same, wild_actions

JOINTS = len(H1_2.joints)
DEFAULT = torch.from_numpy(H1_2.default_joint_pos).float()
# First balls at different times.
SOON = replace(AT_ONCE, first_delay=(0.0, 0.5))
# Balls that fly to a point 50 m up: they never come back, or land far away.
MISS = replace(AT_ONCE, aim="box", box_height=(50.0, 50.0))
AWAY = (30.0, 0.0, 5.0)


def make(num_envs: int, **options) -> DodgeballEnv:
    """Return an environment with a ball at once; task options are keyword arguments."""
    own = {"seed", "row_offset", "num_threads", "hold"}
    options = {"throws": AT_ONCE, **options}
    kwargs = {k: options.pop(k) for k in own & set(options)}
    return DodgeballEnv(H1_2, DodgeballConfig(**options), num_envs=num_envs, **kwargs)


def advance(env, root: TensorDict, action=None) -> tuple[TensorDict, TensorDict]:
    """Return (output of the step, root of the next step)."""
    if action is None:
        action = torch.zeros(*env.batch_size, JOINTS)
    step, following = env.step_and_maybe_reset(root.set("action", action))
    return step["next"], following


def run(env, actions: torch.Tensor, root: TensorDict | None = None) -> Any:
    """Return steps and roots under given actions, stacked over time."""
    root = env.reset() if root is None else root
    out = []
    for action in actions:
        step, root = advance(env, root, action)
        out.append(TensorDict({"next": step, "root": root}, env.batch_size).clone())
    return torch.stack(out)


def throw(env: DodgeballEnv, ball: int, position, velocity=(0.0, 0, 0), rows=None):
    """Place a ball, in all rows or in some."""
    rows = torch.arange(env.batch_size[0]) if rows is None else torch.tensor(rows)
    env.physics.throw(
        rows,
        0 * rows + ball,
        torch.tensor(np.asarray(position)).float().expand(len(rows), 3),
        torch.tensor(velocity).float().expand(len(rows), 3),
    )


def names(flags: torch.Tensor) -> set[str]:
    return {name for name, flag in zip(H1_2.links, flags, strict=True) if flag}


def test_no_gradient_passes_through_a_step():
    # Nor does an action that requires gradients fail, or leave a graph behind.
    env = make(2)
    action = torch.zeros(2, JOINTS, requires_grad=True)
    after, _ = advance(env, env.reset(), action)
    assert not any(value.requires_grad for value in after.values())
    plain = make(2)
    same, _ = advance(plain, plain.reset())
    assert_same(after, same)


@pytest.mark.parametrize("target_velocity", ["zero", "finite_difference"])
def test_all_numbers_are_float32_whatever_the_default_type_is(target_velocity):
    options = {
        "physics": PhysicsConfig(target_velocity=target_velocity),
        "randomization": RandomizationConfig(delay_steps=(1, 2)),
    }
    actions = wild_actions(3)[:5]
    expected = run(make(3, **options), actions)
    try:
        torch.set_default_dtype(torch.float64)
        env = make(3, **options)
        found = run(env, actions)
        check_env_specs(env)
    finally:
        torch.set_default_dtype(torch.float32)
    assert {key: value.dtype for key, value in found.items(True, True)} == {
        key: value.dtype for key, value in expected.items(True, True)
    }
    assert_same(found, expected)


def test_the_environment_keeps_its_specs():
    check_env_specs(make(6))
    check_env_specs(make(6, throws=ThrowConfig()))
    check_env_specs(make(1, throws=ThrowConfig(num_balls=3)))


# --- reproducibility ------------------------------------------------------------


@pytest.fixture(scope="module")
def whole_run() -> TensorDict:
    """Return 150 steps of 32 rows in one environment."""
    return run(make(32, seed=3, throws=SOON), wild_actions(32))


def test_rows_end_at_different_steps(whole_run):
    # Otherwise the comparisons below would be trivial.
    done = whole_run["next", "done"][..., 0].sum(1)
    assert ((done > 0) & (done < 16)).sum() > 10
    assert whole_run["next", "hit"].any()
    assert whole_run["next", "fallen"].any()


@pytest.mark.parametrize("split", [(16, 16), (8, 8, 8, 8), (5, 27)])
def test_rows_do_not_depend_on_how_they_are_split(whole_run, split):
    actions, parts, offset = wild_actions(32), [], 0
    for rows in split:
        env = make(rows, seed=3, row_offset=offset, throws=SOON)
        parts.append(run(env, actions[:, offset : offset + rows]))
        offset += rows
    assert_same(torch.cat(parts, 1), whole_run)


def test_rows_do_not_depend_on_the_number_of_threads(whole_run):
    again = run(make(32, seed=3, num_threads=2, throws=SOON), wild_actions(32)[:60])
    assert_same(again, whole_run[:60])


def test_another_seed_gives_other_episodes(whole_run):
    other = run(make(32, seed=4, throws=SOON), wild_actions(32)[:31])["next"]
    same = whole_run[:31]["next"]
    assert (other["base_pose"] != same["base_pose"]).any(-1).all()
    # After half a second the first ball is in the air everywhere.
    assert other["object_active"][-1].any(-1).all()
    assert (
        (other["object_pose"][-1] != same["object_pose"][-1]).flatten(1).any(-1).all()
    )
    # By chance one of 31 steps equals that of the other seed.
    waits = other["first_throw_step"] != same["first_throw_step"]
    assert waits.float().mean() > 0.8


def test_set_seed_starts_the_draws_again(whole_run):
    env = make(32, seed=99, throws=SOON)
    run(env, wild_actions(32)[:5])
    env.set_seed(3, static_seed=True)
    assert_same(run(env, wild_actions(32)[:5]), whole_run[:5])


@pytest.mark.parametrize("target_velocity", ["zero", "finite_difference"])
def test_a_saved_state_continues_bit_for_bit(target_velocity):
    physics = PhysicsConfig(target_velocity=target_velocity)
    options = {"physics": physics, "throws": SOON, "seed": 3}
    actions = wild_actions(32)
    first = make(32, **options)
    before = run(first, actions[:40])
    saved, root = first.simulation_state(), before[-1]["root"].clone()
    assert all(len(value) == 32 for value in saved.values())
    after = run(first, actions[40:90], root.clone())
    assert after["next", "done"].any()

    second = make(32, **options)
    second.load_simulation_state(saved)
    assert_same(run(second, actions[40:90], root.clone()), after)
    # A worker takes its own rows from the state of all workers.
    part = make(10, row_offset=7, **options)
    part.load_simulation_state(saved)
    mine = run(part, actions[40:90, 7:17], root[7:17].clone())
    assert_same(mine, after[:, 7:17])


def test_partial_reset_keeps_other_rows():
    env = make(6)
    root = run(env, wild_actions(6)[:20])[-1]["root"]
    physics, episode = env.physics.state(), env.simulation_state()["episode"]
    mask = torch.tensor([False, True, False, False, True, False])
    after = env.reset(root.clone().set("_reset", mask[:, None]))
    for key in root.keys():
        assert torch.equal(after[key][~mask], root[key][~mask]), key
    assert torch.equal(env.physics.state()[~mask], physics[~mask])
    assert torch.equal(env.simulation_state()["episode"], episode + mask)
    assert not after["episode_step"][mask].any()
    assert (after["base_pose"][mask, :2] == 0).all()


def test_an_episode_remembers_nothing_of_the_one_before():
    # Episode 1 after a wild episode 0, and after an episode 0 that never began.
    used, fresh = make(6), make(6)
    root = used.reset()
    for action in wild_actions(6)[:25]:
        root = used.step(root.set("action", action))["next"]
    assert_forgets(used, fresh)


# --- start ----------------------------------------------------------------------


def test_an_episode_starts_standing_at_the_origin_with_a_ball_in_the_air():
    root = make(512, start_joint_noise=0.1).reset()
    height = torch.tensor([0, 0, H1_2.default_base_height])
    torch.testing.assert_close(root["base_pose"][:, :3], height.expand(512, 3))
    noise = root["joint_pos"] - DEFAULT
    assert 0.099 < noise.max() <= 0.1 + 1e-6
    assert -0.1 - 1e-6 <= noise.min() < -0.099
    # Upright, heading uniform: quaternion (cos a/2, 0, 0, sin a/2).
    w, x, y, z = root["base_pose"][:, 3:].unbind(-1)
    assert not x.any()
    assert not y.any()
    angle = 2 * torch.atan2(z, w)
    assert angle.cos().mean().abs() < 5 / (2 * 512) ** 0.5
    assert angle.sin().mean().abs() < 5 / (2 * 512) ** 0.5
    for key in ("base_lin_vel_w", "base_ang_vel_b", "joint_vel", "previous_action"):
        assert not root[key].any()
    assert (root["object_active"] == torch.tensor([True, False])).all()
    assert (root["object_pose"][:, 0, 2] >= 2).all()


def waiting_for(env: DodgeballEnv) -> torch.Tensor:
    """Return the steps before the first ball, from the draws of episode 0."""
    row = torch.arange(env.batch_size[0])
    return (60 * env.thrower.first_delay(env._seed, row, row * 0)).round().long()


def test_no_ball_is_in_play_before_the_first_is_thrown_at_the_step_drawn():
    throws = replace(MISS, first_delay=(0.1, 0.5))
    env = make(64, hold=True, throws=throws)
    root, delay = env.reset(), waiting_for(env)
    # .1 to .5 s at 60 Hz
    assert set(delay.tolist()) <= set(range(6, 31))
    assert delay.unique().numel() > 15
    parked = root["object_pose"].clone()
    active = []
    for age in range(31):
        assert torch.equal(root["first_throw_step"][:, 0], delay)
        thrown = delay <= age
        assert torch.equal(root["object_active"].any(-1), thrown)
        # The other ball waits; both do until then, out of reach and at rest.
        assert not root["object_active"][:, 1].any()
        assert torch.equal(root["object_pose"][~thrown], parked[~thrown])
        assert not root["object_lin_vel_w"][~thrown].any()
        new = delay == age
        assert (root["object_pose"][new, 0, 2] >= 2).all()
        assert not root["balls_arrived"].any()
        active.append(root["object_active"][:, 0].clone())
        _, root = advance(env, root)
    assert torch.stack(active).sum(0).tolist() == (31 - delay).tolist()
    assert (parked[..., 2] > 900).all()


def test_the_throws_are_the_same_whatever_the_delay():
    # Robots are held, so the targets do not move.
    throws = replace(MISS, interval=(0.2, 0.4))
    at_once, late = (
        make(16, hold=True, throws=replace(throws, first_delay=delay))
        for delay in ((0.0, 0.0), (0.2, 0.6))
    )
    first = [run(e, torch.zeros(100, 16, JOINTS))["root"] for e in (at_once, late)]
    delay = waiting_for(late)
    assert delay.unique().numel() > 8
    for row in range(16):
        # The root of the first action is step 1.
        wait = int(delay[row])
        one, other = first[0][: 100 - wait, row], first[1][wait:, row]
        for key in ("object_pose", "object_lin_vel_w", "object_active"):
            torch.testing.assert_close(other[key], one[key], atol=1e-4, rtol=1e-5)


def test_the_age_limit_and_the_counts_begin_with_the_first_throw(chest):
    throws = replace(MISS, first_delay=(0.1, 0.2))
    env = make(8, hold=True, throws=throws, episode_length_s=0.5)
    root, delay = env.reset(), waiting_for(env)
    assert delay.unique().numel() > 2
    for age in range(1, 44):
        if (root["episode_step"][:, 0] < age - 1).all():
            break
        step, root = advance(env, root)
        own = step["episode_step"][:, 0] == age
        # .5 s after the first throw.
        assert torch.equal(step["truncated"][own, 0], (age == delay + 30)[own])
        assert not step["terminated"].any()
    assert age > int(delay.max()) + 30

    # The first ball of an episode counts as first, however late it comes.
    env = make(8, hold=True, throws=throws)
    root, delay = env.reset(), waiting_for(env)
    for _ in range(12):
        step, root = advance(env, root)
        assert not step["done"].any()
    assert (env.simulation_state()["is_first"] == torch.tensor([True, False])).all()
    touch(env, root, chest)
    step, _ = advance(env, root)
    assert step["hit"].all()
    assert (step["balls_arrived"] == torch.tensor([1.0, 0])).all()


def test_a_robot_that_falls_before_the_first_throw_starts_again_with_a_wait():
    env = make(8, throws=replace(AT_ONCE, first_delay=(5.0, 6.0)))
    actions, root = wild_actions(8), env.reset()
    delay = root["first_throw_step"].clone()
    ended = torch.zeros(8, dtype=torch.bool)
    for action in actions:
        step, root = advance(env, root, 2 * action)
        assert not step["object_active"].any()
        done = step["done"][:, 0]
        assert step["fallen"][done].all()
        # The end is reported with the wait of the episode that ended.
        assert (step["first_throw_step"][~ended] == delay[~ended]).all()
        ended |= done
    assert ended.all()
    assert (root["first_throw_step"] != delay).float().mean() > 0.7
    assert not root["balls_arrived"].any()


def test_a_partial_reset_draws_the_wait_of_those_rows_alone():
    env = make(6, hold=True, throws=replace(MISS, first_delay=(0.1, 0.5)))
    root = run(env, torch.zeros(10, 6, JOINTS))[-1]["root"]
    mask = torch.tensor([False, True, False, False, True, False])
    after = env.reset(root.clone().set("_reset", mask[:, None]))
    row = torch.arange(6)
    drawn = env.thrower.first_delay(0, row, mask.long())
    expected = (60 * drawn).round().long()[:, None]
    assert torch.equal(after["first_throw_step"], expected)
    assert not after["object_active"][mask].any()
    for _ in range(30):
        step, after = advance(env, after)
    flown = step["object_active"][:, 0]
    assert flown.all()


def test_a_state_saved_during_the_wait_continues_bit_for_bit():
    options = {"throws": replace(AT_ONCE, first_delay=(0.2, 0.6)), "seed": 3}
    actions = wild_actions(32)
    first = make(32, **options)
    before = run(first, actions[:11])
    waiting = ~before[-1]["root", "object_active"].any(-1)
    assert waiting.all()
    saved, root = first.simulation_state(), before[-1]["root"].clone()
    after = run(first, actions[11:60], root.clone())
    assert after[-1]["next", "object_active"].any(-1).float().mean() > 0.8
    second = make(32, **options)
    second.load_simulation_state(saved)
    assert_same(run(second, actions[11:60], root.clone()), after)


# --- diverged rows --------------------------------------------------------------


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e12, 500.0])
def test_a_diverged_row_is_reset_alone(value, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # MuJoCo writes its log where the process runs
    actions, row = wild_actions(6)[:40], 2
    others = torch.arange(6) != row
    reference, env = make(6), make(6)
    expected, start = run(reference, actions), run(env, actions[:10])
    env.physics._qvel[row, 8] = value
    got = run(env, actions[10:], start[-1]["root"])

    bad = got[0]["next"]
    assert bad["diverged"][:, 0].tolist() == (~others).tolist()
    assert bad["terminated"][row]
    assert not bad["truncated"][row]
    # No other event is reported: contacts of a diverged row are meaningless.
    assert not bad["hit"][row] | bad["fallen"][row] | bad["object_hit"][row].any()
    for key in ("balls_arrived", "balls_avoided"):
        assert not bad[key][row].any()
    for key, tensor in got.items(True, True):
        assert tensor.isfinite().all(), key
    # A new episode, for this row only, that continues like any other.
    assert got[0]["root", "episode_step"][row] == 0
    assert not got["next", "diverged"][1:].any()
    assert (env.simulation_state()["episode"] >= ~others).all()
    assert_same(got[:, others], expected[10:, others])


@pytest.mark.parametrize("value", [np.nan, 1e12, 500.0])
def test_the_reward_of_a_diverged_row_is_bounded(value, tmp_path, monkeypatch):
    # Non-physical speeds would outweigh all other rewards.
    monkeypatch.chdir(tmp_path)
    env = make(4)
    root = env.reset()
    env.physics._qvel[1, 8] = value
    step, _ = advance(env, root)
    assert step["diverged"][1]
    assert -1 < step["reward"][1] < 0.2


# --- end ------------------------------------------------------------------------


@pytest.fixture(scope="module")
def chest() -> tuple[np.ndarray, np.ndarray]:
    """Return a point on the front of the torso and its normal, in the base frame."""
    # The torso's frame is the base's while the torso joint is at zero.
    points = sample_surface(H1_2, ["torso_link"], 2000, seed=0)
    ahead = points.position[:, 0] + 0.0
    ahead[(np.abs(points.position[:, 1]) > 0.05) | (points.normal[:, 0] < 0.9)] = -9
    best = int(ahead.argmax())
    return points.position[best], points.normal[best]


def touch(env: DodgeballEnv, root, chest, ball=0) -> None:
    """Place a ball against the torso in every row; the robots stand upright."""
    point, normal = chest
    x, y, z = point + 0.14 * normal
    w, *_, q = root["base_pose"][:, 3:].double().unbind(-1)
    c, s = w * w - q * q, 2 * w * q
    place = torch.stack((c * x - s * y, s * x + c * y, z + 0 * c), -1)
    place = place + root["base_pose"][:, :3]
    rows = torch.arange(len(root))
    env.physics.throw(rows, 0 * rows + ball, place, torch.zeros_like(place))


def test_a_ball_that_touches_ends_the_episode_as_a_hit(chest):
    env = make(4, hold=True, throws=MISS)
    root = env.reset()
    touch(env, root, chest)
    step, root = advance(env, root)
    assert step["hit"].all()
    assert step["terminated"].all()
    assert not step["fallen"].any()
    assert not step["truncated"].any()
    assert all(names(row) >= {"torso_link"} for row in step["tactile"])
    assert (root["episode_step"] == 0).all()


def test_a_robot_that_lies_down_ends_the_episode_as_fallen():
    env = make(8, throws=MISS)
    root = env.reset()
    # Hips and knees drive the robot to the ground.
    action = torch.zeros(8, JOINTS)
    for i, name in enumerate(H1_2.joints):
        if "hip_pitch" in name:
            action[:, i] = -2.0
    ends = []
    for _ in range(150):
        step, root = advance(env, root, action)
        ends.append(step)
    ends = torch.stack(ends)
    done = ends["done"][..., 0]
    assert done.any(0).all()
    assert ends["fallen"][done].all()
    assert ends["terminated"][done].all()
    assert not ends["hit"].any()
    feet = torch.tensor([name in H1_2.feet for name in H1_2.links])
    assert ends["tactile"][done][:, ~feet].any(-1).all()


def test_the_ends_are_told_apart(whole_run):
    step = whole_run["next"]
    terminated = step["hit"] | step["fallen"] | step["diverged"]
    assert torch.equal(step["terminated"], terminated)
    assert torch.equal(step["done"], terminated | step["truncated"])
    assert not (step["terminated"] & step["truncated"]).any()


def test_an_episode_is_truncated_at_its_length_and_not_terminated():
    # .5 s at 60 Hz: 30 steps.
    # The second ball is due in the last step, and is thrown no more.
    throws = replace(MISS, interval=(0.5, 0.5))
    env = make(4, hold=True, throws=throws, episode_length_s=0.5)
    root = env.reset()
    for age in range(1, 31):
        step, root = advance(env, root)
        assert (step["episode_step"] == age).all()
        assert (step["truncated"] == (age == 30)).all()
        assert (step["done"] == (age == 30)).all()
        assert not step["terminated"].any()
    assert (step["object_active"] == torch.tensor([True, False])).all()
    assert (root["episode_step"] == 0).all()


def test_a_hit_in_the_last_step_terminates(chest):
    throws = replace(MISS, interval=(0.1, 0.1))
    env = make(2, hold=True, throws=throws, episode_length_s=0.1)
    root = env.reset()
    for _ in range(5):
        _, root = advance(env, root)
    touch(env, root, chest)
    step, _ = advance(env, root)
    assert (step["episode_step"] == 6).all()
    assert step["terminated"].all()
    assert not step["truncated"].any()
    # The ball that was due is not thrown.
    assert (step["object_active"] == torch.tensor([True, False])).all()


@pytest.mark.parametrize("ends", [False, True])
def test_self_contact_ends_an_episode_only_if_asked(ends):
    env = make(2, hold=True, throws=MISS, self_contact_ends=ends)
    root = env.reset()
    # The left arm of row 0 is inside the trunk, as it is below -0.2 rad.
    joint_pos = DEFAULT.clone()
    joint_pos[H1_2.joints.index("left_shoulder_roll_joint")] = -0.4
    env.physics.reset(torch.tensor([0]), root["base_pose"][:1], joint_pos[None])
    step, root = advance(env, root)
    assert step["self_contact"][:, 0].tolist() == [True, False]
    assert step["terminated"][:, 0].tolist() == [ends, False]
    for key in ("hit", "fallen", "diverged", "truncated"):
        assert not step[key].any()
    # The last step earns no survival reward, as at any other end.
    survival = step["reward_terms"][:, TERMS.index("survival")]
    assert (survival == 0).tolist() == [ends, False]
    assert root["episode_step"][:, 0].tolist() == [0 if ends else 1, 1]


def test_feet_on_the_floor_are_what_a_standing_robot_feels():
    env = make(2, throws=MISS)
    root = env.reset()
    assert not root["tactile"].any()
    for _ in range(6):
        step, root = advance(env, root)
    feet = {"left_ankle_roll_link", "right_ankle_roll_link"}
    assert [names(row) for row in step["tactile"]] == [feet, feet]


# --- balls ----------------------------------------------------------------------


def test_balls_are_thrown_in_turn_at_the_intervals_drawn():
    # Miss throws at 4 to 8 m/s never land in time: a throw shows as a jump.
    throws = replace(MISS, interval=(0.2, 0.5))
    env = make(16, hold=True, throws=throws, episode_length_s=5.0)
    steps = run(env, torch.zeros(150, 16, JOINTS))["next"]
    place = steps["object_pose"][..., :3]
    jump = (place[1:] - place[:-1]).norm(dim=-1) > 1.0  # a step is 13 cm of flight
    assert jump.sum(-1).max() == 1
    for row in range(16):
        at, ball = jump[:, row].nonzero().T
        # Balls 1, 0, 1, ... after the first, which is thrown at the start.
        assert ball.tolist() == [(i + 1) % 2 for i in range(len(ball))]
        gaps = (at + 2).diff(prepend=torch.zeros(1, dtype=torch.int64))
        # .2 to .5 s at 60 Hz
        assert gaps.min() >= 12
        assert gaps.max() <= 30
        # The interval is the one drawn with the previous throw.
        index = torch.arange(len(gaps))
        same = torch.full_like(index, row)
        drawn = env.thrower.draw(0, same, same * 0, index)
        assert torch.equal(gaps, (60 * drawn.interval).round().long())


def test_a_ball_on_the_ground_is_out_of_play_until_thrown_again(chest):
    throws = replace(MISS, interval=(0.5, 0.5), num_balls=1)
    env = make(4, hold=True, throws=throws)
    root = env.reset()
    throw(env, 0, (3.0, 3.0, 0.17), (0.0, 0, -3.0))
    step, root = advance(env, root)
    assert not step["object_active"].any()
    # Placed against the robot, it is moved out of reach before it can touch.
    touch(env, root, chest)
    step, root = advance(env, root)
    assert not step["hit"].any()
    assert (step["object_pose"][:, 0, 2] > 900).all()
    for _ in range(28):
        step, root = advance(env, root)
    assert (step["episode_step"] == 30).all()
    assert step["object_active"].all()
    assert (step["object_pose"][:, 0, 2] < 5).all()
    touch(env, root, chest)
    assert advance(env, root)[0]["hit"].all()


def counts(step: TensorDict) -> list[list[float]]:
    """Return [[arrived first, later], [avoided first, later]] of row 0."""
    return [step["balls_arrived"][0].tolist(), step["balls_avoided"][0].tolist()]


def test_each_ball_is_told_apart_until_it_is_thrown_again(chest):
    throws = replace(MISS, interval=(0.1, 0.1), num_balls=2)
    env = make(1, hold=True, throws=throws)
    root = env.reset()
    assert not root["object_arrived"].any()
    throw(env, 0, (2.0, 0, 1.5), (5.0, 0, 0))
    for _ in range(7):  # ball 1 is thrown at step 6
        step, root = advance(env, root)
    assert step["object_arrived"].tolist() == [[True, False]]
    for _ in range(5):  # ball 0 is thrown again at step 12, where the flag is the old
        step, root = advance(env, root)
    assert step["object_arrived"].tolist() == [[True, False]]
    touch(env, root, chest)
    throw(env, 1, AWAY, (0.0, 0, 0))
    step, _ = advance(env, root)
    assert step["object_hit"].tolist() == [[True, False]]
    assert step["object_arrived"].tolist() == [[True, False]]
    # Thrown again, the first ball is a later one.
    assert counts(step) == [[1, 1], [1, 0]]


def test_first_and_later_balls_are_counted_once_as_arrived_and_avoided(chest):
    throws = replace(MISS, interval=(0.1, 0.1), num_balls=3)
    env = make(1, hold=True, throws=throws)
    root = env.reset()
    # The first ball flies off at 2 m from the base: it has passed.
    throw(env, 0, (2.0, 0, 1.5), (5.0, 0, 0))
    step, root = advance(env, root)
    assert counts(step) == [[1, 0], [1, 0]]
    # Landing later, it is not counted again.
    throw(env, 0, (2.5, 0, 0.16), (0.0, 0, -3))
    step, root = advance(env, root)
    assert not step["object_active"][0, 0]
    assert counts(step) == [[1, 0], [1, 0]]
    while root["episode_step"] < 6:
        step, root = advance(env, root)
    # The second ball is in the air. Within a metre it has not passed yet, ...
    throw(env, 1, (0.0, 0.8, 2.5), (0.0, 3, 0))
    step, root = advance(env, root)
    assert counts(step) == [[1, 0], [1, 0]]
    # ... nor while it approaches; when it lands, it has.
    throw(env, 1, (0.0, 2.0, 0.5), (0.0, -3, 0))
    step, root = advance(env, root)
    assert counts(step) == [[1, 0], [1, 0]]
    throw(env, 1, (0.0, 2.0, 0.16), (0.0, -3, -3))
    step, root = advance(env, root)
    assert counts(step) == [[1, 1], [1, 1]]
    while root["episode_step"] < 12:
        step, root = advance(env, root)
    # The third touches: arrived, not avoided.
    touch(env, root, chest, ball=2)
    step, root = advance(env, root)
    assert step["hit"].all()
    assert counts(step) == [[1, 2], [1, 1]]
    assert counts(root) == [[0, 0], [0, 0]]


def test_a_ball_passes_the_base_wherever_it_is_and_however_fast():
    # A robot far from the origin, in the air, that flies along x at 3 m/s.
    env = make(4, throws=MISS)
    root, rows = env.reset(), torch.arange(4)
    base = torch.tensor([5.0, -3, 3, 1, 0, 0, 0]).expand(4, 7)
    env.physics.reset(rows, base, DEFAULT.expand(4, -1))
    env.physics.push(rows, torch.tensor([3.0, 0, 0]).expand(4, 3))
    # Distance ahead of the base [m] and speed [m/s] of a ball, and whether it passes:
    balls = [
        (0.8, 6.0, False),  # not a metre away
        (1.5, 6.0, True),
        (1.5, 1.0, False),  # the robot catches up with it
        (-1.5, 1.0, True),  # the robot leaves it behind
    ]
    for row, (ahead, speed, _) in enumerate(balls):
        throw(env, 0, (5 + ahead, -3.0, 3.0), (speed, 0, 0), rows=[row])
    step, _ = advance(env, root)
    assert not step["done"].any()
    assert step["object_arrived"][:, 0].tolist() == [passes for *_, passes in balls]


def test_a_hit_by_the_first_ball_is_arrived_and_not_avoided(chest):
    env = make(1, hold=True, throws=MISS)
    root = env.reset()
    touch(env, root, chest)
    step, _ = advance(env, root)
    assert counts(step) == [[1, 0], [0, 0]]


# --- actuation ------------------------------------------------------------------


def test_an_action_is_a_position_target_scaled_by_torque_over_stiffness():
    # One substep, so that the torque belongs to the state the action was chosen in.
    config = PhysicsConfig(substeps=1, control_hz=120)
    env = make(8, physics=config, throws=MISS, action_scale=0.25)
    kp, kd = (torch.from_numpy(g) for g in H1_2.joint_gains(config.gains))
    limit = torch.from_numpy(H1_2.torque_limit)
    root = env.reset()
    clipped = 0
    for action in 6 * wild_actions(8)[:10]:
        target = DEFAULT + 0.25 * limit / kp * action
        wanted = kp * (target - root["joint_pos"]) - kd * root["joint_vel"]
        _, root = advance(env, root, action)
        torque = torch.from_numpy(env.physics._torque.copy())
        alive = root["episode_step"][:, 0] > 0
        expected = wanted.clamp(-limit, limit)
        torch.testing.assert_close(torque[alive], expected[alive], atol=2e-2, rtol=1e-4)
        assert (torque.abs() <= limit + 1e-9).all()
        clipped += (wanted.abs() > limit).sum()
    assert clipped > 0


def test_the_previous_action_is_the_one_before():
    env = make(3, throws=MISS)
    root, actions = env.reset(), wild_actions(3)[:3]
    for action in actions:
        _, root = advance(env, root, action)
        assert torch.equal(root["previous_action"], action)


# --- reward ---------------------------------------------------------------------


def terms_by_hand(**changes) -> dict[str, float]:
    values = {
        "gravity_b": torch.tensor([[0.3, -0.1, -0.9]]),
        "joint_deviation": torch.tensor([[1.0, -2, 0, 1]]),
        "power": torch.tensor([500.0]),
        "base_lin_vel_w": torch.tensor([[3.0, -4, 7]]),
        "displacement_w": torch.tensor([[1.0, 0.5]]),
        "action_change": torch.tensor([[2.0, 0, 0, -2]]),
        "terminated": torch.tensor([False]),
    }
    weights = dict.fromkeys(TERMS, 1.0)
    terms = reward_terms(RewardConfig(**weights), **{**values, **changes})
    assert terms.shape == (1, len(TERMS))
    return dict(zip(TERMS, terms[0].tolist(), strict=True))


def test_reward_terms_by_hand():
    assert terms_by_hand() == pytest.approx(
        {
            "survival": 1.0,
            "upright": np.exp(-0.5),  # (.09 + .01) / .2
            "posture": 1.5,  # (1 + 4 + 0 + 1) / 4
            "energy": 500.0,
            "drift_speed": 25.0,  # 9 + 16, the vertical not counted
            "drift_distance": 1.25,
            "action_rate": 2.0,  # (4 + 4) / 4
        }
    )


def test_the_end_pays_no_survival():
    assert terms_by_hand(terminated=torch.tensor([True]))["survival"] == 0


def test_drift_distance_stops_growing_at_two_metres():
    terms = terms_by_hand(displacement_w=torch.tensor([[30.0, 40.0]]))
    assert terms["drift_distance"] == 4


def test_the_reward_is_the_sum_of_weighted_terms(whole_run):
    step = whole_run["next"]
    total = step["reward_terms"].sum(-1, keepdim=True)
    assert torch.equal(step["reward"], total)
    config = RewardConfig()
    terms = dict(zip(TERMS, step["reward_terms"].unbind(-1), strict=True))
    ended = step["terminated"][..., 0].float()
    torch.testing.assert_close(terms["survival"], config.survival * (1 - ended))
    speed = step["base_lin_vel_w"][..., :2].square().sum(-1)
    torch.testing.assert_close(terms["drift_speed"], config.drift_speed * speed)
    bent = (step["joint_pos"] - DEFAULT).square().mean(-1)
    torch.testing.assert_close(terms["posture"], config.posture * bent)
    power = step["power"][..., 0]
    assert power.max() > 100
    torch.testing.assert_close(terms["energy"], config.energy * power)
    # Episodes start at the origin.
    way = step["base_pose"][..., :2].square().sum(-1).clamp(max=4.0)
    torch.testing.assert_close(terms["drift_distance"], config.drift_distance * way)
    w, x, y, z = step["base_pose"][..., 3:].unbind(-1)
    # Components of the base's axes x and y along the vertical.
    tilt = 4 * ((x * z - w * y).square() + (y * z + w * x).square())
    upright = config.upright * (-tilt / 0.2).exp()
    torch.testing.assert_close(terms["upright"], upright, rtol=1e-4, atol=1e-7)
    # The change is from the root's previous action to the action taken.
    before = torch.cat(
        (torch.zeros(1, 32, JOINTS), whole_run["root", "previous_action"][:-1])
    )
    change = (wild_actions(32) - before).square().mean(-1)
    torch.testing.assert_close(terms["action_rate"], config.action_rate * change)


def test_the_reward_does_not_depend_on_balls_that_do_not_touch():
    one, other = make(8), make(8)
    root, other_root = one.reset(), other.reset()
    for action in wild_actions(8)[:12]:
        throw(other, 0, AWAY)
        step, root = advance(one, root, action)
        other_step, other_root = advance(other, other_root, action)
        assert not step["done"].any()
        torch.testing.assert_close(step["reward"], other_step["reward"])
        # The balls share the solver with the robot: equal to its tolerance.
        torch.testing.assert_close(
            step["reward_terms"], other_step["reward_terms"], atol=1e-5, rtol=1e-4
        )


# --- errors ---------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"action_scale": 0.0}, "action_scale must be positive, got 0.0"),
        ({"episode_length_s": 0.01}, "at least one control step, got 0.01"),
        ({"episode_length_s": float("inf")}, "must be a finite number, got inf"),
        ({"episode_length_s": 1e8}, "must be at most 3,600, got 100000000.0"),
        ({"start_joint_noise": -0.1}, "start_joint_noise must not be negative"),
    ],
)
def test_a_task_that_makes_no_episode_is_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        DodgeballConfig(**changes)


@pytest.mark.parametrize("scale", [1.0, 0.3])
def test_position_targets_of_an_action_by_hand(scale):
    config = DodgeballConfig(physics=PhysicsConfig(gains="real"), action_scale=scale)
    env = DodgeballEnv(H1_2, config, num_envs=2)
    td = env.reset()
    td["action"] = torch.full((2, 21), 0.5)
    env.step(td)
    joint = H1_2.joints.index("left_ankle_roll_joint")
    # Ankle roll, gain set "real": 40 N m at 40 N m/rad; not clipped to its +-0.26 rad.
    assert env.physics._ctrl[0, joint] == pytest.approx(0.5 * scale * 40 / 40, abs=1e-6)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"num_envs": 0}, "num_envs must be at least 1, got 0"),
        ({"num_threads": 0}, "num_threads must be at least 1, got 0"),
        ({"row_offset": -1}, "row_offset must not be negative, got -1"),
        ({"row_offset": 2**32 - 1}, "row_offset must be at most 4,294,967,294"),
        ({"seed": -1}, r"seed must be in \[0, 2\*\*32\), got -1"),
    ],
)
def test_numbers_out_of_bounds_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        make(**{"num_envs": 2, **options})
