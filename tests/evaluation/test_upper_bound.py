"""Upper bound: the search starts at the policy's plan and only improves on it."""

from __future__ import annotations

import copy
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torchrl.envs import TransformedEnv

from egoskin.evaluation import upper_bound
from egoskin.evaluation.behaviour import Watcher
from egoskin.evaluation.throw_set import play_throws, standard_task, throw_seed
from egoskin.evaluation.upper_bound import (
    SearchConfig,
    UpperBound,
    _play,
    _until_in_reach,
    find_upper_bound,
)
from egoskin.make import EnvConfig, make_worker_env
from egoskin.policies.policy import Policy, load_policy

ROOT = Path(__file__).parents[2]
RUN = ROOT / "studies/version-1/results/field-proximity-2m-seed0"
THROWS = 16
SEARCH = SearchConfig(samples=24, iterations=3, stand_s=0.75)


@pytest.fixture(scope="module")
def policy() -> Policy:
    # It is hit by some balls of version 1, which the search can avoid.
    return load_policy(RUN / "policies/000065536000.safetensors")


def task(policy: Policy) -> EnvConfig:
    """Version 1's task without a second ball; the first arrives within 2 s.

    Of its first balls some hit, of version 2's hardly any.
    """
    config = standard_task(policy.env_config, "1")
    throws = replace(config.task.throws, interval=(1e3, 1e3))
    return replace(
        config, task=replace(config.task, throws=throws, episode_length_s=2.0)
    )


def make(policy: Policy, config: EnvConfig, rows: int) -> TransformedEnv:
    return make_worker_env(
        config,
        policy.skin,
        num_envs=rows,
        seed=throw_seed(config, 0),
        num_threads=1,
        keep_raw=True,
    )


def find(policy: Policy, search: SearchConfig = SEARCH) -> UpperBound:
    return find_upper_bound(
        policy, task(policy), search, throw_set=0, throws=THROWS, reach=2.0
    )


@pytest.fixture(scope="module")
def bound(policy: Policy) -> UpperBound:
    return find(policy)


def test_the_empty_plan_is_the_policy(policy: Policy, bound: UpperBound):
    config = task(policy)
    watcher = Watcher(config, 0, THROWS)
    play_throws(
        policy, config, policy.skin, throw_set=0, episodes=THROWS, watch=watcher
    )
    hit = watcher._hit[:, 0]
    # All of them come into range; some hit, some do not.
    assert torch.equal(bound.policy.avoided, ~hit)
    assert 0 < int(hit.sum()) < THROWS
    # The heights are those of the first balls.
    height, _ = watcher._thrower.at_standing_robot(watcher._draw)
    torch.testing.assert_close(bound.height, height.reshape(THROWS, -1)[:, 0])


def test_heights_are_those_of_the_ball_that_is_asked_for(
    policy: Policy, monkeypatch: pytest.MonkeyPatch
):
    def play(env, policy, start, plan, steps, ball) -> tuple[torch.Tensor, ...]:
        whole = torch.ones(len(plan), dtype=torch.bool)
        return whole, whole, torch.full((len(plan),), steps)

    def start_at_once(env, policy, config, reach, ball) -> upper_bound._Start:
        return _until_in_reach(env, policy, config, reach)

    monkeypatch.setattr(upper_bound, "_play", play)
    monkeypatch.setattr(upper_bound, "_until_in_reach", start_at_once)
    config = task(policy)
    search = SearchConfig(samples=4, iterations=1)
    which = {"throw_set": 0, "throws": 2, "reach": 2.0}
    bound = find_upper_bound(policy, config, search, ball=2, **which)
    watcher = Watcher(
        replace(config, task=replace(config.task, episode_length_s=2e3)), 0, 2
    )
    height, _ = watcher._thrower.at_standing_robot(watcher._draw)
    torch.testing.assert_close(bound.height, height.reshape(2, -1)[:, 1])


@pytest.mark.slow
def test_the_second_ball_comes_at_a_robot_that_has_dodged_the_first(policy: Policy):
    config = standard_task(policy.env_config)
    watcher = Watcher(config, 0, THROWS)
    play_throws(
        policy, config, policy.skin, throw_set=0, episodes=THROWS, watch=watcher
    )
    env = make(policy, config, THROWS)
    start = _until_in_reach(env, policy, config, reach=2.0, ball=2)
    first, second = watcher._hit[start.throw, :2].T
    assert 0 < len(start.throw) < THROWS
    assert not first.any()
    assert (start.simulation["throw"] == 2).all()
    empty = torch.zeros(len(start.throw), 0, len(config.robot_config.joints))
    env = make(policy, config, len(start.throw))
    env.reset()
    _, avoided, _ = _play(env, policy, start, empty, steps=75, ball=2)
    assert torch.equal(avoided, ~second)
    assert 0 < int(second.sum()) < len(second)


def test_no_ball_is_thrown_after_it(policy: Policy):
    config = standard_task(policy.env_config)
    # The next one would be thrown before the first comes into reach.
    throws = replace(config.task.throws, interval=(0.1, 0.1))
    config = replace(config, task=replace(config.task, throws=throws))
    start = _until_in_reach(make(policy, config, THROWS), policy, config, reach=2.0)
    assert len(start.throw) == THROWS
    assert (start.simulation["step"] > 6).all()
    assert (start.simulation["throw"] == 1).all()


def test_a_search_finds_more_than_the_policy_does_and_loses_nothing(bound: UpperBound):
    own, best = bound.policy, bound.best
    assert not (own.avoided & ~best.avoided).any()
    assert not (own.stood & ~best.stood).any()
    for outcome in (own, best):
        assert not (outcome.stood & ~outcome.avoided).any()
    assert int(best.avoided.sum()) > int(own.avoided.sum())


def test_a_search_gets_far_from_the_policys_plan(
    policy: Policy, monkeypatch: pytest.MonkeyPatch
):
    def play(env, policy, start, plan, steps, ball) -> tuple[torch.Tensor, ...]:
        # As if one joint had to move at once, by far more than the first plans do.
        age = steps - (10 * (plan[:, 0, 0] - 4).abs()).long()
        return age > 0, age > 0, age

    monkeypatch.setattr(upper_bound, "_play", play)
    search = SearchConfig(samples=64)
    bound = find_upper_bound(
        policy, task(policy), search, throw_set=0, throws=1, reach=2.0
    )
    assert (bound.policy.stood.tolist(), bound.best.stood.tolist()) == ([False], [True])


def test_the_step_of_a_hit_is_not_survived(policy: Policy):
    config = task(policy)
    env = make(policy, config, THROWS)
    start = _until_in_reach(env, policy, config, reach=2.0)
    empty = torch.zeros(THROWS, 0, len(config.robot_config.joints))
    untouched, _, survived = _play(env, policy, start, empty, steps=60, ball=1)
    row = int((~untouched).nonzero()[0])
    steps = int(survived[row])
    assert _play(env, policy, start, empty, steps, ball=1)[0][row]
    assert not _play(env, policy, start, empty, steps + 1, ball=1)[0][row]


def test_a_ball_that_comes_after_a_fall_does_not_count_as_avoided(policy: Policy):
    config = task(policy)
    # It arrives after 1.9 s at the earliest.
    throws = replace(config.task.throws, speed=(2.0, 2.1))
    config = replace(config, task=replace(config.task, throws=throws))
    env = make(policy, config, THROWS)
    start = _until_in_reach(env, policy, config, reach=math.inf)
    plan = torch.full((len(start.throw), 60, len(config.robot_config.joints)), 3.0)
    untouched, avoided, survived = _play(env, policy, start, plan, steps=90, ball=1)
    assert (untouched & (survived < 90)).all()
    assert not avoided.any()


def test_a_ball_that_still_flies_does_not_count_as_avoided(policy: Policy):
    config = task(policy)
    env = make(policy, config, THROWS)
    start = _until_in_reach(env, policy, config, reach=math.inf)
    empty = torch.zeros(THROWS, 0, len(config.robot_config.joints))
    untouched, avoided, _ = _play(env, policy, start, empty, steps=6, ball=1)
    assert untouched.all()
    assert not avoided.any()


def test_every_ball_passes_in_the_time_simulated(
    policy: Policy, monkeypatch: pytest.MonkeyPatch
):
    config = task(policy)
    throws = replace(config.task.throws, speed=(4.0, 4.0), distance=(6.0, 6.0))
    config = replace(config, task=replace(config.task, throws=throws))
    played = []

    def play(env, policy, start, plan, steps, ball) -> tuple[torch.Tensor, ...]:
        result = _play(env, policy, start, plan, steps, ball)
        played.append(result)
        return result

    monkeypatch.setattr(upper_bound, "_play", play)
    search = SearchConfig(samples=4, iterations=1, stand_s=0.1)
    which = {"throw_set": 0, "throws": THROWS}
    near = find_upper_bound(policy, config, search, reach=2.0, **which)
    far = find_upper_bound(policy, config, search, reach=math.inf, **which)
    # The policy's own outcome does not depend on where its plans would begin.
    assert torch.equal(near.policy.avoided, far.policy.avoided)
    assert 0 < int(far.policy.avoided.sum()) < THROWS
    for untouched, avoided, age in played:
        # Who neither falls nor is hit has been passed.
        standing = untouched & (age == age.max())
        assert standing.any()
        assert avoided[standing].all()


def test_a_search_ends_when_nothing_is_left_to_improve(
    policy: Policy, monkeypatch: pytest.MonkeyPatch
):
    def play(env, policy, start, plan, steps, ball) -> tuple[torch.Tensor, ...]:
        whole = torch.ones(len(plan), dtype=torch.bool)
        return whole, whole, torch.full((len(plan),), steps)

    monkeypatch.setattr(upper_bound, "_play", play)
    iterations = []
    bound = find_upper_bound(
        policy,
        task(policy),
        SearchConfig(samples=4, iterations=3),
        throw_set=0,
        throws=2,
        reach=2.0,
        on_iteration=lambda iteration, best: iterations.append(iteration),
    )
    assert (iterations, bound.best.stood.tolist()) == ([1], [True, True])


def test_the_best_is_never_worse_than_the_policy(
    policy: Policy, monkeypatch: pytest.MonkeyPatch
):
    # The policy avoids the ball and falls half-way; plans run ahead of it to the end.
    def play(env, policy, start, plan, steps, ball) -> tuple[torch.Tensor, ...]:
        is_policy = ~plan.flatten(1).any(1)
        age = torch.where(is_policy, steps // 2, steps)
        return torch.ones_like(is_policy), is_policy, age

    monkeypatch.setattr(upper_bound, "_play", play)
    bound = find_upper_bound(
        policy,
        task(policy),
        SearchConfig(samples=4, iterations=2),
        throw_set=0,
        throws=2,
        reach=2.0,
    )
    assert bound.policy.avoided.tolist() == bound.best.avoided.tolist() == [True, True]


@pytest.mark.slow
def test_an_age_limit_is_no_fall(policy: Policy, bound: UpperBound):
    # Every plan crosses it: the balls come into reach after about 0.35 to 1 s.
    long = task(policy)
    short = replace(long, task=replace(long.task, episode_length_s=1.05))
    which = {"throw_set": 0, "throws": THROWS, "reach": 2.0}
    found = find_upper_bound(policy, short, SEARCH, **which)
    assert torch.equal(found.policy.stood, bound.policy.stood)
    assert found.policy.stood.any()


def test_plans_start_where_the_reach_says_whatever_the_sensors_own_range(
    policy: Policy,
):
    config = task(policy)
    skin = replace(policy.skin, range=np.full(len(policy.skin), 0.3))
    other = copy.deepcopy(policy)
    other.policy_spec = replace(policy.policy_spec, skin=skin)
    steps = [
        _until_in_reach(make(policy, config, 4), who, config, 2.0).simulation["step"]
        for who in (policy, other)
    ]
    assert len(steps[0]) == 4
    assert torch.equal(*steps)


def test_corrupted_sensors_are_refused(policy: Policy):
    config = task(policy)
    sensor = replace(config.sensor, corruption="acoustic")
    with pytest.raises(ValueError, match=r"ideal sensors.*acoustic"):
        find_upper_bound(
            policy,
            replace(config, sensor=sensor),
            SEARCH,
            throw_set=0,
            throws=1,
            reach=2.0,
        )


@pytest.mark.slow
def test_a_search_repeats(policy: Policy):
    search = SearchConfig(samples=8, iterations=2, stand_s=0.5)
    one, two = find(policy, search), find(policy, search)
    assert torch.equal(one.best.avoided, two.best.avoided)
    assert torch.equal(one.best.stood, two.best.stood)


def test_balls_that_never_come_into_reach_are_an_error(policy: Policy):
    # No episode lasts until the fiftieth.
    with pytest.raises(ValueError, match="came within 2 m of a sensor"):
        find_upper_bound(
            policy, task(policy), SEARCH, throw_set=0, throws=4, reach=2.0, ball=50
        )


@pytest.mark.parametrize(
    "change", [{"samples": 3}, {"iterations": 0}, {"stand_s": -1.0}]
)
def test_searches_that_cannot_be_are_refused(change: dict):
    with pytest.raises(ValueError, match=next(iter(change))):
        SearchConfig(**change)
