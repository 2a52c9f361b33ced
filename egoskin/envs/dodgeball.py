"""The dodgeball task as a batched, batch-locked TorchRL environment."""

from __future__ import annotations

import inspect
import math
from dataclasses import dataclass, field
from typing import Annotated

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Composite, Unbounded
from torchrl.envs import EnvBase

from egoskin.bounds import COUNT, Interval, check_bounds
from egoskin.envs.balls import Balls
from egoskin.envs.physics import (
    MujocoPhysics,
    Physics,
    PhysicsConfig,
    PhysicsState,
    Scene,
)
from egoskin.envs.randomization import Randomization, RandomizationConfig
from egoskin.envs.rewards import TERMS, RewardConfig, reward_terms
from egoskin.envs.state import STATE, state_spec, state_table
from egoskin.envs.throws import ThrowConfig, Thrower
from egoskin.rng import Stream, stream_key, uniform
from egoskin.robots.config import RobotConfig
from egoskin.robots.kinematics import axis_vectors, rotate_inverse
from egoskin.rounding import pad_rows


@dataclass(frozen=True, kw_only=True)
class DodgeballConfig:
    """The task: robot actuation, throws, rewards, start and end of an episode."""

    physics: PhysicsConfig = field(default_factory=PhysicsConfig)
    """Actuation and rates of the simulation."""
    throws: ThrowConfig = field(default_factory=ThrowConfig)
    """The balls and how they are thrown."""
    reward: RewardConfig = field(default_factory=RewardConfig)
    """Weights of the reward terms."""
    randomization: RandomizationConfig = field(default_factory=RandomizationConfig)
    """Domain randomisation for sim-to-real; none by default."""
    action_scale: Annotated[float, Interval(gt=0, le=100)] = 0.3
    """q* = q_default + action_scale x torque limit / kp x action, per joint. (It is not
    clipped to the joint's range, which would limit an ankle's torque.)"""
    episode_length_s: Annotated[float, Interval(gt=0, le=3600)] = 10.0
    """Episodes are truncated this long after the first throw [s]."""
    success_s: Annotated[float, Interval(gt=0, le=3600)] = 3.0
    """Success: no termination within this time after the first throw [s]."""
    self_contact_ends: bool = False
    """Whether self-contact terminates the episode, as a fall does."""
    start_joint_noise: Annotated[float, Interval(ge=0, le=10)] = 0.05
    """Largest uniform offset of the initial joints from the default pose [rad]."""

    def __post_init__(self) -> None:
        """Raise ValueError for invalid values."""
        check_bounds(self)
        if self.episode_length_s * self.physics.control_hz < 1:
            raise ValueError(
                "episode_length_s must be at least one control step, got "
                f"{self.episode_length_s}"
            )

    @property
    def episode_steps(self) -> int:
        """Control steps from the first throw to truncation."""
        return round(self.episode_length_s * self.physics.control_hz)

    @property
    def success_age_s(self) -> float:
        """Time from the first throw after which an episode counts as success [s]."""
        return min(self.success_s, self.episode_length_s)

    @property
    def max_first_throw_step(self) -> int:
        """Largest number of control steps before the first throw."""
        return round(self.throws.first_delay[1] * self.physics.control_hz)


class DodgeballEnv(EnvBase):
    """A robot that must not be hit by thrown balls, ``num_envs`` rows at a time.

    **Action** ``action [B, J]``, unbounded: position targets
    q* = q_default + scale x action, scale per joint; see `DodgeballConfig`.

    **Observation**: the environment returns the state below; transforms
    (`egoskin.make`) compute the observations of the actor and the critic from it.

    STATE

    **Reward**: the sum of ``reward_terms``; see `egoskin.envs.rewards`.

    **Start**: default pose with small joint noise, on the ground at the origin, with
    uniform heading, at rest; the first ball is thrown after a random delay.

    **End**: ``terminated`` if hit, fallen or diverged or, with ``self_contact_ends``,
    in self-contact; ``truncated`` ``episode_length_s`` after the first throw. A
    diverged row is reset like any other and does not affect other rows.

    All draws are functions of (seed, global row, episode, ...): rows
    ``row_offset`` to ``row_offset + num_envs`` give the same episodes whichever
    process simulates them. With a ParallelEnv of your own, call
    ``set_seed(seed, static_seed=True)``.

    Args:
        robot: The robot.
        config: The task.
        num_envs: Number of rows ``B`` of this environment.
        seed: Seed of all draws.
        row_offset: Global index of the first row.
        num_threads: Physics threads; results do not depend on it.
        hold: Whether the robot is held rigid in its start pose.
        tactile: Whether to return the links touched, under the key ``tactile``.
        engine: Physics engine.
        device: Device of the simulation and of all tensors. ``to`` moves inputs and
            outputs to another one; the simulation stays.

    Raises:
        ValueError: If the robot's base does not float, or a joint is not a hinge, or a
            number is out of bounds.
    """

    def __init__(
        self,
        robot: RobotConfig,
        config: DodgeballConfig,
        *,
        num_envs: int,
        seed: int = 0,
        row_offset: int = 0,
        num_threads: int = 1,
        hold: bool = False,
        tactile: bool = True,
        engine: type[Physics] = MujocoPhysics,
        device: torch.device | str = "cpu",
    ) -> None:
        robot.check_floating_base()
        stream_key(seed, Stream.START)
        bounds = {
            "num_envs": (num_envs, COUNT),
            "num_threads": (num_threads, COUNT),
            "row_offset": (row_offset, Interval(ge=0, le=2**32 - num_envs)),
        }
        for name, (number, interval) in bounds.items():
            if wrong := interval.violation(number):
                raise ValueError(f"{name} must {wrong}, got {number}")
        super().__init__(device=device, batch_size=torch.Size([num_envs]))
        # Where it is computed; `self.device`, of inputs and outputs, can be changed.
        self._simulated_on = device = self.device
        self.robot, self.config = robot, config
        self._seed, self._num_threads, self._engine = seed, num_threads, engine
        throws = config.throws
        self.scene = Scene(
            robot=robot,
            objects=throws.balls,
            config=config.physics,
            weightless_objects=not throws.gravity,
            link_contacts=tactile,
            hold=hold,
        )
        self.thrower = Thrower(throws, robot, config.physics.timestep, device)
        control_hz = config.physics.control_hz
        self.balls = Balls(
            self.thrower, self.scene.objects, num_envs, control_hz, device
        )
        self._physics: Physics | None = None
        kp, _ = robot.joint_gains(config.physics.gains)
        self._default = torch.from_numpy(robot.default_joint_pos).float().to(device)
        scale = config.action_scale * robot.torque_limit / kp
        self._action_scale = torch.from_numpy(scale).float().to(device)
        self._rows = torch.arange(num_envs, device=device) + row_offset
        self._first_row = row_offset
        zeros = torch.zeros(num_envs, dtype=torch.int64, device=device)
        self._counters = {
            # The first reset starts episode 0.
            "episode": zeros - 1,
            "step": zeros,
            "previous_action": torch.zeros(
                num_envs, len(robot.joints), dtype=torch.float32, device=device
            ),
        }
        self.state_rows = [key for key in STATE if tactile or key.name != "tactile"]
        """Rows of `STATE` that are part of the output."""
        self._sizes = {
            "J": len(robot.joints),
            "L": len(robot.links),
            "O": len(self.scene.objects),
            "R": len(TERMS),
        }
        self.randomization = Randomization(
            config.randomization,
            num_envs,
            self._sizes["L"],
            self._sizes["J"],
            control_hz,
            device,
        )
        self._make_specs(num_envs)

    def _make_specs(self, n: int) -> None:
        on = self.device
        self.observation_spec = state_spec(self.state_rows, n, self._sizes, on)
        action = torch.Size((n, self._sizes["J"]))
        # Float32 whatever the default of the user's program is.
        number, reward = torch.float32, torch.Size((n, 1))
        self.action_spec = Unbounded(shape=action, device=on, dtype=number)
        self.reward_spec = Unbounded(shape=reward, device=on, dtype=number)
        ends = ("done", "terminated", "truncated")
        end = Binary(shape=torch.Size((n, 1)), dtype=torch.bool, device=on)
        self.done_spec = Composite(
            {key: end.clone() for key in ends}, shape=torch.Size([n]), device=on
        )

    @property
    def physics(self) -> Physics:
        """The simulations, built on first use (a parent process does not need them)."""
        if self._physics is None:
            self._physics = self._engine(
                self.scene,
                self.batch_size[0],
                num_threads=self._num_threads,
                device=self._simulated_on,
            )
        return self._physics

    def check_scene(self) -> None:
        """Raise ValueError if the engine cannot simulate the robot and the balls."""
        _ = self.physics

    def _set_seed(self, seed: int | None) -> None:
        if seed is not None:
            self._seed = seed
            self._counters["episode"].fill_(-1)

    def _reset(
        self, tensordict: TensorDictBase | None = None, **kwargs: object
    ) -> TensorDictBase:
        mask = None if tensordict is None else tensordict.get("_reset", None)
        if mask is None:
            mask = torch.ones_like(self._rows, dtype=torch.bool)
        mask = mask.to(self._simulated_on)
        rows = mask.reshape(-1).nonzero()[:, 0]
        if len(rows):
            self._start_episodes(rows)
            self._throw(rows[self.balls.due(self._counters["step"])[rows]])
        out = self._state_td(self.physics.read())
        for key in self.state_rows:
            if key.of_step:
                out[key.name] = self.observation_spec[key.name].zero()
        for key in self.done_keys:
            out[key] = torch.zeros_like(mask).reshape(-1, 1)
        return out

    def _start_episodes(self, rows: Tensor) -> None:
        """Put some rows into their start pose and reset their counters."""
        counters, n = self._counters, len(rows)
        counters["episode"][rows] += 1
        counters["step"][rows] = 0
        counters["previous_action"][rows] = 0
        padded = pad_rows(rows)
        seed, ids, episode = self._draws_of(padded)
        zero = torch.zeros_like(padded)
        joints = len(self.robot.joints)
        u = uniform(seed, Stream.START, ids, episode, zero, 1 + joints)
        half = math.pi * (u[:, 0] - 0.5)
        pose = u.new_zeros(len(padded), 7)
        pose[:, 2] = self.robot.default_base_height
        pose[:, 3], pose[:, 6] = half.cos(), half.sin()
        noise = self.config.start_joint_noise * (2 * u[:, 1:] - 1)
        joint_pos = self._default + (0.0 if self.scene.hold else noise)
        self.physics.reset(rows, pose[:n], joint_pos.expand_as(noise)[:n])
        self.balls.start(rows, seed, ids, episode)
        self.randomization.start(self.physics, rows, seed, ids[:n], episode[:n])

    def _throw(self, rows: Tensor) -> None:
        """Throw the next ball of some rows, of which there may be none."""
        if len(rows):
            step = self._counters["step"][rows]
            self.balls.throw(self.physics, rows, step, *self._draws_of(pad_rows(rows)))

    def _draws_of(self, rows: Tensor) -> tuple[int, Tensor, Tensor]:
        """Return the arguments of the draws of some rows: seed, global row, episode."""
        return self._seed, self._rows[rows], self._counters["episode"][rows]

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        counters, config = self._counters, self.config
        # As with other simulators, no gradient passes through a step.
        action = tensordict["action"].detach().to(self._simulated_on)
        # q* = q_default + scale x action
        acting = self.randomization.delayed(action)
        target = self._default + self._action_scale * acting
        pushed = self.randomization.due(counters["step"])
        if len(pushed) and not self.scene.hold:
            self.randomization.push(self.physics, pushed, *self._draws_of(pushed))
        result = self.physics.step(target, self.balls.state["active"])
        counters["step"] += 1
        state = self.physics.read()

        # Contacts of diverged rows are ignored.
        sound = ~result.diverged
        hit_by = result.object_hit & self.balls.state["active"] & sound[:, None]
        hit, fallen = hit_by.any(-1), result.fallen & sound
        terminated = hit | fallen | result.diverged
        if config.self_contact_ends:
            terminated |= result.self_contact
        since = counters["step"] - self.balls.state["first_throw_step"]
        truncated = (since >= config.episode_steps) & ~terminated
        self.balls.count(state, hit_by, sound[:, None])
        # Copied before the next throw, which clears the flag of its ball.
        arrived = self.balls.state["passed"].clone()

        due = self.balls.due(counters["step"]) & ~terminated & ~truncated
        # Their number is all that is read by the host.
        throwing = due.nonzero()[:, 0]
        if len(throwing):
            self._throw(throwing)
            state = self.physics.read()

        out = self._state_td(state)
        quat = state.base_pose[:, 3:]
        gravity_b = rotate_inverse(quat, axis_vectors(quat, 2, -1.0))
        terms = reward_terms(
            self.config.reward,
            gravity_b=gravity_b,
            joint_deviation=state.joint_pos - self._default,
            power=result.power,
            base_lin_vel_w=state.base_lin_vel_w,
            displacement_w=state.base_pose[:, :2],
            action_change=action - counters["previous_action"],
            terminated=terminated,
        )
        # Diverged rows get zero reward.
        terms = torch.where(result.diverged[:, None], 0.0, terms)
        counters["previous_action"].copy_(action)
        out["previous_action"] = action.clone()
        out["reward_terms"] = terms
        out["reward"] = terms.sum(-1, keepdim=True)
        if result.link_contact is not None:
            out["tactile"] = result.link_contact
        out["hit"], out["fallen"] = hit[:, None], fallen[:, None]
        out["diverged"] = result.diverged[:, None]
        out["self_contact"] = result.self_contact[:, None]
        out["power"] = result.power[:, None]
        out["torque_saturation"] = result.torque_saturation[:, None]
        out["object_hit"], out["object_arrived"] = hit_by, arrived
        out["terminated"], out["truncated"] = terminated[:, None], truncated[:, None]
        out["done"] = (terminated | truncated)[:, None]
        return out

    def _state_td(self, state: PhysicsState) -> TensorDict:
        """Return the state part of an output; its tensors are copies."""
        counters, balls = self._counters, self.balls.state
        return TensorDict(
            {
                "base_pose": state.base_pose,
                "base_lin_vel_w": state.base_lin_vel_w,
                "base_ang_vel_b": state.base_ang_vel_b,
                "joint_pos": state.joint_pos,
                "joint_vel": state.joint_vel,
                "object_pose": state.object_pose,
                "object_lin_vel_w": state.object_lin_vel_w,
                "object_active": balls["active"].clone(),
                # Every episode starts at the origin.
                "displacement_w": state.base_pose[:, :2].clone(),
                "previous_action": counters["previous_action"].clone(),
                "balls_arrived": balls["arrived"].clone(),
                "balls_avoided": balls["avoided"].clone(),
                "episode_step": counters["step"][:, None].clone(),
                "first_throw_step": balls["first_throw_step"][:, None].clone(),
            },
            batch_size=self.batch_size,
            device=self.device,
        )

    def simulation_state(self) -> dict[str, Tensor]:
        """Return everything needed to continue bit for bit, ``[B, ...]`` each."""
        counted = self._counted()
        return {
            "physics": self.physics.state(),
            **{key: value.clone() for key, value in counted.items()},
        }

    def load_simulation_state(self, state: dict[str, Tensor]) -> None:
        """Restore a state that `simulation_state` returned.

        Args:
            state: State of *all* rows of the run; this environment uses only its own.
        """
        mine = slice(self._first_row, self._first_row + len(self._rows))
        for key, value in self._counted().items():
            value.copy_(state[key][mine])
        if self.config.randomization.varies_robot:
            rows = self._rows - self._first_row
            own = self.randomization.variation(*self._draws_of(rows))
            self.physics.vary(rows, own)
        self.physics.load_state(state["physics"][mine])

    def _counted(self) -> dict[str, Tensor]:
        """Return all state other than that of the physics, ``[B, ...]`` each."""
        return {**self._counters, **self.balls.state, **self.randomization.state}


if DodgeballEnv.__doc__:
    # Python removes the indentation of docstrings, from 3.13 on.
    DodgeballEnv.__doc__ = inspect.cleandoc(DodgeballEnv.__doc__).replace(
        "STATE", state_table()
    )
