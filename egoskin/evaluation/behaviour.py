"""Behaviour of a policy on a throw set: throws dodged, displacement and motion.

Everything is computed from the environment's state. Throws are grouped by how they
arrive at a robot standing in its default pose, so a throw is in the same group for
every policy.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn

from egoskin.envs.throws import QUARTERS, Thrower, quarter_of
from egoskin.evaluation.feet import Feet
from egoskin.evaluation.throw_set import (
    Estimate,
    Evaluation,
    evaluate,
    play_throws,
    throw_seed,
    wilson,
)
from egoskin.make import EnvConfig
from egoskin.sensors import Skin

# Ages at which the displacement of the base is recorded [s].
_AGES = (1.0, 2.0, 3.0, 5.0)
_NUMBERS = ("first", "second", "third", "later")
# Bounds of the groups by height aimed at [m], by speed at arrival [m/s] and by time
# since the previous throw [s]. Each group has about a third of the throws of standard
# 1; standard 2 throws at no point of the H1-2 below 0.9 m.
_HEIGHTS, _SPEEDS, _GAPS = (0.9, 1.2), (5.3, 6.7), (1.33, 1.67)
# Time a robot needs to settle after its start [s].
_SETTLED = 0.5


@dataclass(frozen=True, kw_only=True)
class Group:
    """Results for the throws of one kind."""

    name: str
    """The property that they share."""
    success: Estimate | None
    """Success, as in `Evaluation`, of the episodes whose first ball is of this kind;
    None if there are none."""
    episodes: int
    """Number of these episodes."""
    first_hits: float | None
    """Share of hits among the first balls that arrived."""
    later_hits: float | None
    """Share of hits among the later balls that arrived."""
    later_balls: int
    """Number of later balls that arrived."""


@dataclass(frozen=True, kw_only=True)
class Displacement:
    """Position of the base in the episodes that last to an age."""

    age: float
    """Time since the first throw [s]."""
    episodes: int
    """Number of these episodes."""
    mean: float | None
    """Mean planar distance from the start [m]."""
    largest_tenth: float | None
    """90th percentile of the planar distance [m]."""
    height: float | None
    """Mean height of the base above ground [m]."""


@dataclass(frozen=True, kw_only=True)
class Motion:
    """Motion: means over all steps except those that terminate an episode."""

    power: float
    """Mechanical power of the joints, sum of ``|torque x velocity|`` [W]."""
    joint_acceleration: float
    """Root mean square joint acceleration, by differences of steps [rad/s^2]."""
    torque_saturation: float
    """Share of joint torques at their limit."""
    foot_slip: float | None
    """Sliding speed of the lowest point of a foot while on the floor [m/s]; None if it
    is never there, or the feet have no shapes."""
    airborne: float
    """Share of the steps in which no link touches the floor."""
    self_contact: float
    """Share of the steps in which the robot touches itself."""


@dataclass(frozen=True, kw_only=True)
class Waiting:
    """Motion before the first throw: means over all steps from 0.5 s on.

    They are None if no robot has such a step.
    """

    base_speed: float | None
    """Planar speed of the base [m/s]."""
    power: float | None
    """Mechanical power of the joints [W]."""
    fallen: float
    """Share of the episodes that end before the first throw."""


@dataclass(frozen=True, kw_only=True)
class Behaviour:
    """Behaviour of a policy on a throw set, over whole episodes."""

    throws: dict[str, list[Group]]
    """Groups by number of the ball, direction, height aimed at, speed at arrival, time
    since the previous throw, link aimed at."""
    waiting: Waiting | None
    """Motion before the first throw; None if that is at the start."""
    displacement: list[Displacement]
    """Distance from the start."""
    motion: Motion
    """Motion of the policy."""
    motion_zero_action: Motion
    """Motion of the zero action, whose target is the default pose."""


def behave(
    policy: nn.Module | TensorDictModuleBase | None,
    config: EnvConfig,
    skin: Skin,
    *,
    throw_set: int,
    episodes: int,
    num_workers: int | None = None,
    mask: Sequence[str] = (),
    on_step: Callable[[int, int], None] | None = None,
) -> tuple[Evaluation, Behaviour]:
    """Return the evaluation and the behaviour of a policy on a throw set.

    Args:
        policy: Writes ``action`` into a TensorDict; None is the zero action.
        config: Robot, task (its throws are those of the throw set), sensors.
        skin: The skin.
        throw_set: Seed of the throw set.
        episodes: Size of the throw set.
        num_workers: Physics threads; the result does not depend on it.
        mask: Links (or shell patterns) whose sensors detect nothing, or
            `egoskin.sensors.MASK_ALL`.
        on_step: Called with (steps done, episodes still running).
    """
    which: dict[str, Any] = {
        "throw_set": throw_set,
        "episodes": episodes,
        "num_workers": num_workers,
    }
    seen, still = (Watcher(config, throw_set, episodes) for _ in range(2))
    watching: dict[str, Any] = {"mask": mask, "on_step": on_step, "watch": seen}
    result = evaluate(policy, config, skin, **which, **watching)
    play_throws(None, config, skin, **which, watch=still)
    behaviour = Behaviour(
        throws=seen.groups(),
        waiting=seen.waiting(),
        displacement=seen.displacement(),
        motion=seen.motion(),
        motion_zero_action=still.motion(),
    )
    return result, behaviour


class Watcher:
    """Collects statistics over the steps of a throw set (a `throw_set.Watch`).

    Args:
        config: Environment configuration.
        throw_set: Seed of the throw set.
        episodes: Size of the throw set, ``N``.
    """

    def __init__(self, config: EnvConfig, throw_set: int, episodes: int) -> None:
        task, robot = config.task, config.robot_config
        self._hz, self._balls = task.physics.control_hz, task.throws.num_balls
        self._limit = round(task.success_age_s * self._hz)
        self._by_link = task.throws.aim != "box"
        self._thrower = Thrower(task.throws, robot, task.physics.timestep)
        shortest = max(1, round(task.throws.interval[0] * self._hz))
        count = 1 + task.episode_steps // shortest
        row = torch.arange(episodes).repeat_interleave(count)
        index = torch.arange(count).repeat(episodes)
        # The throws of each episode in turn, [N * K].
        seed = throw_seed(config, throw_set)
        self._draw = self._thrower.draw(seed, row, row * 0, index)
        gap = (self._draw.interval * self._hz).round().long().clamp(min=1)
        gap = gap.reshape(episodes, count)
        delay = self._thrower.first_delay(seed, row, row * 0).reshape(episodes, count)
        # Step at the end of which each ball is thrown, [N, K]; a function of the draws.
        self._thrown = gap.cumsum(1) - gap + (delay * self._hz).round().long()
        self._arrived = torch.zeros(episodes, count, dtype=torch.bool)
        self._hit = self._arrived.clone()
        self._failed = torch.zeros(episodes, dtype=torch.bool)
        # Distance and height at each age, of the episodes that last, [2, n].
        self._base: dict[float, list[Tensor]] = {moment: [] for moment in _AGES}
        self._waits = task.max_first_throw_step > 0
        self._waited = self._fallen_waiting = 0
        self._waiting_speed = self._waiting_power = 0.0
        self._feet = Feet(robot)
        self._step = 0
        self._sums: dict[str, float] = {}
        self._counts: dict[str, int] = {}

    def __call__(
        self, before: TensorDictBase, after: TensorDictBase, running: Tensor
    ) -> None:
        """Record one step; the arguments are those of `throw_set.Watch`."""
        self._step += 1
        ended = running & after["terminated"][:, 0]
        age = self._step - after["first_throw_step"][:, 0]
        self._failed |= ended & (age <= self._limit)
        going = running & ~ended
        self._fallen_waiting += int((ended & (age <= 0)).sum())
        if self._step >= round(_SETTLED * self._hz):
            self._see_waiting(after[going & (age <= 0)])
        for moment in _AGES:
            now = going & (age == round(moment * self._hz))
            way = after["displacement_w"][now].square().sum(-1).sqrt()
            self._base[moment].append(torch.stack((way, after["base_pose"][now, 2])))
        self._see_balls(after, running)
        # A hit, a fall or a failed simulation does not count as motion of the policy.
        self._see_motion(before[going], after[going])

    def _see_balls(self, after: TensorDictBase, running: Tensor) -> None:
        newest = (self._thrown < self._step).sum(1) - 1
        rows = running.nonzero()[:, 0]
        for ball in range(self._balls):
            # The latest throw of this ball; balls are thrown in turn.
            throw = (newest - (newest - ball) % self._balls)[rows]
            flown, throw = rows[throw >= 0], throw[throw >= 0]
            self._arrived[flown, throw] |= after["object_arrived"][flown, ball]
            self._hit[flown, throw] |= after["object_hit"][flown, ball]

    def _see_waiting(self, after: TensorDictBase) -> None:
        speed = after["base_lin_vel_w"][:, :2].square().sum(-1).sqrt()
        self._waited += len(after)
        self._waiting_speed += float(speed.double().sum())
        self._waiting_power += float(after["power"].double().sum())

    def waiting(self) -> Waiting | None:
        """Return the motion before the first throw; None if that is at the start."""
        if not self._waits:
            return None
        steps = self._waited
        return Waiting(
            base_speed=self._waiting_speed / steps if steps else None,
            power=self._waiting_power / steps if steps else None,
            fallen=self._fallen_waiting / len(self._failed),
        )

    def _see_motion(self, before: TensorDictBase, after: TensorDictBase) -> None:
        acceleration = (after["joint_vel"] - before["joint_vel"]) * self._hz
        slip = self._feet.slip(before, after) * self._hz
        values = {
            "power": after["power"],
            "joint_acceleration": acceleration.square(),
            "torque_saturation": after["torque_saturation"],
            "foot_slip": slip[slip.isfinite()],
            "airborne": ~after["tactile"].any(-1),
            "self_contact": after["self_contact"],
        }
        for name, value in values.items():
            total = float(value.double().sum())
            self._sums[name] = self._sums.get(name, 0.0) + total
            self._counts[name] = self._counts.get(name, 0) + value.numel()

    def motion(self) -> Motion:
        """Return the motion of the robot."""
        mean: dict[str, Any] = {
            name: total / max(self._counts[name], 1)
            for name, total in self._sums.items()
        }
        mean["joint_acceleration"] = math.sqrt(mean["joint_acceleration"])
        if not self._counts["foot_slip"]:
            mean["foot_slip"] = None
        return Motion(**mean)

    def displacement(self) -> list[Displacement]:
        """Return the displacement of the base at each age."""
        result = []
        for age in _AGES:
            way, height = torch.cat([torch.zeros(2, 0), *self._base[age]], 1)
            some = len(way) > 0
            result.append(
                Displacement(
                    age=age,
                    episodes=len(way),
                    mean=float(way.mean()) if some else None,
                    largest_tenth=float(way.quantile(0.9)) if some else None,
                    height=float(height.mean()) if some else None,
                )
            )
        return result

    def groups(self) -> dict[str, list[Group]]:
        """Return the results for the throws of each kind, by property."""
        height, speed = self._thrower.at_standing_robot(self._draw)
        number = torch.arange(self._arrived.shape[1]).clamp(max=len(_NUMBERS) - 1)
        result = {
            "number of the ball": self._split(
                number.expand(self._arrived.shape), _NUMBERS
            ),
            "direction": self._split(quarter_of(self._draw.azimuth), QUARTERS),
            "height aimed at": self._split(*_bands(height, _HEIGHTS, "m")),
            "speed at arrival": self._split(*_bands(speed, _SPEEDS, "m/s")),
            "since last throw": self._split(*self._gaps()),
        }
        if self._by_link:
            links = [
                name.removeprefix("left_").removeprefix("right_").removesuffix("_link")
                for name in self._thrower.aim_link(self._draw)
            ]
            names = sorted(set(links))
            index = torch.tensor([names.index(link) for link in links])
            result["link aimed at"] = self._split(index, names)
        return result

    def _gaps(self) -> tuple[Tensor, list[str]]:
        """Return the band of the time since the previous throw; 0 for first balls."""
        gap = (self._thrown[:, 1:] - self._thrown[:, :-1]) / self._hz
        band, names = _bands(gap, _GAPS, "s")
        first = torch.zeros_like(band[:, :1])
        return torch.cat((first, band + 1), 1), ["first ball", *names]

    def _split(self, kind: Tensor, names: Sequence[str]) -> list[Group]:
        """Return a group for each kind of throw; ``kind`` is ``[N * K]`` int64."""
        kind = kind.reshape(self._arrived.shape)
        return [self._group(kind == i, name) for i, name in enumerate(names)]

    def _group(self, member: Tensor, name: str) -> Group:
        """Return the results for the throws in ``member``, ``[N, K]`` bool."""
        first = member[:, 0]
        episodes = int(first.sum())
        failed = int((self._failed & first).sum())

        def hits(part: slice) -> tuple[float | None, int]:
            arrived = self._arrived[:, part] & member[:, part]
            number, hit = int(arrived.sum()), int((arrived & self._hit[:, part]).sum())
            return hit / number if number else None, number

        first_hits, _ = hits(slice(0, 1))
        later_hits, later_balls = hits(slice(1, None))
        return Group(
            name=name,
            success=wilson(episodes - failed, episodes) if episodes else None,
            episodes=episodes,
            first_hits=first_hits,
            later_hits=later_hits,
            later_balls=later_balls,
        )


def _bands(
    values: Tensor, bounds: Sequence[float], unit: str
) -> tuple[Tensor, list[str]]:
    """Return the band index of each value, ``[n]`` int64, and the bands' names."""
    between = [
        f"{a:g} to {b:g} {unit}" for a, b in zip(bounds, bounds[1:], strict=False)
    ]
    names = [f"below {bounds[0]:g} {unit}", *between, f"above {bounds[-1]:g} {unit}"]
    return torch.bucketize(values.contiguous(), torch.tensor(bounds)), names
