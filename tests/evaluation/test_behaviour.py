"""Behaviour of a policy: each ball separately, values by hand, no side effects."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from tensordict import TensorDict

from egoskin.envs.dodgeball import DodgeballConfig
from egoskin.envs.throws import Thrower
from egoskin.evaluation.behaviour import Group, Waiting, Watcher, behave
from egoskin.evaluation.feet import Feet
from egoskin.evaluation.throw_set import Episodes, evaluate, play_throws
from egoskin.make import EnvConfig
from egoskin.rng import held_out
from egoskin.robots.builtin import H1_2
from egoskin.robots.own import find_robot
from egoskin.sensors import MASK_ALL
from egoskin.sensors.config import SensorConfig
from owning import MODEL, write_robot
from throwing import AT_ONCE

JOINTS = len(H1_2.joints)
BLIND = SensorConfig(coverage="none")
# Half of these balls miss the robot held rigid, so that later ones come as well.
BESIDE = replace(AT_ONCE, aim="box", box_half_width=0.8, interval=(0.9, 1.3))
LAST = 64


def make(**task) -> EnvConfig:
    task = {"throws": AT_ONCE, **task}
    return EnvConfig(task=DodgeballConfig(**task), sensor=BLIND)


@pytest.fixture(scope="module")
def rigid() -> tuple[Watcher, Episodes, EnvConfig]:
    """Return results of the rigid robot on a throw set of balls that fly past it."""
    config = make(throws=BESIDE)
    watcher = Watcher(config, 0, LAST)
    skin = config.skin.build(H1_2)
    played = play_throws(
        None, config, skin, throw_set=0, episodes=LAST, hold=True, watch=watcher
    )
    return watcher, played, config


def test_balls_are_those_that_the_environment_counts(rigid):
    watcher, played, _ = rigid
    arrived, hit = watcher._arrived, watcher._hit
    assert torch.equal(arrived[:, :1].sum(1), played.arrived[:, 0].long())
    assert torch.equal(arrived[:, 1:].sum(1), played.arrived[:, 1].long())
    avoided = arrived & ~hit
    assert torch.equal(avoided[:, :1].sum(1), played.avoided[:, 0].long())
    assert torch.equal(avoided[:, 1:].sum(1), played.avoided[:, 1].long())
    assert torch.equal(hit.any(1), played.hit)
    # Both kinds occur, and one ball (or two at once) ends an episode.
    assert 0 < int(hit[:, 0].sum()) < LAST
    assert int(hit[:, 1:].sum()) > 10
    assert int(hit.sum(1).max()) <= 2


def test_groups_of_a_kind_share_out_all_throws(rigid):
    watcher, played, config = rigid
    groups = watcher.groups()
    # Throws into a box aim at no link.
    assert list(groups) == [
        "number of the ball",
        "direction",
        "height aimed at",
        "speed at arrival",
        "since last throw",
    ]
    limit = round(config.task.success_s * config.task.physics.control_hz)
    wins = LAST - int(((played.steps <= limit) & played.hit).sum())
    later_hits = int(watcher._hit[:, 1:].sum())
    for kind in groups.values():
        assert sum(g.episodes for g in kind) == LAST
        assert sum(g.later_balls for g in kind) == played.arrived[:, 1].sum()
        won = (g.success.mean * g.episodes for g in kind if g.success)
        assert sum(won) == pytest.approx(wins)
        hits = sum(g.later_hits * g.later_balls for g in kind if g.later_balls)
        assert hits == pytest.approx(later_hits)


def test_later_balls_are_split_by_the_time_since_the_throw_before(rigid):
    watcher, _, config = rigid
    first, *later = watcher.groups()["since last throw"]
    assert (first.name, first.episodes, first.later_balls) == ("first ball", LAST, 0)
    assert [g.episodes for g in later] == [0, 0, 0]
    arrived = watcher._arrived[:, 1:]
    count = arrived.shape[1]
    row = torch.arange(LAST).repeat_interleave(count)
    thrower = Thrower(config.task.throws, H1_2, config.task.physics.timestep)
    draw = thrower.draw(held_out(0), row, row * 0, torch.arange(count).repeat(LAST))
    # A ball's interval is the time to the next one, in whole control steps.
    gap = (draw.interval.reshape(LAST, count) * 60).round() / 60
    short = later[0]
    assert short.name == "below 1.33 s"
    # These intervals are 0.9 to 1.3 s: all of them.
    assert short.later_balls == int((arrived & (gap <= 1.33)).sum()) > 10


def test_groups_by_the_number_of_the_ball_by_hand(rigid):
    watcher, _, _ = rigid
    first, *later = watcher.groups()["number of the ball"]
    assert [g.name for g in (first, *later)] == ["first", "second", "third", "later"]
    # Every episode has a first ball, and no other group has one.
    assert (first.episodes, first.later_balls, first.later_hits) == (LAST, 0, None)
    assert first.first_hits == pytest.approx(watcher._hit[:, 0].float().mean().item())
    columns = (slice(1, 2), slice(2, 3), slice(3, None))
    for group, column in zip(later, columns, strict=True):
        assert (group.episodes, group.success, group.first_hits) == (0, None, None)
        arrived, hit = watcher._arrived[:, column], watcher._hit[:, column]
        assert group.later_balls == int(arrived.sum())
        if group.later_balls:
            assert group.later_hits == pytest.approx(int(hit.sum()) / arrived.sum())
    assert later[0].later_balls > 10


def test_a_sector_of_throws_is_one_quarter():
    throws = replace(AT_ONCE, aim="body", azimuth_deg=(50.0, 130.0))
    groups = Watcher(make(throws=throws), 0, 16).groups()
    assert [g.episodes for g in groups["direction"]] == [0, 16, 0, 0]
    front = groups["direction"][0]
    assert front == Group(
        name="front",
        success=None,
        episodes=0,
        first_hits=None,
        later_hits=None,
        later_balls=0,
    )
    # Left and right links are counted together.
    names = [g.name for g in groups["link aimed at"]]
    assert "hip_roll" in names
    assert not any("left" in name or "right" in name for name in names)


def test_heights_and_speeds_are_split_at_their_bounds():
    config = make()
    watcher = Watcher(config, 3, 256)
    thrower = Thrower(config.task.throws, H1_2, config.task.physics.timestep)
    row = torch.arange(256)
    draw = thrower.draw(held_out(3), row, row * 0, row * 0)
    height, speed = thrower.at_standing_robot(draw)
    groups = watcher.groups()
    expected = [
        int((height <= 0.9).sum()),
        int(((height > 0.9) & (height <= 1.2)).sum()),
        int((height > 1.2).sum()),
    ]
    assert [g.episodes for g in groups["height aimed at"]] == expected
    assert [g.name for g in groups["height aimed at"]] == [
        "below 0.9 m",
        "0.9 to 1.2 m",
        "above 1.2 m",
    ]
    fast = groups["speed at arrival"][-1]
    assert (fast.name, fast.episodes) == ("above 6.7 m/s", int((speed > 6.7).sum()))


def state(n: int, **values) -> TensorDict:
    """Return states of robots in their default pose, except for some values."""
    pose = torch.tensor([0.0, 0, H1_2.default_base_height, 1, 0, 0, 0])
    never = torch.zeros(n, 1, dtype=torch.bool)
    return TensorDict(
        {
            "base_pose": pose.repeat(n, 1),
            "joint_pos": torch.from_numpy(H1_2.default_joint_pos).float().repeat(n, 1),
            "joint_vel": torch.zeros(n, JOINTS),
            "base_lin_vel_w": torch.zeros(n, 3),
            "displacement_w": torch.zeros(n, 2),
            "tactile": torch.ones(n, len(H1_2.links), dtype=torch.bool),
            "power": torch.zeros(n, 1),
            "torque_saturation": torch.zeros(n, 1),
            "object_hit": never.expand(n, 2),
            "object_arrived": never.expand(n, 2),
            "self_contact": never,
            "terminated": never,
            "first_throw_step": torch.zeros(n, 1, dtype=torch.int64),
            **values,
        },
        batch_size=[n],
    )


def test_motion_by_hand():
    watcher = Watcher(make(), 0, 3)
    after = state(
        3,
        # Row 0 changes all speeds by 0.1 rad/s in 1/60 s: 6 rad/s^2. Row 2 ends here.
        joint_vel=torch.tensor([[0.1], [0.0], [99.0]]).expand(3, JOINTS),
        power=torch.tensor([[10.0], [30], [999]]),
        torque_saturation=torch.tensor([[0.5], [0], [1]]),
        self_contact=torch.tensor([[True], [False], [True]]),
        terminated=torch.tensor([[False], [False], [True]]),
    )
    # Row 0 slides by 1 cm (0.6 m/s); row 1 leaves the floor.
    after["base_pose"][0, 0] += 0.01
    after["base_pose"][1, 2] += 0.1
    after["tactile"][1] = False
    watcher(state(3), after, torch.tensor([True, True, True]))
    motion = watcher.motion()
    assert motion.power == pytest.approx(20)
    assert motion.joint_acceleration == pytest.approx((36 / 2) ** 0.5)
    assert motion.torque_saturation == pytest.approx(0.25)
    assert motion.foot_slip == pytest.approx(0.6, rel=1e-3)
    assert motion.airborne == 0.5
    assert motion.self_contact == 0.5


def test_waiting_by_hand():
    # Row 0 waits for 40 steps, row 1 for 10, and row 2 falls at its 35th of 50.
    wait = torch.tensor([[40], [10], [50]])
    throws = replace(AT_ONCE, first_delay=(0.0, 1.0))
    watcher = Watcher(make(throws=throws), 0, 3)
    for step in range(1, 61):
        after = state(
            3,
            # (3, 4, 12) m/s is 5 m/s over the floor; the vertical speed does not count.
            base_lin_vel_w=torch.tensor([[3.0, 4, 12], [9, 9, 9], [0, 0, 0]]),
            power=torch.tensor([[float(step)], [999], [7]]),
            first_throw_step=wait,
            terminated=torch.tensor([[False], [False], [step == 35]]),
        )
        watcher(state(3), after, torch.tensor([True, True, step <= 35]))
    waiting = watcher.waiting()
    # From 0.5 s, step 30, on: row 0 at 30 to 40, row 2 at 30 to 34; row 1 not at all.
    assert waiting.base_speed == pytest.approx(11 * 5 / 16)
    assert waiting.power == pytest.approx((11 * 35 + 5 * 7) / 16)
    assert waiting.fallen == pytest.approx(1 / 3)
    # The fall before the throw is a failure of that episode.
    assert watcher._failed.tolist() == [False, False, True]


def test_nobody_waits_for_a_ball_that_is_thrown_at_the_start(rigid):
    assert rigid[0].waiting() is None


def test_robots_that_fall_at_once_are_counted_before_the_first_throw():
    throws = replace(AT_ONCE, first_delay=(0.0, 1.0))
    watcher = Watcher(make(throws=throws), 0, 4)
    ends = torch.tensor([[True], [True], [True], [False]])
    after = state(4, first_throw_step=torch.full((4, 1), 20), terminated=ends)
    watcher(state(4), after, torch.ones(4, dtype=torch.bool))
    assert watcher.waiting() == Waiting(base_speed=None, power=None, fallen=0.75)


def test_success_is_counted_from_the_first_throw():
    # The limit is 180 steps after it: 20 + 180 is a failure, 20 + 181 is not.
    wait = torch.full((3, 1), 20)
    throws = replace(AT_ONCE, first_delay=(0.0, 1.0))
    watcher = Watcher(make(throws=throws), 0, 3)
    for step in range(1, 206):
        ends = torch.tensor([[step == 200], [step == 201], [False]])
        after = state(
            3,
            first_throw_step=wait,
            terminated=ends,
        )
        going = torch.tensor([step <= 200, step <= 201, True])
        watcher(state(3), after, going)
    assert watcher._failed.tolist() == [True, False, False]


def test_a_ball_after_a_long_delay_is_the_first():
    # Without the delay it would be the third, fourth or fifth of its episode.
    watcher = Watcher(make(throws=replace(AT_ONCE, first_delay=(5.0, 5.0))), 0, 8)
    seen = torch.tensor([[True, False]]).expand(8, 2)
    after = state(
        8,
        object_arrived=seen,
        object_hit=seen,
        first_throw_step=torch.full((8, 1), 300),
    )
    watcher._step = 300
    watcher(state(8), after, torch.ones(8, dtype=torch.bool))
    first, *later = watcher.groups()["number of the ball"]
    assert (first.episodes, first.first_hits) == (8, 1.0)
    assert [group.later_balls for group in later] == [0, 0, 0]


@pytest.mark.slow
def test_balls_after_a_delay_are_those_that_the_environment_counts():
    config = make(throws=replace(BESIDE, first_delay=(0.3, 1.1)))
    skin = config.skin.build(H1_2)
    watcher = Watcher(config, 1, 32)
    which = {"throw_set": 1, "episodes": 32}
    played = play_throws(None, config, skin, **which, hold=True, watch=watcher)
    arrived, avoided = watcher._arrived, watcher._arrived & ~watcher._hit
    for counted, seen in ((played.arrived, arrived), (played.avoided, avoided)):
        assert torch.equal(seen[:, 0].long(), counted[:, 0].long())
        assert torch.equal(seen[:, 1:].sum(1), counted[:, 1].long())
    assert int(arrived[:, 1:].sum()) > 10
    # Held rigid, it does not move.
    assert watcher.waiting().base_speed == pytest.approx(0, abs=1e-6)
    assert watcher.waiting().fallen == 0


def test_a_foot_that_rolls_over_its_toes_does_not_slide():
    watcher = Watcher(make(), 0, 1)
    before, after = state(1), state(1)
    half = torch.tensor(0.05)
    turn = torch.tensor([half.cos(), 0, half.sin(), 0])  # forward, about y
    feet = watcher._feet
    corners = feet.corners_w(*feet.poses_w(before))[0].reshape(-1, 3)
    toe = corners[corners[:, 0].argmax()].clone()
    toe[2] = corners[:, 2].min()
    # Both robots lean over their toes, the second one farther about the same line.
    for td, angle in ((before, 1), (after, 2)):
        for _ in range(angle):
            w, y = turn[0], turn[2]
            c, s = w * w - y * y, 2 * w * y
            arm = td["base_pose"][0, :3] - toe
            moved = torch.stack(
                (c * arm[0] + s * arm[2], arm[1], c * arm[2] - s * arm[0])
            )
            td["base_pose"][0, :3] = toe + moved
            q = td["base_pose"][0, 3:].clone()
            td["base_pose"][0, 3] = w * q[0] - y * q[2]
            td["base_pose"][0, 5] = w * q[2] + y * q[0]
    slip = feet.slip(before, after)
    torch.testing.assert_close(slip, torch.zeros(1, 2), atol=1e-5, rtol=0)


def test_round_feet_slide_but_do_not_slide_by_rolling(tmp_path: Path):
    # Balls of 5 cm whose centres are 67 cm below the base.
    round_feet = MODEL.replace(
        'type="box" size="0.15 0.06 0.02"', 'type="sphere" size="0.05"'
    )
    robot = find_robot(str(write_robot(tmp_path / "pip", model=round_feet)))
    feet = Feet(robot)
    before = TensorDict(
        base_pose=torch.tensor([[0.0, 0, 0.72, 1, 0, 0, 0]]),
        joint_pos=torch.zeros(1, len(robot.joints)),
        batch_size=[1],
    )
    slid, rolled = before.clone(), before.clone()
    slid["base_pose"][0, 0] += 0.01
    torch.testing.assert_close(feet.slip(before, slid), torch.full((1, 2), 0.01))
    # The whole robot turns about the lowest points, by 0.02 rad.
    half = torch.tensor(0.01)
    turned = torch.tensor([0.72 * (2 * half).sin(), 0, 0.72 * (2 * half).cos()])
    rolled["base_pose"][0] = torch.cat(
        (turned, torch.tensor([half.cos(), 0, half.sin(), 0]))
    )
    slip = feet.slip(before, rolled)
    torch.testing.assert_close(slip, torch.zeros(1, 2), atol=1e-6, rtol=0)
    # 2 cm above the floor they do not slide.
    before["base_pose"][0, 2] = slid["base_pose"][0, 2] = 0.74
    assert feet.slip(before, slid).isnan().all()


def test_a_robot_without_shapes_on_its_feet_has_no_slip():
    watcher = Watcher(make(), 0, 1)
    watcher._feet = Feet(replace(H1_2, feet=()))
    watcher(state(1), state(1), torch.tensor([True]))
    assert watcher.motion().foot_slip is None


def test_displacement_is_that_of_the_episodes_that_last():
    watcher = Watcher(make(), 0, 2)
    way = state(2, displacement_w=torch.tensor([[3.0, 4.0], [6.0, 8.0]]))
    way["base_pose"][:, 2] = torch.tensor([0.5, 1.0])
    for step in range(1, 121):
        # Row 1 ends at step 100.
        watcher(state(2), way, torch.tensor([True, step <= 100]))
    one, two, three, five = watcher.displacement()
    assert (one.age, one.episodes, one.mean, one.height) == (1.0, 2, 7.5, 0.75)
    assert one.largest_tenth == pytest.approx(9.5)
    assert (two.episodes, two.mean, two.height) == (1, 5.0, 0.5)
    assert (three.episodes, three.mean, three.largest_tenth) == (0, None, None)
    assert (five.age, five.episodes, five.height) == (5.0, 0, None)


def test_displacement_is_of_an_age_from_the_first_throw_on():
    watcher = Watcher(make(), 0, 2)
    first = torch.tensor([[0], [30]])
    for step in range(1, 121):
        way = torch.tensor([[float(step), 0.0]]).expand(2, 2)
        after = state(2, displacement_w=way, first_throw_step=first)
        watcher(state(2), after, torch.ones(2, dtype=torch.bool))
    one, two, *_ = watcher.displacement()
    # Steps 60 and 90; 120 and, not reached, 150.
    assert (one.episodes, one.mean) == (2, 75.0)
    assert (two.episodes, two.mean) == (1, 120.0)


def test_watching_changes_no_figure():
    config = EnvConfig()
    skin = config.skin.build(H1_2)
    weights = 0.5 * torch.randn(64, 21, generator=torch.Generator().manual_seed(0))

    class Module(torch.nn.Module):
        def forward(self, td):
            return td.set("action", td["signal"] @ weights - weights.sum(0))

    which = {"throw_set": 3, "episodes": 16}
    result, behaviour = behave(Module(), config, skin, **which)
    assert result == evaluate(Module(), config, skin, **which)
    masked = {**which, "mask": MASK_ALL}
    blind, _ = behave(Module(), config, skin, **masked)
    assert blind == evaluate(Module(), config, skin, **masked)
    assert blind != result
    first = [g for g in behaviour.throws["direction"] if g.first_hits is not None]
    assert first
    assert behaviour.motion.power > behaviour.motion_zero_action.power > 0
