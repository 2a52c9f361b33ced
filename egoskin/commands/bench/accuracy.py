"""Differences of the default physics rate to a finer one: standing, forces, impacts."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any

import mujoco
import numpy as np
import torch

from egoskin.bounds import COUNT, Interval, check_bounds
from egoskin.commands.bench.report import Row, show
from egoskin.envs.physics import OBJECT_MASS, PhysicsConfig, Scene
from egoskin.envs.physics.model import build_scene
from egoskin.envs.throws import Release, ThrowConfig, Thrower
from egoskin.make import EnvConfig
from egoskin.robots.config import RobotConfig

# Duration of standing that is compared [s]; with zero action the robot falls later.
_STAND = 0.5
# Time after which an impact is over and its effect on the robot is visible [s].
_AFTER = 0.1
_LONGEST_FLIGHT = 2.0


@dataclass(frozen=True, kw_only=True)
class AccuracyBench:
    """Differences between the default physics rate and a finer one."""

    finer: Annotated[int, Interval(ge=2)] = 4
    """Factor by which the steps of the finer rate are smaller."""
    throws: Annotated[int, COUNT] = 200
    """Balls thrown at the robot, one for each impact."""
    seed: int = 0
    """Seed of the throws."""
    physics: PhysicsConfig = field(default_factory=PhysicsConfig)
    """The physics to check."""
    json: Path | None = None
    """File to write the rows to."""

    def __post_init__(self) -> None:
        """Raise ValueError for invalid values."""
        check_bounds(self)


@dataclass(frozen=True, kw_only=True, eq=False)
class _Stand:
    """Result of standing for half a second in the default pose."""

    qpos: np.ndarray
    """Final positions of base and joints, ``[7 + J]``."""
    force: float
    """Mean vertical force of the floor on the robot [N]."""


@dataclass(frozen=True, kw_only=True, eq=False)
class _Impact:
    """One throw at the robot in its default pose; NaN if the ball never touches it."""

    time: float
    """First contact [s]."""
    link: int
    """Body hit first, -1 without contact."""
    impulse: float
    """Change of the ball's momentum from contact until `_AFTER` later [N s]."""
    base: np.ndarray
    """Change of the base's velocity in the same time [m/s], ``[3]``."""


class _Simulation:
    """One robot and one ball, stepped at one rate."""

    def __init__(self, robot: RobotConfig, config: PhysicsConfig) -> None:
        self._robot, throws = robot, ThrowConfig(num_balls=1)
        self._gravity = throws.gravity
        scene = Scene(
            robot=robot,
            objects=throws.balls,
            config=config,
            weightless_objects=not self._gravity,
        )
        self.model = build_scene(scene)
        self.data = mujoco.MjData(self.model)
        self._ball = self.model.body("object_0").id
        self._weight = np.zeros(6)

    def start(self) -> None:
        """Put the robot into its default pose and the ball far away."""
        mujoco.mj_resetData(self.model, self.data)
        joints = self._robot.default_joint_pos
        self.data.qpos[:7] = 0, 0, self._robot.default_base_height, 1, 0, 0, 0
        self.data.qpos[7:-3], self.data.qpos[-3:] = joints, (0, 0, 1000)
        self.data.ctrl[:] = joints

    def stand(self) -> _Stand:
        """Hold the default pose."""
        self.start()
        forces = []
        while self.data.time < _STAND - 1e-9:
            mujoco.mj_step(self.model, self.data)
            forces.append(self._floor_force())
        return _Stand(qpos=self.data.qpos[:-3].copy(), force=float(np.mean(forces)))

    def _floor_force(self) -> float:
        total = 0.0
        for i in range(self.data.ncon):
            contact = self.data.contact[i]
            if self.model.geom("floor").id in contact.geom:
                mujoco.mj_contactForce(self.model, self.data, i, self._weight)
                # The floor's normal is vertical.
                total += self._weight[0]
        return total

    def impact(self, position: np.ndarray, velocity: np.ndarray) -> _Impact:
        """Throw a ball."""
        self.start()
        self.data.qpos[-3:], self.data.qvel[-3:] = position, velocity
        met, link = np.inf, -1
        momentum, speed = np.zeros(3), np.zeros(3)
        while self.data.time < min(met + _AFTER, _LONGEST_FLIGHT) - 1e-9:
            if link < 0:
                momentum = OBJECT_MASS * self.data.qvel[-3:].copy()
                speed = self.data.qvel[:3].copy()
            now = self.data.time
            mujoco.mj_step(self.model, self.data)
            # Contacts are those of the positions before the step.
            touched = self._touched()
            if link < 0 and touched is not None:
                met, link = now, touched
        if link < 0:
            nothing = np.full(3, np.nan)
            return _Impact(time=np.nan, link=-1, impulse=np.nan, base=nothing)
        change = OBJECT_MASS * self.data.qvel[-3:] - momentum
        # Remove the effect of gravity since the contact.
        change[2] += OBJECT_MASS * self._gravity * _AFTER
        return _Impact(
            time=met,
            link=link,
            impulse=float(np.linalg.norm(change)),
            base=self.data.qvel[:3] - speed,
        )

    def _touched(self) -> int | None:
        for i in range(self.data.ncon):
            bodies = self.model.geom_bodyid[self.data.contact[i].geom]
            if self._ball in bodies:
                return int(bodies.sum() - self._ball)
        return None


def _throws(config: AccuracyBench, robot: RobotConfig) -> Release:
    """Return standard throws at the robot in its default pose."""
    thrower = Thrower(ThrowConfig(), robot, config.physics.timestep)
    rows = torch.arange(config.throws)
    draw = thrower.draw(config.seed, rows, rows * 0, rows * 0)
    return thrower.release_at_standing_robot(draw)


def accuracy_rows(config: AccuracyBench) -> list[Row]:
    """Return the differences; the ratio is to the value at the finer rate.

    That of the impact time is to a control step.
    """
    robot, physics = EnvConfig().robot_config, config.physics
    finer = replace(physics, substeps=physics.substeps * config.finer)
    coarse, fine = _Simulation(robot, physics), _Simulation(robot, finer)
    one, other = coarse.stand(), fine.stand()
    gap = np.abs(one.qpos - other.qpos)
    moved = np.abs(other.qpos[7:] - robot.default_joint_pos)
    release, pairs = _throws(config, robot), []
    for i in range(config.throws):
        show(f"throw {i + 1}/{config.throws}")
        ball = release.position[i].numpy(), release.velocity[i].numpy()
        pairs.append((coarse.impact(*ball), fine.impact(*ball)))
    show("")
    same = np.array([a.link == b.link for a, b in pairs])
    both = [(a, b) for a, b in pairs if a.link >= 0 and b.link >= 0]
    late = np.array([abs(a.time - b.time) for a, b in both])
    wrong = np.array([abs(a.impulse - b.impulse) for a, b in both])
    impulse = np.array([b.impulse for _, b in both])
    kick = np.array([np.linalg.norm(a.base - b.base) for a, b in both])
    kicked = np.array([np.linalg.norm(b.base) for _, b in both])

    def row(name: str, value: Any, unit: str, of: Any) -> Row:
        return Row(name=name, value=float(value), unit=unit, ratio=float(value / of))

    height, period = other.qpos[2], 1e3 / physics.control_hz
    return [
        row("stand_base_position", 1e3 * gap[:3].max(), "mm", 1e3 * height),
        row("stand_joints", gap[7:].max(), "rad, the largest", moved.max()),
        row("stand_floor_force", abs(one.force - other.force), "N", other.force),
        row("impact_same_link", same.mean(), "share of the throws", 1.0),
        row("impact_time", 1e3 * np.median(late), "ms, median", period),
        row("impact_impulse", np.median(wrong), "N s, median", np.median(impulse)),
        row("impact_base_velocity", np.median(kick), "m/s, median", np.median(kicked)),
    ]
