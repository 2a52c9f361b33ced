"""The dodgeball task as a batched, batch-locked TorchRL environment."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Annotated

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase

from egoskin.bounds import Interval, check_bounds
from egoskin.draws import Stream, uniform
from egoskin.envs.physics import Physics, PhysicsConfig, PhysicsState, build_scene
from egoskin.envs.rewards import TERMS, RewardConfig, reward_terms
from egoskin.envs.throws import ThrowConfig, Thrower
from egoskin.kinematics import pad_rows, rotate_inverse
from egoskin.robots import RobotConfig

PASSED_DISTANCE = 1.0
"""A ball has passed once it flies away from the base and is farther than this [m]."""


@dataclass(frozen=True, kw_only=True)
class DodgeballConfig:
    """The task: robot actuation, throws, rewards, start and end of an episode."""

    physics: PhysicsConfig = field(default_factory=PhysicsConfig)
    """Actuation, rates and accuracy of the simulation."""
    throws: ThrowConfig = field(default_factory=ThrowConfig)
    """The balls and how they are thrown."""
    reward: RewardConfig = field(default_factory=RewardConfig)
    """Weights of the reward terms."""
    action_scale: Annotated[float, Interval(gt=0, le=100)] = 0.3
    """q* = q_default + action_scale x torque limit / kp x action, per joint."""
    one_action_scale: Annotated[float | None, Interval(gt=0, le=100)] = None
    """The same scale for all joints instead [rad]."""
    clip_targets: bool = False
    """Clip q* to the joint ranges (an ankle could then ask for little torque)."""
    episode_length_s: Annotated[float, Interval(gt=0, le=3600)] = 10.0
    """Episodes are truncated this long after the first throw [s]."""
    success_s: Annotated[float, Interval(gt=0, le=3600)] = 3.0
    """An episode not terminated until this long after the first throw succeeds [s]."""
    self_contact_ends: bool = False
    """Whether a robot that touches itself terminates the episode, as a fall does."""
    start_joint_noise: Annotated[float, Interval(ge=0, le=10)] = 0.05
    """Joints start uniformly within this of the default pose [rad]."""

    def __post_init__(self) -> None:
        """Raise ValueError for values that make no episode."""
        check_bounds(self)
        if self.episode_length_s * self.physics.control_hz < 1:
            raise ValueError(
                "episode_length_s must be at least one control step, got "
                f"{self.episode_length_s}"
            )
        if self.self_contact_ends and not self.physics.self_collision:
            raise ValueError(
                "self_contact_ends needs physics.self_collision: without it the robot "
                "never touches itself"
            )

    @property
    def episode_steps(self) -> int:
        """Control steps from the first throw to the end of a whole episode."""
        return round(self.episode_length_s * self.physics.control_hz)

    @property
    def delay_steps(self) -> int:
        """Most control steps before the first throw."""
        return round(self.throws.first_delay[1] * self.physics.control_hz)


class DodgeballEnv(EnvBase):
    """A robot that must not be hit by thrown balls, ``num_envs`` rows at a time.

    **Action** ``action [B, J]``, unbounded: position targets
    q* = q_default + scale x action, scale per joint; see `DodgeballConfig`.

    **Observation**: the environment assembles none; it gives the state, from which
    transforms (`egoskin.make`) make what the actor and the critic see.

    ====================== =============== ==========================================
    key                    shape           content
    ====================== =============== ==========================================
    ``base_pose``          ``[B, 7]``      position [m], quaternion (w, x, y, z)
    ``base_lin_vel_w``     ``[B, 3]``      velocity of the base's origin [m/s]
    ``base_ang_vel_b``     ``[B, 3]``      angular velocity [rad/s]
    ``joint_pos``          ``[B, J]``      joint positions [rad]
    ``joint_vel``          ``[B, J]``      joint velocities [rad/s]
    ``object_pose``        ``[B, O, 7]``   position [m], quaternion, in the world
    ``object_lin_vel_w``   ``[B, O, 3]``   velocity of the objects [m/s]
    ``object_active``      ``[B, O]``      whether the object is in play
    ``tactile``            ``[B, L]``      whether each link touched ball or floor
    ``displacement_w``     ``[B, 2]``      planar way from the start [m]
    ``previous_action``    ``[B, J]``      action of the step before (0 at the start)
    ``reward_terms``       ``[B, R]``      the weighted terms, in the order of TERMS
    ``hit``                ``[B, 1]``      a ball touched the robot
    ``fallen``             ``[B, 1]``      a link other than a foot touched the floor
    ``diverged``           ``[B, 1]``      the simulation failed
    ``self_contact``       ``[B, 1]``      the robot touched itself
    ``power``              ``[B, 1]``      mechanical power of the joints [W]
    ``torque_saturation``  ``[B, 1]``      share of the joints at their torque limit
    ``object_hit``         ``[B, O]``      whether the ball touched the robot
    ``object_arrived``     ``[B, O]``      ... or has passed, since it was thrown
    ``balls_arrived``      ``[B, 2]``      first ball, later balls: arrived so far
    ``balls_avoided``      ``[B, 2]``      ... of which without touching
    ``episode_step``       ``[B, 1]``      age of the episode in control steps
    ``first_throw_step``   ``[B, 1]``      age at which its first ball is thrown
    ====================== =============== ==========================================

    **Reward**: the sum of ``reward_terms``; see `egoskin.envs.rewards`.

    **Start**: default pose with a little joint noise on the ground at the origin,
    uniform heading, at rest; the first ball is thrown after a random delay.

    **End**: ``terminated`` = hit or fallen or diverged, or self-contact if that ends
    an episode; ``truncated`` some time after the first throw. A diverged row is reset
    like any other and harms no other row.

    All draws are functions of (seed, global row, episode, ...): rows
    ``row_offset`` to ``row_offset + num_envs`` give the same episodes whichever
    process simulates them. Split over a ParallelEnv, use
    ``set_seed(seed, static_seed=True)``.

    Args:
        robot: The robot.
        config: The task.
        num_envs: Number of rows ``B`` of this environment.
        seed: Seed of all draws.
        row_offset: Global index of the first row.
        num_threads: Physics threads; results do not depend on it.
        hold: Whether the robot is held rigid in its start pose.

    Raises:
        ValueError: If the robot's base does not float, or a joint is no hinge.
    """

    physics_class: type[Physics] = Physics
    """The backend."""

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
    ) -> None:
        robot.check_floating_base()
        super().__init__(device="cpu", batch_size=torch.Size([num_envs]))
        self.robot, self.config = robot, config
        self._seed, self._hold, self._num_threads = seed, hold, num_threads
        self.thrower = Thrower(config.throws, robot, config.physics.timestep)
        self._physics: Physics | None = None
        kp, _ = robot.joint_gains(config.physics.gains)
        self._default = torch.from_numpy(robot.default_joint_pos).float()
        scale = config.action_scale * robot.torque_limit / kp
        if config.one_action_scale is not None:
            scale[:] = config.one_action_scale
        self._action_scale = torch.from_numpy(scale).float()
        self._joint_range = torch.from_numpy(robot.joint_range).float()
        self._may_touch_floor = torch.tensor([n in robot.feet for n in robot.links])
        self._rows = torch.arange(num_envs) + row_offset
        balls = config.throws.num_balls
        zeros = torch.zeros(num_envs, dtype=torch.int64)
        self._counters = {
            # The first reset starts episode 0.
            "episode": zeros - 1,
            "step": zeros.clone(),
            "throw": zeros.clone(),
            "next_throw_step": zeros.clone(),
            "first_throw_step": zeros.clone(),
            "active": torch.zeros(num_envs, balls, dtype=torch.bool),
            "is_first": torch.zeros(num_envs, balls, dtype=torch.bool),
            "passed": torch.zeros(num_envs, balls, dtype=torch.bool),
            "arrived": torch.zeros(num_envs, 2),
            "avoided": torch.zeros(num_envs, 2),
            "previous_action": torch.zeros(num_envs, len(robot.joints)),
        }
        self._make_specs(num_envs, balls)

    def _make_specs(self, n: int, balls: int) -> None:
        joints, links = len(self.robot.joints), len(self.robot.links)

        def unbounded(*shape: int) -> Unbounded:
            return Unbounded(shape=torch.Size((n, *shape)), dtype=torch.float32)

        def flag(*shape: int) -> Binary:
            return Binary(shape=torch.Size((n, *shape)), dtype=torch.bool)

        def age(most: int) -> Bounded:
            return Bounded(0, most, shape=torch.Size((n, 1)), dtype=torch.int64)

        self.observation_spec = Composite(
            base_pose=unbounded(7),
            base_lin_vel_w=unbounded(3),
            base_ang_vel_b=unbounded(3),
            joint_pos=unbounded(joints),
            joint_vel=unbounded(joints),
            object_pose=unbounded(balls, 7),
            object_lin_vel_w=unbounded(balls, 3),
            object_active=flag(balls),
            tactile=flag(links),
            displacement_w=unbounded(2),
            previous_action=unbounded(joints),
            reward_terms=unbounded(len(TERMS)),
            hit=flag(1),
            fallen=flag(1),
            diverged=flag(1),
            self_contact=flag(1),
            power=unbounded(1),
            torque_saturation=unbounded(1),
            object_hit=flag(balls),
            object_arrived=flag(balls),
            balls_arrived=unbounded(2),
            balls_avoided=unbounded(2),
            episode_step=age(self.config.delay_steps + self.config.episode_steps),
            first_throw_step=age(self.config.delay_steps),
            shape=torch.Size([n]),
        )
        self.action_spec = unbounded(joints)
        self.reward_spec = unbounded(1)
        self.done_spec = Composite(
            done=flag(1), terminated=flag(1), truncated=flag(1), shape=torch.Size([n])
        )

    @property
    def physics(self) -> Physics:
        """The simulations, built when first needed (a parent process needs none)."""
        if self._physics is None:
            config, throws = self.config, self.config.throws
            scene = build_scene(
                self.robot,
                throws.balls,
                config.physics,
                weightless_objects=not throws.gravity,
                objects_bounce=throws.on_ground == "bounce",
                object_mass=throws.mass,
            )
            self._physics = self.physics_class(
                scene,
                self.robot,
                self.batch_size[0],
                config.physics,
                num_threads=self._num_threads,
                hold=self._hold,
            )
        return self._physics

    def check_scene(self) -> None:
        """Raise ValueError if MuJoCo cannot make the robot and the balls."""
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
            mask = torch.ones(self.batch_size[0], dtype=torch.bool)
        rows = mask.reshape(-1).nonzero()[:, 0]
        if len(rows):
            self._start_episodes(rows)
            at_once = rows[self._counters["first_throw_step"][rows] == 0]
            if len(at_once):
                self._throw(at_once)
        never = torch.zeros(self.batch_size[0], 1, dtype=torch.bool)
        out = self._state_td(self.physics.read())
        out["reward_terms"] = torch.zeros(self.batch_size[0], len(TERMS))
        out["tactile"] = never.repeat(1, len(self.robot.links))
        for key in ("hit", "fallen", "diverged", "self_contact"):
            out[key] = never.clone()
        for key in ("power", "torque_saturation"):
            out[key] = torch.zeros(self.batch_size[0], 1)
        for key in ("object_hit", "object_arrived"):
            out[key] = never.repeat(1, self.config.throws.num_balls)
        for key in ("done", "terminated", "truncated"):
            out[key] = never.clone()
        return out

    def _start_episodes(self, rows: Tensor) -> None:
        """Put some rows into their start pose and start their counters."""
        counters = self._counters
        for key, value in counters.items():
            if key != "episode":
                value[rows] = 0
        counters["episode"][rows] += 1
        padded = pad_rows(rows)
        episode = counters["episode"][padded]
        joints = len(self.robot.joints)
        u = uniform(
            self._seed,
            Stream.START,
            self._rows[padded],
            episode,
            torch.zeros_like(padded),
            1 + joints,
        )
        half = math.pi * (u[:, 0] - 0.5)
        pose = torch.zeros(len(padded), 7)
        pose[:, 2] = self.robot.default_base_height
        pose[:, 3], pose[:, 6] = half.cos(), half.sin()
        noise = self.config.start_joint_noise * (2 * u[:, 1:] - 1)
        joint_pos = self._default + (0.0 if self._hold else noise)
        n = len(rows)
        self.physics.reset(rows.numpy(), pose[:n], joint_pos.expand_as(noise)[:n])
        delay = self.thrower.first_delay(self._seed, self._rows[padded], episode)[:n]
        steps = (delay * self.config.physics.control_hz).round().long()
        for key in ("first_throw_step", "next_throw_step"):
            counters[key][rows] = steps

    def _throw(self, rows: Tensor) -> None:
        """Throw the next ball of some rows at the robot as it is now."""
        counters, padded, n = self._counters, pad_rows(rows), len(rows)
        state = self.physics.read(padded.numpy())
        throw = counters["throw"]
        draw = self.thrower.draw(
            self._seed,
            self._rows[padded],
            counters["episode"][padded],
            throw[padded],
        )
        release = self.thrower.release(
            draw, state.base_pose, state.base_lin_vel_w, state.joint_pos
        )
        ball = throw[rows] % self.config.throws.num_balls
        self.physics.throw(
            rows.numpy(), ball.numpy(), release.position[:n], release.velocity[:n]
        )
        counters["active"][rows, ball] = True
        counters["passed"][rows, ball] = False
        counters["is_first"][rows, ball] = throw[rows] == 0
        steps = (draw.interval[:n] * self.config.physics.control_hz).round().long()
        counters["next_throw_step"][rows] = counters["step"][rows] + steps.clamp(min=1)
        throw[rows] += 1

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        counters, config = self._counters, self.config
        action = tensordict["action"]
        # q* = q_default + scale x action
        target = self._default + self._action_scale * action
        if config.clip_targets:
            target = target.clamp(*self._joint_range)
        result = self.physics.step(target, counters["active"])
        counters["step"] += 1
        state = self.physics.read()

        # What a failed simulation touches means nothing.
        sound = ~result.diverged[:, None]
        hit_by = result.object_hit & counters["active"] & sound
        hit = hit_by.any(-1)
        fallen = (result.floor_contact & ~self._may_touch_floor & sound).any(-1)
        terminated = hit | fallen | result.diverged
        if config.self_contact_ends:
            terminated |= result.self_contact
        since = counters["step"] - counters["first_throw_step"]
        truncated = (since >= config.episode_steps) & ~terminated
        self._count_balls(state, hit_by, sound)
        # Of the balls in flight until here: a throw makes the flag a new ball's.
        arrived = counters["passed"].clone()

        due = (counters["step"] >= counters["next_throw_step"]) & ~terminated
        rows = (due & ~truncated).nonzero()[:, 0]
        if len(rows):
            self._throw(rows)
            state = self.physics.read()

        out = self._state_td(state)
        gravity_b = rotate_inverse(
            state.base_pose[:, 3:],
            state.base_pose.new_tensor([0, 0, -1.0]).expand(len(action), 3),
        )
        terms = reward_terms(
            self.config.reward,
            gravity_b=gravity_b,
            joint_deviation=state.joint_pos - self._default,
            power=result.power,
            base_lin_vel_w=state.base_lin_vel_w,
            displacement_w=out["displacement_w"],
            action_change=action - counters["previous_action"],
            terminated=terminated,
        )
        # What a failed simulation leaves behind earns and costs nothing.
        terms = torch.where(result.diverged[:, None], 0.0, terms)
        counters["previous_action"].copy_(action)
        out["previous_action"] = action.clone()
        out["reward_terms"] = terms
        out["reward"] = terms.sum(-1, keepdim=True)
        out["tactile"] = result.object_contact | result.floor_contact
        out["hit"], out["fallen"] = hit[:, None], fallen[:, None]
        out["diverged"] = result.diverged[:, None]
        out["self_contact"] = result.self_contact[:, None]
        out["power"] = result.power[:, None]
        out["torque_saturation"] = result.torque_saturation[:, None]
        out["object_hit"], out["object_arrived"] = hit_by, arrived
        out["terminated"], out["truncated"] = terminated[:, None], truncated[:, None]
        out["done"] = (terminated | truncated)[:, None]
        return out

    def _count_balls(self, state: PhysicsState, hit_by: Tensor, sound: Tensor) -> None:
        """Take landed balls out of play; count the balls that came and those avoided.

        A ball has arrived when it touches the robot or when it has passed: it lands,
        or flies away from the base and is farther than a metre.
        """
        counters = self._counters
        gap = state.object_pose[..., :2] - state.base_pose[:, None, :2]
        closing = state.object_lin_vel_w[..., :2] - state.base_lin_vel_w[:, None, :2]
        far = gap.square().sum(-1) > PASSED_DISTANCE**2
        landed = state.object_pose[..., 2] <= self.config.throws.radius
        leaving = ((gap * closing).sum(-1) > 0) & far
        fresh = counters["active"] & ~counters["passed"] & sound
        avoided = fresh & (landed | leaving) & ~hit_by
        arrived = avoided | (fresh & hit_by)
        first = counters["is_first"]
        for name, which in (("arrived", arrived), ("avoided", avoided)):
            counters[name][:, 0] += (which & first).sum(-1)
            counters[name][:, 1] += (which & ~first).sum(-1)
        counters["passed"] |= arrived
        if self.config.throws.on_ground == "inactive":
            counters["active"] &= ~landed

    def _state_td(self, state: PhysicsState) -> TensorDict:
        """The state part of an output; the tensors are nobody else's."""
        counters = self._counters
        return TensorDict(
            {
                "base_pose": state.base_pose,
                "base_lin_vel_w": state.base_lin_vel_w,
                "base_ang_vel_b": state.base_ang_vel_b,
                "joint_pos": state.joint_pos,
                "joint_vel": state.joint_vel,
                "object_pose": state.object_pose,
                "object_lin_vel_w": state.object_lin_vel_w,
                "object_active": counters["active"].clone(),
                # Every episode starts at the origin.
                "displacement_w": state.base_pose[:, :2].clone(),
                "previous_action": counters["previous_action"].clone(),
                "balls_arrived": counters["arrived"].clone(),
                "balls_avoided": counters["avoided"].clone(),
                "episode_step": counters["step"][:, None].clone(),
                "first_throw_step": counters["first_throw_step"][:, None].clone(),
            },
            batch_size=self.batch_size,
        )

    def simulation_state(self) -> dict[str, Tensor]:
        """Return everything needed to continue bit for bit, ``[B, ...]`` each."""
        counters = {key: value.clone() for key, value in self._counters.items()}
        return {"physics": self.physics.state(), **counters}

    def load_simulation_state(self, state: dict[str, Tensor]) -> None:
        """Continue from what `simulation_state` returned.

        Args:
            state: The state of *all* rows of the run; this environment takes its own.
        """
        mine = slice(int(self._rows[0]), int(self._rows[-1]) + 1)
        self.physics.load_state(state["physics"][mine])
        for key, value in self._counters.items():
            value.copy_(state[key][mine])
