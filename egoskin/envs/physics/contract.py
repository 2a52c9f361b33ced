"""What a physics engine must do: a batch of simulations of one robot and some objects.

An engine is one class, `Physics`, in a file of its own. The environment knows this file
alone. Every tensor is on the engine's device; all that an engine returns are copies,
float32 unless said otherwise, and rows are named by int64 indices. ``B`` rows, ``J``
joints, ``L`` links, ``O`` objects; quaternions are (w, x, y, z), unit; suffix ``_w``
world, ``_b`` base frame.

The world is a floor at height 0, the robot, and objects that touch the robot alone (not
the floor, nor each other) and never turn: their quaternion stays (1, 0, 0, 0).

- **Rows are independent.** What happens in a row depends on what was asked of that row
  alone: not on the number of rows, nor of threads, nor on a row that diverged.
- **A control step** is ``substeps`` physics steps of ``timestep`` each. In every one of
  them each joint gets the torque clip(kp (q* - q) + kd (qdot* - qdot), +-limit); a
  `Variation` scales kp, kd and the limit, masses and friction, row by row.
- **Contacts** are those of every physics state of a control step but its final one,
  which is the next step's first: no state is skipped or seen twice.
- **Divergence** (a failed solver, numbers that are not finite, speeds that physics did
  not mean) is told, row by row, and never raised; what is read stays finite.
- **State**: from what `Physics.state` returns, everything continues as it would have.
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

OBJECT_MASS = 0.4
"""Mass of each object [kg]; a touch ends the episode, so it hardly matters."""


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
        """Raise ValueError for numbers out of bounds."""
        check_bounds(self)

    @property
    def timestep(self) -> float:
        """Physics time step [s]."""
        return 1.0 / (self.control_hz * self.substeps)


@dataclass(frozen=True, kw_only=True)
class Scene:
    """What is simulated in every row."""

    robot: RobotConfig
    """The robot; its base floats and all its joints are hinges."""
    objects: tuple[Shape, ...]
    """Shape of each object."""
    config: PhysicsConfig
    """Actuation and rates."""
    weightless_objects: bool = False
    """Whether gravity spares the objects."""
    link_contacts: bool = False
    """Whether `StepResult.link_contact` is asked for, which costs a few per cent."""
    hold: bool = False
    """Whether the robot is held rigid where it is put."""


@dataclass(frozen=True, kw_only=True)
class Variation:
    """How the robots of some rows differ from their model: factors."""

    link_mass: Tensor
    """Of mass and inertia of each link, ``[n, L]``."""
    friction: Tensor
    """Of all friction, ``[n]``."""
    gains: Tensor
    """Of kp and kd of each joint, ``[n, J]``."""
    torque_limit: Tensor
    """Of the torque limit of each joint, ``[n, J]``."""


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
    """What happened during one control step, apart from the state reached."""

    object_hit: Tensor
    """Whether each object touched the robot, ``[B, O]`` bool."""
    fallen: Tensor
    """Whether a link other than a foot touched the floor, ``[B]`` bool."""
    self_contact: Tensor
    """Whether the robot touched itself, ``[B]`` bool."""
    link_contact: Tensor | None
    """Whether each link touched an object or the floor, ``[B, L]`` bool; None unless
    the scene asks for it."""
    power: Tensor
    """Mean over the substeps of the sum of ``|torque x velocity|`` [W], ``[B]``."""
    torque_saturation: Tensor
    """Mean over the substeps of the share of joints at their torque limit, ``[B]``."""
    diverged: Tensor
    """Whether the simulation failed and must be reset, ``[B]`` bool."""


class Physics(ABC):
    """Simulations of a scene; see the module for what all engines keep to.

    Args:
        scene: What is simulated.
        num_envs: Number of rows ``B``.
        num_threads: Threads that step the rows; results do not depend on it.
        device: Where they are simulated, and all tensors are.

    Raises:
        ValueError: If the scene holds what the engine cannot simulate, or it cannot on
            this device.
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
        """Put the robots of some rows at rest into a pose; no object is in play.

        Nothing is remembered of what the rows did before.

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
            objects: Which object of each row, ``[n]`` int64.
            position: Positions in the world [m], ``[n, 3]``.
            velocity: Velocities in the world [m/s], ``[n, 3]``.
        """

    @abstractmethod
    def vary(self, rows: Tensor, variation: Variation) -> None:
        """Make the robots of some rows ``[n]`` differ from their model from now on.

        It is no part of `state`, and a reset leaves it as it is.
        """

    @abstractmethod
    def push(self, rows: Tensor, velocity: Tensor) -> None:
        """Change the velocity of the base of some rows ``[n]``, at once.

        Args:
            rows: Row indices, ``[n]``.
            velocity: What is added, in the world [m/s], ``[n, 3]``.
        """

    @abstractmethod
    def step(self, target: Tensor, active: Tensor) -> StepResult:
        """Advance every row by one control step.

        Args:
            target: Position targets q* [rad], ``[B, J]``.
            active: Objects in play, ``[B, O]`` bool; the others wait at rest far above.
        """

    @abstractmethod
    def read(self, rows: Tensor | None = None) -> PhysicsState:
        """Return the state of some rows ``[n]``, which may repeat, or of all."""

    def note(self) -> str | None:
        """Say what limited the simulations since this was asked last, and the cure.

        Asked once in a rollout. None if nothing did.
        """
        return None

    @abstractmethod
    def state(self) -> Tensor:
        """Return everything needed to continue, ``[B, n]`` float64."""

    @abstractmethod
    def load_state(self, state: Tensor) -> None:
        """Continue from a state that `state` returned, of as many rows."""
