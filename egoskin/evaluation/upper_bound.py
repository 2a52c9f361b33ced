"""Reference for dodging: the best actions that a search finds near a sensor.

The search starts once a ball is within reach of a sensor. A policy may never find these
actions, but they are feasible for the body in the time that is left: what the body can
do is at least this.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Annotated, cast

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import Compose, TransformedEnv

from egoskin.bounds import COUNT, POSITIVE, Interval, check_bounds
from egoskin.envs.balls import PASSED_DISTANCE
from egoskin.envs.dodgeball import DodgeballEnv
from egoskin.envs.throws import ThrowConfig
from egoskin.evaluation.throw_set import throw_seed
from egoskin.make import EnvConfig, make_worker_env
from egoskin.parallel import default_num_workers
from egoskin.policies.policy import Policy
from egoskin.sensors import Skin
from egoskin.sensors.config import SensorConfig
from egoskin.sensors.pipeline import SensorPipeline

# Consecutive entries of a plan, and control steps for which each is held.
_ENTRIES, _HELD = 8, 4
# Share of elite plans, and weight of the previous mean and standard deviation in each
# update.
_ELITE, _KEPT = 0.1, 0.25
# Standard deviation of the entries, in units of the action: at first, and at least, to
# keep exploring.
_FIRST_SPREAD, _LEAST_SPREAD = 1.2, 0.1
# Cost of a plan's size: of two plans with the same outcome, the smaller is better.
_SIZE_COST = 1e-3
# Distance from a sensor to the base [m], at most.
_SENSOR_TO_BASE = 1.0
# A step that no episode reaches.
_NEVER = 2**31


@dataclass(frozen=True, kw_only=True)
class SearchConfig:
    """Settings of the search."""

    samples: Annotated[int, Interval(ge=4)] = 128
    """Plans per throw and iteration."""
    iterations: Annotated[int, COUNT] = 20
    """Maximum number of iterations; the search ends when all balls are avoided and the
    robot still stands."""
    stand_s: Annotated[float, POSITIVE] = 1.25
    """Least time simulated from the start of a plan [s], in which the robot must not
    fall; it is longer where the ball needs more to pass."""
    seed: int = 0
    """Seed of the random plans."""

    def __post_init__(self) -> None:
        """Raise ValueError for invalid values."""
        check_bounds(self)


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """Outcomes of throws, ``[N]`` bool each."""

    avoided: Tensor
    """The ball passes the robot without touching it."""
    stood: Tensor
    """Nor does the robot fall in the time simulated."""


@dataclass(frozen=True, kw_only=True)
class UpperBound:
    """Outcomes of some throws with the policy, and with the best plan found."""

    height: Tensor
    """Height aimed at, at the standing robot [m], ``[N]``."""
    policy: Outcome
    """The policy alone."""
    best: Outcome
    """The policy with the best plan added to its actions."""


@dataclass(frozen=True, kw_only=True)
class _Start:
    """States in which plans start, rows ``[N]``."""

    throw: Tensor
    simulation: dict[str, Tensor]
    root: TensorDictBase

    def repeated(self, times: int) -> _Start:
        """Return each row several times, one after the other."""
        row = torch.arange(len(self.throw)).repeat_interleave(times)
        return _Start(
            throw=self.throw[row],
            simulation={key: value[row] for key, value in self.simulation.items()},
            root=cast(TensorDictBase, self.root[row]),
        )


@torch.no_grad()
def find_upper_bound(
    policy: Policy,
    config: EnvConfig,
    search: SearchConfig,
    *,
    throw_set: int,
    throws: int,
    reach: float,
    ball: int = 1,
    on_iteration: Callable[[int, Outcome], None] | None = None,
) -> UpperBound:
    """Search for actions that avoid the balls of a throw set.

    The policy acts alone until the ball is within reach of a sensor. From then on a
    plan, a sequence of action vectors each held for some control steps, is added to its
    actions; the policy keeps the balance meanwhile and acts alone again afterwards.
    Plans are improved by the cross-entropy method (Rubinstein, 1999) with independent
    Gaussians. The zero plan is always tried: the best is never worse than the policy.

    Args:
        policy: Writes the mean action.
        config: Robot, task (its throws are those of the throw set), sensors.
        search: Settings of the search.
        throw_set: Seed of the throw set.
        throws: Number of episodes of the throw set.
        reach: Distance from a sensor to the ball's surface at which plans start [m].
        ball: Which ball of each episode, from 1; none is thrown after it.
        on_iteration: Called with (iterations done, the best outcome so far).

    Returns:
        Outcomes for the balls that came within reach before the episode ended.

    Raises:
        ValueError: If no ball comes within reach, or the sensors are corrupted (each
            copy of a throw would have other ones).
    """
    if config.sensor.corruption != "none":
        raise ValueError(
            "an upper bound requires ideal sensors, but the policy's have "
            f"corruption={config.sensor.corruption}"
        )
    hz, seed = config.task.physics.control_hz, throw_seed(config, throw_set)
    task = config.task
    duration = max(search.stand_s, _time_to_pass(task.throws, reach))
    steps = math.ceil(duration * hz)
    # The time limit must not cut a plan short.
    length = task.episode_length_s + duration
    longer = replace(config, task=replace(task, episode_length_s=length))

    def make(rows: int, config: EnvConfig) -> TransformedEnv:
        return make_worker_env(
            config,
            policy.skin,
            num_envs=rows,
            seed=seed,
            num_threads=default_num_workers(rows),
            keep_raw=True,
        )

    start = _until_in_reach(make(throws, config), policy, config, reach, ball)
    n, samples = len(start.throw), search.samples
    if n == 0:
        raise ValueError(f"none of {throws} balls came within {reach:g} m of a sensor")
    env, starts = make(n * samples, longer), start.repeated(samples)
    env.reset()
    mean = torch.zeros(n, _ENTRIES, len(config.robot_config.joints))
    spread = torch.full_like(mean, _FIRST_SPREAD)
    generator = torch.Generator().manual_seed(search.seed)
    elite = max(2, round(_ELITE * samples))
    every = torch.arange(n)
    least = torch.full((n,), torch.inf)
    best = own = Outcome(avoided=least < 0, stood=least < 0)
    for iteration in range(1, search.iterations + 1):
        noise = torch.randn(n, samples, *mean.shape[1:], generator=generator)
        plans = mean[:, None] + spread[:, None] * noise
        plans[:, 0], plans[:, 1] = 0.0, mean
        plan = plans.flatten(0, 1).repeat_interleave(_HELD, 1)
        untouched, avoided, age = (
            x.reshape(n, samples) for x in _play(env, policy, starts, plan, steps, ball)
        )
        stood = avoided & (age == steps)
        cost = torch.where(untouched, 1.0 - age / steps, 2.0)
        cost += _SIZE_COST * plans.square().mean((2, 3))
        if iteration == 1:
            own = Outcome(avoided=avoided[:, 0], stood=stood[:, 0])
        # The longest plan may end before the ball has passed.
        rank = torch.where(avoided, cost, cost + 4.0)
        chosen = rank.argmin(1)
        better = rank[every, chosen] < least
        least = torch.minimum(least, rank[every, chosen])
        best = Outcome(
            avoided=torch.where(better, avoided[every, chosen], best.avoided),
            stood=torch.where(better, stood[every, chosen], best.stood),
        )
        good = plans[every[:, None], cost.topk(elite, largest=False).indices]
        mean = _KEPT * mean + (1 - _KEPT) * good.mean(1)
        spread = _KEPT * spread + (1 - _KEPT) * good.std(1)
        spread.clamp_(min=_LEAST_SPREAD)
        if on_iteration is not None:
            on_iteration(iteration, best)
        if best.stood.all():
            break
    thrower = _task(env).thrower
    zero = torch.zeros_like(start.throw)
    height, _ = thrower.at_standing_robot(
        thrower.draw(seed, start.throw, zero, zero + ball - 1)
    )
    return UpperBound(height=height, policy=own, best=best)


def _time_to_pass(throws: ThrowConfig, reach: float) -> float:
    """Return how long the slowest ball needs until it has passed [s]."""
    flight = math.hypot(throws.distance[1], throws.height[1])
    way = min(reach + _SENSOR_TO_BASE, flight) + PASSED_DISTANCE
    return way / throws.speed[0]


def _until_in_reach(
    env: TransformedEnv, policy: Policy, config: EnvConfig, reach: float, ball: int = 1
) -> _Start:
    """Play a throw set; return the states at which the given ball comes in reach."""
    throws = env.batch_size[0]
    sensor = SensorConfig(coverage="field", signal="binary", range=reach)
    balls = config.task.throws.balls
    skin = policy.skin
    # The sensors' places, without their own coverage and range.
    bare = Skin(
        robot=skin.robot, links=skin.links, position=skin.position, normal=skin.normal
    )
    pipeline = SensorPipeline(sensor, config.robot_config, bare)
    dt = 1 / config.task.physics.control_hz
    sense = Compose(pipeline.transforms(balls, dt=dt))
    # Balls are thrown in turn; only the one of this throw is sensed.
    mine = torch.arange(len(balls)) == (ball - 1) % len(balls)
    root = env.reset()
    kept = root.clone()
    simulation = _task(env).simulation_state()
    waiting = torch.ones(throws, dtype=torch.bool)
    started = ~waiting
    for _ in range(config.task.max_first_throw_step + config.task.episode_steps):
        state = _task(env).balls.state
        last = state["throw"] == ball
        # No ball is thrown after it.
        state["next_throw_step"][last] = _NEVER
        seen = root.clone(recurse=False)
        seen["object_active"] = root["object_active"] & mine
        sensed = sense(seen)["signal"].any(-1) & last
        begin = waiting & sensed
        if begin.any():
            kept[begin] = root[begin]
            for key, value in _task(env).simulation_state().items():
                simulation[key][begin] = value[begin]
        started |= begin
        waiting &= ~sensed
        if not waiting.any():
            break
        step, root = env.step_and_maybe_reset(policy(root))
        waiting &= ~cast(TensorDictBase, step["next"])["done"][:, 0]
    throw = started.nonzero()[:, 0]
    return _Start(
        throw=throw,
        simulation={key: value[throw] for key, value in simulation.items()},
        root=cast(TensorDictBase, kept[throw]),
    )


def _play(
    env: TransformedEnv,
    policy: Policy,
    start: _Start,
    plan: Tensor,
    steps: int,
    ball: int,
) -> tuple[Tensor, Tensor, Tensor]:
    """Play from the start states with plans ``[M, T, J]`` added to the actions.

    Returns:
        Whether no ball hit; whether the given ball has passed without a hit, ``[M]``
        bool each; and number of steps survived, ``[M]``.
    """
    _task(env).load_simulation_state(start.simulation)
    root = start.root.clone()
    running = torch.ones(len(root), dtype=torch.bool)
    untouched, passed = running.clone(), ~running
    age = torch.full((len(root),), steps)
    for number in range(steps):
        action = policy(root)["action"]
        if number < plan.shape[1]:
            root["action"] = action + plan[:, number]
        step, root = env.step_and_maybe_reset(root)
        after = cast(TensorDictBase, step["next"])
        ended = running & after["done"][:, 0]
        untouched &= ~(ended & after["hit"][:, 0])
        passed |= running & (after["balls_avoided"].sum(-1) >= ball)
        age[ended] = number
        running &= ~ended
    return untouched, untouched & passed, age


def _task(env: TransformedEnv) -> DodgeballEnv:
    """Return the environment below the transforms."""
    task = env.base_env
    assert isinstance(task, DodgeballEnv)
    return task
