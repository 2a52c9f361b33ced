"""Interface of a physics engine: batched simulations of one robot and some objects.

An engine is a subclass of `Physics` in its own file. The environment depends only on
this file. Every tensor is on the engine's device. Returned tensors are copies, float32
unless stated otherwise; rows are selected by int64 indices. ``B`` rows, ``J`` joints,
``L`` links, ``O`` objects; quaternions are (w, x, y, z), unit; suffix ``_w`` world,
``_b`` base frame.

The world is a floor at height 0, the robot, and objects, under `GRAVITY`. Objects
collide only with the robot (not with the floor or each other) and never rotate: their
quaternion stays (1, 0, 0, 0).

- **Rows are independent.** The results of a row depend only on the calls for that row:
  not on the number of rows or threads, nor on a row that diverged.
- **A control step** is ``substeps`` physics steps of ``timestep`` each. In each physics
  step, every joint gets the torque clip(kp (q* - q) + kd (qdot* - qdot), +-limit); a
  `Variation` scales kp, kd and the limit, masses and friction, per row.
- **Contacts** are those of every physics state of a control step except the final one,
  which is the first of the next step: no state is skipped or counted twice.
- **Divergence** (solver failure, non-finite numbers, implausible speeds) is reported
  per row and never raised; the values returned stay finite.
- **State**: a simulation restored from `Physics.state` continues as the original would.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Annotated, Literal

import torch
from torch import Tensor

from egoskin.bounds import Interval, check_bounds
from egoskin.robots.config import RobotConfig
from egoskin.shapes import Shape

GRAVITY = 9.81
"""Downward acceleration [m/s^2]."""
OBJECT_MASS = 0.4
"""Mass of each object [kg]; contact ends the episode, so it hardly matters."""


@dataclass(frozen=True, kw_only=True)
class PhysicsConfig:
    """Actuation and rates of the simulation."""

    gains: str | None = None
    """Named PD gain set of the robot (h1_2: "rotor_inertia", "real"); None: its
    first."""
    control_hz: Annotated[float, Interval(ge=1, le=1e5)] = 60.0
    """Rate at which the policy acts [Hz]."""
    substeps: Annotated[int, Interval(ge=1, le=1000)] = 2
    """Physics steps in each control step."""
    target_velocity: Literal["zero", "finite_difference"] = "zero"
    """Velocity target of the PD law: 0, or the change of the position target."""

    def __post_init__(self) -> None:
        """Raise ValueError for values out of bounds."""
        check_bounds(self)

    @property
    def timestep(self) -> float:
        """Physics time step [s]."""
        return 1.0 / (self.control_hz * self.substeps)


@dataclass(frozen=True, kw_only=True)
class Scene:
    """The scene simulated in every row."""

    robot: RobotConfig
    """The robot; its base floats and all its joints are hinges."""
    objects: tuple[Shape, ...]
    """Shape of each object."""
    config: PhysicsConfig
    """Actuation and rates."""
    weightless_objects: bool = False
    """Whether the objects are exempt from gravity."""
    link_contacts: bool = False
    """Whether to compute `StepResult.link_contact`, which costs a few per cent."""
    hold: bool = False
    """Whether the robot is held rigid in the pose of its reset."""


@dataclass(frozen=True, kw_only=True)
class Variation:
    """Scale factors on the model parameters of the robots of some rows."""

    link_mass: Tensor
    """For mass and inertia of each link, ``[n, L]``."""
    friction: Tensor
    """For all friction, ``[n]``."""
    gains: Tensor
    """For kp and kd of each joint, ``[n, J]``."""
    torque_limit: Tensor
    """For the torque limit of each joint, ``[n, J]``."""
    varies_mass: bool = True
    """Whether ``link_mass`` can be other than 1, at any time: what MuJoCo derives from
    masses must then be computed again."""


@dataclass(frozen=True, kw_only=True)
class PhysicsState:
    """The state of some rows."""

    base_pose: Tensor
    """Base position [m] and orientation in the world, ``[B, 7]``."""
    base_lin_vel_w: Tensor
    """Velocity of the base's origin [m/s], ``[B, 3]``."""
    base_ang_vel_b: Tensor
    """Angular velocity of the base [rad/s], ``[B, 3]``."""
    joint_pos: Tensor
    """Joint positions [rad], ``[B, J]``."""
    joint_vel: Tensor
    """Joint velocities [rad/s], ``[B, J]``."""
    object_pose: Tensor
    """Object position [m] and orientation in the world, ``[B, O, 7]``."""
    object_lin_vel_w: Tensor
    """Velocity of the objects [m/s], ``[B, O, 3]``."""


@dataclass(frozen=True, kw_only=True)
class StepResult:
    """Contacts, power, saturation and divergence of one control step."""

    object_hit: Tensor
    """Whether each object touched the robot, ``[B, O]`` bool."""
    fallen: Tensor
    """Whether a link other than a foot touched the floor, ``[B]`` bool."""
    self_contact: Tensor
    """Whether the robot touched itself, ``[B]`` bool."""
    link_contact: Tensor | None
    """Whether each link touched an object or the floor, ``[B, L]`` bool; None unless
    `Scene.link_contacts`."""
    power: Tensor
    """Mean over the substeps of the sum of ``|torque x velocity|`` [W], ``[B]``."""
    torque_saturation: Tensor
    """Mean over the substeps of the share of joints at their torque limit, ``[B]``."""
    diverged: Tensor
    """Whether the simulation failed and must be reset, ``[B]`` bool."""


class Physics(ABC):
    """Simulations of a scene; the module describes what every engine guarantees.

    Args:
        scene: The scene.
        num_envs: Number of rows ``B``.
        num_threads: Threads that step the rows; results do not depend on it.
        device: Device of the simulations and of all tensors.

    Raises:
        ValueError: If the engine cannot simulate the scene, or not on this device.
    """

    @abstractmethod
    def __init__(
        self,
        scene: Scene,
        num_envs: int,
        *,
        num_threads: int = 1,
        device: torch.device | str = "cpu",
    ) -> None:
        """Build the simulations; no row is defined until it is reset."""

    @abstractmethod
    def reset(self, rows: Tensor, base_pose: Tensor, joint_pos: Tensor) -> None:
        """Put the robots of some rows at rest in a pose, with no object in play.

        The result does not depend on what the rows did before.

        Args:
            rows: Row indices, ``[n]``.
            base_pose: Base pose in the world, ``[n, 7]``.
            joint_pos: Joint positions [rad], ``[n, J]``.
        """

    @abstractmethod
    def throw(
        self, rows: Tensor, objects: Tensor, position: Tensor, velocity: Tensor
    ) -> None:
        """Release one object in each of some rows.

        Args:
            rows: Row indices, ``[n]``.
            objects: Index of the object in each row, ``[n]`` int64.
            position: Positions in the world [m], ``[n, 3]``.
            velocity: Velocities in the world [m/s], ``[n, 3]``.
        """

    @abstractmethod
    def vary(self, rows: Tensor, variation: Variation) -> None:
        """Scale model parameters of the robots of some rows ``[n]`` from now on.

        The variation is not part of `state` and persists through a reset.
        """

    @abstractmethod
    def push(self, rows: Tensor, velocity: Tensor) -> None:
        """Change the base velocity of some rows instantaneously.

        Args:
            rows: Row indices, ``[n]``.
            velocity: Velocity added, in the world [m/s], ``[n, 3]``.
        """

    @abstractmethod
    def step(self, target: Tensor, active: Tensor) -> StepResult:
        """Advance every row by one control step.

        Args:
            target: Position targets q* [rad], ``[B, J]``.
            active: Objects in play, ``[B, O]`` bool; others are parked far above.
        """

    @abstractmethod
    def read(self, rows: Tensor | None = None) -> PhysicsState:
        """Return the state of some rows ``[n]``, which may repeat, or of all rows."""

    def note(self) -> str | None:
        """Return what limited the simulations since the last call, and the remedy.

        Called once per rollout. None if nothing did.
        """
        return None

    @abstractmethod
    def state(self) -> Tensor:
        """Return everything needed to continue, ``[B, n]`` float64."""

    @abstractmethod
    def load_state(self, state: Tensor) -> None:
        """Restore a state that `state` returned for the same number of rows."""
