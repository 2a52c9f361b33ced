"""Evaluation: values by hand, the same throw set for all policies, intervals."""

from __future__ import annotations

import dataclasses
import math

import pytest
import torch

from egoskin.envs.dodgeball import DodgeballConfig, DodgeballEnv
from egoskin.envs.randomization import RandomizationConfig
from egoskin.envs.standards import training_task
from egoskin.envs.throws import ThrowConfig, Thrower
from egoskin.evaluation.throw_set import (
    Episodes,
    mean_estimate,
    play_throws,
    standard_task,
    summarize,
    throw_seed,
    wilson,
)
from egoskin.make import EnvConfig
from egoskin.sensors import Skin
from egoskin.sensors.config import SensorConfig
from throwing import TASK


def test_the_throws_of_the_training_are_played_without_its_randomisation():
    varied = RandomizationConfig(gains=(0.2, 0.2))
    own = dataclasses.replace(DodgeballConfig(), success_s=2.0, randomization=varied)
    config = EnvConfig(task=own)
    plain = dataclasses.replace(own, randomization=RandomizationConfig())
    assert standard_task(config, "run").task == plain
    assert standard_task(config).task.throws.first_delay == (0.0, 0.0)


def test_an_oracle_plays_no_standard_with_other_balls():
    throws = dataclasses.replace(TASK.throws, num_balls=3)
    task = dataclasses.replace(TASK, throws=throws)
    oracle = EnvConfig(task=task, sensor=SensorConfig(coverage="oracle"))
    with pytest.raises(ValueError, match="oracle of 3 balls cannot play standard 2"):
        standard_task(oracle)
    assert standard_task(oracle, "run").task.throws.num_balls == 3
    # A skin does not see how many there are.
    field = dataclasses.replace(oracle, sensor=SensorConfig())
    assert standard_task(field).task.throws.num_balls == 2


def test_wilson_interval_by_hand():
    # n = 100, p = 0.1, z = 1.96: centre 0.1148, half-width 0.0596 (a table's values).
    estimate = wilson(10, 100)
    assert estimate.mean == 0.1
    assert estimate.low == pytest.approx(0.0552, abs=1e-4)
    assert estimate.high == pytest.approx(0.1744, abs=1e-4)
    assert wilson(0, 50).low == 0.0
    assert wilson(50, 50).high == 1.0


def test_mean_interval_by_hand():
    # Values 1, 2, 3: mean 2, deviation 1, half-width 1.96 / sqrt(3).
    estimate = mean_estimate(torch.tensor([1.0, 2.0, 3.0]))
    assert estimate.mean == 2.0
    assert estimate.high - 2.0 == pytest.approx(1.959964 / math.sqrt(3))


def flags(*values: int) -> torch.Tensor:
    return torch.tensor(values) > 0


def test_figures_of_six_episodes_by_hand():
    # At 60 Hz 3 s are 180 steps: a ball at 100, a fall at 180, a ball at 181 (after
    # the 3 s: a success), a divergence at 5, one that lasts the 10 s, and one that
    # self-contact ends at 60.
    played = Episodes(
        steps=torch.tensor([100, 180, 181, 5, 600, 60]),
        hit=flags(1, 0, 1, 0, 0, 0),
        fallen=flags(0, 1, 0, 0, 0, 0),
        diverged=flags(0, 0, 0, 1, 0, 0),
        self_contact=flags(0, 0, 0, 0, 0, 1),
        arrived=torch.tensor([[1.0, 0], [1, 0], [1, 1], [0, 0], [1, 5], [0, 0]]),
        avoided=torch.tensor([[0.0, 0], [1, 0], [1, 0], [0, 0], [1, 5], [0, 0]]),
    )
    rigid = Episodes(
        steps=torch.full((6,), 50),
        hit=flags(1, 1, 1, 1, 0, 1),
        fallen=flags(0, 0, 0, 0, 0, 0),
        diverged=flags(0, 0, 0, 0, 0, 0),
        self_contact=flags(0, 0, 0, 0, 0, 0),
        arrived=torch.zeros(6, 2),
        avoided=torch.zeros(6, 2),
    )
    result = summarize(played, rigid, DodgeballConfig())
    assert result.success.mean == pytest.approx(2 / 6)
    # 5 s are 300 steps: only the one that lasts is a success.
    assert result.success_5s.mean == pytest.approx(1 / 6)
    shares = (
        result.ended_by_ball,
        result.ended_by_fall,
        result.ended_by_self_contact,
        result.diverged,
    )
    assert shares == pytest.approx([1 / 6] * 4)
    assert result.success.mean + sum(shares) == pytest.approx(1.0)
    assert result.rigid_success == pytest.approx(1 / 6)
    mean = (100 + 180 + 181 + 5 + 600 + 60) / 6 / 60
    assert result.survival_time.mean == pytest.approx(mean)
    assert result.avoided.first_ball == pytest.approx(3 / 4)
    assert result.avoided.later_balls == pytest.approx(5 / 6)


def test_success_is_read_at_the_age_of_the_task():
    # At 60 Hz 1 s is 60 steps: a ball at step 60 is a failure, one at 61 is not.
    played = Episodes(
        steps=torch.tensor([60, 61]),
        hit=flags(1, 1),
        fallen=flags(0, 0),
        diverged=flags(0, 0),
        self_contact=flags(0, 0),
        arrived=torch.zeros(2, 2),
        avoided=torch.zeros(2, 2),
    )
    assert summarize(played, played, DodgeballConfig()).success.mean == 0
    early = summarize(played, played, DodgeballConfig(success_s=1.0))
    # An episode that ends before success_s is judged at its end.
    short = DodgeballConfig(success_s=3.0, episode_length_s=1.0)
    assert summarize(played, played, short).success == early.success
    assert early.success.mean == early.ended_by_ball == 0.5


def test_an_end_before_the_first_throw_is_a_failure_that_survived_nothing():
    # 30 steps before the first throw, at it, and one step after.
    played = Episodes(
        steps=torch.tensor([-30, 0, 1, 600]),
        hit=flags(0, 0, 0, 0),
        fallen=flags(1, 1, 1, 0),
        diverged=flags(0, 0, 0, 0),
        self_contact=flags(0, 0, 0, 0),
        arrived=torch.zeros(4, 2),
        avoided=torch.zeros(4, 2),
    )
    result = summarize(played, played, DodgeballConfig())
    assert result.success.mean == result.success_5s.mean == 1 / 4
    assert result.ended_by_fall == 3 / 4
    assert result.survival_time.mean == pytest.approx((0 + 0 + 1 + 600) / 4 / 60)


def test_nothing_arrived_is_not_a_share():
    none = torch.zeros(1, dtype=torch.bool)
    empty = Episodes(
        steps=torch.tensor([3]),
        hit=none,
        fallen=~none,
        diverged=none,
        self_contact=none,
        arrived=torch.zeros(1, 2),
        avoided=torch.zeros(1, 2),
    )
    assert summarize(empty, empty, DodgeballConfig()).avoided.first_ball is None


def test_a_policy_is_judged_by_version_2_by_default():
    task = DodgeballConfig(throws=ThrowConfig(lead=0.0), success_s=1.0)
    assert standard_task(EnvConfig(task=task)) == standard_task(EnvConfig(), "2")


@pytest.mark.parametrize(
    ("version", "expected"), [("2", 2**32 + 5), ("1", 5), ("paper", 2**32 + 5)]
)
def test_no_training_meets_the_throws_of_a_throw_set_but_those_of_version_1(
    version, expected
):
    assert throw_seed(standard_task(EnvConfig(), version), 5) == expected
    # Throws of a run's own are held out as well, unless they are version 1's.
    trained = EnvConfig(task=training_task(version, DodgeballConfig()))
    assert throw_seed(trained, 5) == expected
    other = dataclasses.replace(trained.task, success_s=2.0)
    assert throw_seed(EnvConfig(task=other), 5) == 2**32 + 5


def skin_of(config: EnvConfig) -> Skin:
    return config.skin.build(config.robot_config)


def make_case(version="2") -> dict:
    config = standard_task(EnvConfig(), version)
    return {
        "config": config,
        "skin": config.skin.build(config.robot_config),
        "episodes": 32,
    }


def test_a_throw_set_ends_the_same_in_this_process_and_on_2_workers():
    case = make_case()
    torch.manual_seed(0)
    weights = 0.5 * torch.randn(64, 21)

    def policy(td):
        # Reads the signal, so that the sensors are used.
        return td.set("action", td["signal"] @ weights - weights.sum(0))

    class Module(torch.nn.Module):
        def forward(self, td):
            return policy(td)

    one, two = (
        play_throws(Module(), **case, throw_set=3, num_workers=n) for n in (None, 2)
    )
    for field in dataclasses.fields(Episodes):
        assert torch.equal(getattr(one, field.name), getattr(two, field.name))
    assert len(one.steps) == 32


@pytest.mark.parametrize("workers", [None, 2])
def test_a_policy_is_given_its_memory(workers):
    seen: list[torch.Tensor] = []

    class Counting(torch.nn.Module):
        """Counts its calls in an entry that the environment does not know."""

        in_keys = ("signal", "is_init", "count")

        def forward(self, td):
            before = torch.where(td["is_init"], 0.0, td.get("count", torch.zeros(1)))
            seen.append(before.clone())
            td["next", "count"] = before + 1
            return td.set("action", torch.zeros(*td.shape, 21))

    case = make_case()
    play_throws(Counting(), **case, throw_set=3, num_workers=workers)
    assert len(seen) > 20
    for step, counts in enumerate(seen):
        assert counts.shape == (32, 1)
        assert (counts == step).all()


@pytest.mark.parametrize("version", ["2", "1"])
def test_every_standard_throw_meets_a_robot_that_does_not_move(version):
    case = make_case(version)
    rigid = play_throws(None, **case, throw_set=3, hold=True)
    assert summarize(rigid, rigid, DodgeballConfig()).rigid_success <= 0.01


def delayed(delay: tuple[float, float], **throws) -> EnvConfig:
    throws = ThrowConfig(first_delay=delay, **throws)
    sensor = SensorConfig(coverage="none")
    return EnvConfig(task=DodgeballConfig(throws=throws), sensor=sensor)


@pytest.mark.parametrize("num_workers", [None, pytest.param(2, marks=pytest.mark.slow)])
def test_episodes_count_from_the_first_throw_whatever_the_delay(num_workers):
    # The rigid robot does not move and gets the same throws.
    which = {"throw_set": 3, "episodes": 32, "hold": True, "num_workers": num_workers}
    at_once, late = (
        play_throws(None, config, skin_of(config), **which)
        for config in (delayed((0.0, 0.0)), delayed((0.5, 1.5)))
    )
    for field in dataclasses.fields(Episodes):
        one, other = getattr(at_once, field.name), getattr(late, field.name)
        assert torch.equal(one, other), field.name
    assert at_once.hit.all()


def test_an_episode_lasts_its_whole_length_after_the_latest_first_throw():
    # Balls to a point 50 m up.
    config = delayed((0.1, 0.4), aim="box", box_height=(50.0, 50.0))
    task = dataclasses.replace(config.task, episode_length_s=0.5)
    config = dataclasses.replace(config, task=task)
    which = {"throw_set": 0, "episodes": 16, "hold": True}
    played = play_throws(None, config, skin_of(config), **which)
    assert (played.steps == 30).all()
    assert not (played.hit | played.fallen | played.diverged).any()


class Still(torch.nn.Module):
    """A policy that gives the same action at every step."""

    def __init__(self, action: torch.Tensor) -> None:
        super().__init__()
        self.action = action

    def forward(self, td):
        return td.set("action", self.action.expand(len(td), -1))


def test_a_fall_before_the_first_throw_is_a_failure():
    config = delayed((4.0, 6.0))
    # Hips and knees drive the robot to the ground.
    action = torch.tensor(
        [-2.0 * ("hip_pitch" in name) for name in config.robot_config.joints]
    )
    which = {"throw_set": 0, "episodes": 8}
    played = play_throws(Still(action), config, skin_of(config), **which)
    assert played.fallen.all()
    assert not played.arrived.any()
    row = torch.arange(8)
    thrower = Thrower(config.task.throws, config.robot_config, 1 / 120)
    delay = thrower.first_delay(throw_seed(config, 0), row, row * 0)
    fell_at = played.steps / 60 + delay
    assert (played.steps < 0).all()
    assert ((fell_at > 0.2) & (fell_at < 2.5)).all()
    result = summarize(played, played, config.task)
    assert result.success.mean == 0
    assert result.survival_time.mean == 0


def test_ends_by_self_contact_are_told_apart():
    config = EnvConfig(task=dataclasses.replace(TASK, self_contact_ends=True))
    skin = config.skin.build(config.robot_config)
    inwards = torch.zeros(32, 21)
    inwards[:16, config.robot_config.joints.index("left_shoulder_roll_joint")] = -1.0

    class Module(torch.nn.Module):
        def forward(self, td):
            return td.set("action", inwards)

    played = play_throws(Module(), config, skin, throw_set=0, episodes=32)
    assert played.self_contact[:16].all()
    assert not played.self_contact[16:].any()
    # Every episode has exactly one cause of its end.
    causes = (played.hit, played.fallen, played.diverged, played.self_contact)
    assert (torch.stack(causes).sum(0) == 1).all()


def test_an_end_by_two_causes_counts_once_and_a_ball_before_a_fall(monkeypatch):
    step = DodgeballEnv._step

    def twice(env, tensordict):
        # Whom a ball touches falls as well; of every other one the ball is forgotten,
        # and its simulation fails.
        out = step(env, tensordict)
        odd = torch.arange(len(out))[:, None] % 2 > 0
        out["fallen"], out["diverged"] = out["hit"].clone(), out["hit"] & odd
        out["hit"] &= ~odd
        return out

    monkeypatch.setattr(DodgeballEnv, "_step", twice)
    played = play_throws(None, **make_case(), throw_set=3, hold=True)
    odd = torch.arange(32) % 2 > 0
    assert torch.equal(played.hit, ~odd)
    assert torch.equal(played.fallen, odd)
    assert not (played.diverged | played.self_contact).any()


def test_another_seed_is_another_throw_set():
    case = make_case()
    first, again, other = (
        play_throws(None, **case, throw_set=seed, hold=True).steps for seed in (0, 0, 1)
    )
    assert torch.equal(first, again)
    assert not torch.equal(first, other)
