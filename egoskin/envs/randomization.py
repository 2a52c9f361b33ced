"""Domain randomisation for sim-to-real: robot parameters, action delay, pushes.

Contract: the robot's parameters, action delay and pushes in an episode are functions
of (seed, row, episode, ...), like all draws (`egoskin.rng`). With the defaults nothing
is drawn, and results are bit-identical to those without randomisation.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

import torch
from torch import Tensor

from egoskin.bounds import Interval, check_bounds, check_ranges
from egoskin.envs.physics.contract import Physics, Variation
from egoskin.rng import Stream, between, uniform

_Factor = Annotated[tuple[float, float], Interval(ge=0.01, le=100)]
_NONE = (1.0, 1.0)


@dataclass(frozen=True, kw_only=True)
class RandomizationConfig:
    """Ranges of the domain randomisation; each is sampled uniformly."""

    link_mass: _Factor = _NONE
    """Factor on mass and inertia of each link."""
    friction: _Factor = _NONE
    """Factor on the friction of robot and floor."""
    gains: _Factor = _NONE
    """Factor on kp and kd of each joint."""
    torque_limit: _Factor = _NONE
    """Factor on the torque limit of each joint."""
    delay_steps: Annotated[tuple[int, int], Interval(ge=0, le=100)] = (0, 0)
    """Delay of the actions [control steps], drawn once per episode."""
    push_speed: Annotated[tuple[float, float], Interval(ge=0, le=100)] = (0.0, 0.0)
    """Pushes: change of the base velocity, in a random horizontal direction [m/s]; 0:
    none."""
    push_interval: Annotated[tuple[float, float], Interval(gt=0, le=1000)] = (1.0, 3.0)
    """Time from one push to the next [s]."""

    def __post_init__(self) -> None:
        """Raise ValueError for invalid ranges."""
        check_bounds(self)
        check_ranges(self)
        if self.push_interval != RandomizationConfig.push_interval and not self.pushes:
            raise ValueError("push_interval has no effect without push_speed")

    @property
    def varies_robot(self) -> bool:
        """Whether robot parameters are randomised."""
        factors = (self.link_mass, self.friction, self.gains, self.torque_limit)
        return any(factor != _NONE for factor in factors)

    @property
    def pushes(self) -> bool:
        """Whether robots are pushed."""
        return self.push_speed[1] > 0


class Randomization:
    """Randomises the robots of every row: parameters, action delay and pushes.

    Args:
        config: The ranges.
        num_envs: Number of rows ``B``.
        num_links: Number of links ``L``.
        num_joints: Number of joints ``J``.
        control_hz: Rate of the control steps [Hz].
        device: Device of all tensors.
    """

    def __init__(
        self,
        config: RandomizationConfig,
        num_envs: int,
        num_links: int,
        num_joints: int,
        control_hz: float,
        device: torch.device,
    ) -> None:
        self.config, self._hz = config, control_hz
        self._links, self._joints = num_links, num_joints
        zeros = torch.zeros(num_envs, dtype=torch.int64, device=device)
        self.state: dict[str, Tensor] = {}
        """The state, ``[B, ...]`` each, for saving and restoring."""
        if most := config.delay_steps[1]:
            late = torch.zeros(
                num_envs, most, num_joints, dtype=torch.float32, device=device
            )
            self.state |= {"delay": zeros.clone(), "late_actions": late}
        if config.pushes:
            self.state |= {"push": zeros.clone(), "next_push_step": zeros.clone()}

    def variation(self, seed: int, ids: Tensor, episode: Tensor) -> Variation:
        """Return the variation of robots, a pure function of the arguments.

        Args:
            seed: Seed of the draws.
            ids: Global rows, ``[n]``.
            episode: Their episodes, ``[n]``.
        """
        config, joints = self.config, self._joints
        sizes = (self._links, 1, joints, joints)
        u = uniform(seed, Stream.ROBOT, ids, episode, torch.zeros_like(ids), sum(sizes))
        mass, friction, gains, limit = u.split(sizes, -1)
        return Variation(
            link_mass=between(config.link_mass, mass),
            friction=between(config.friction, friction[:, 0]),
            gains=between(config.gains, gains),
            torque_limit=between(config.torque_limit, limit),
            varies_mass=config.link_mass != _NONE,
        )

    def start(
        self, physics: Physics, rows: Tensor, seed: int, ids: Tensor, episode: Tensor
    ) -> None:
        """Begin the episodes of some rows.

        Args:
            physics: The simulations.
            rows: Rows whose episodes begin, ``[n]``.
            seed: Seed of the draws.
            ids: Global indices of these rows.
            episode: Their episodes.
        """
        for value in self.state.values():
            value[rows] = 0
        if self.config.varies_robot:
            physics.vary(rows, self.variation(seed, ids, episode))
        if "delay" in self.state:
            low, high = self.config.delay_steps
            u = uniform(seed, Stream.DELAY, ids, episode, torch.zeros_like(ids), 1)
            self.state["delay"][rows] = low + (u[:, 0] * (high + 1 - low)).long()
        if self.config.pushes:
            self._plan_push(rows, seed, ids, episode)

    def _plan_push(self, rows: Tensor, seed: int, ids: Tensor, episode: Tensor) -> None:
        """Draw the time of the next push."""
        count = self.state["push"][rows]
        wait = uniform(seed, Stream.PUSH, ids, episode, count, 3)[:, 0]
        steps = (between(self.config.push_interval, wait) * self._hz).round().long()
        self.state["next_push_step"][rows] += steps.clamp(min=1)

    def due(self, step: Tensor) -> Tensor:
        """Return the rows ``[n]`` due for a push at episode steps ``[B]``."""
        if not self.config.pushes:
            return step.new_empty(0)
        return (step >= self.state["next_push_step"]).nonzero()[:, 0]

    def push(
        self, physics: Physics, rows: Tensor, seed: int, ids: Tensor, episode: Tensor
    ) -> None:
        """Push the robots of some rows; arguments as in `start`."""
        count = self.state["push"][rows]
        u = uniform(seed, Stream.PUSH, ids, episode, count, 3)
        speed, n = between(self.config.push_speed, u[:, 2]), len(rows)
        # Padded to a multiple of 32: a cosine may round differently in an array's tail.
        angle = torch.nn.functional.pad(2 * math.pi * u[:, 1], (0, -n % 32))
        way = torch.stack((angle.cos(), angle.sin()), -1)[:n]
        velocity = torch.nn.functional.pad(speed[:, None] * way, (0, 1))
        physics.push(rows, velocity)
        self.state["push"][rows] += 1
        self._plan_push(rows, seed, ids, episode)

    def delayed(self, action: Tensor) -> Tensor:
        """Return the delayed actions that apply now, ``[B, J]``; 0 at first."""
        if "delay" not in self.state:
            return action
        all_actions = torch.cat((action[:, None], self.state["late_actions"]), 1)
        self.state["late_actions"].copy_(all_actions[:, :-1])
        rows = torch.arange(len(action), device=action.device)
        return all_actions[rows, self.state["delay"]]
