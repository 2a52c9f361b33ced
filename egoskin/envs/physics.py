"""A batch of MuJoCo simulations of one robot and some objects, one row per agent.

The only file that touches live simulation arrays: everything that leaves it is a
float32 copy. A backend is this one class; another engine with the same methods can
stand beside it without a change to the environment.

Contract: contacts are those of every physics state of the last control step but its
final one (which is the next step's first), so that no state is skipped or seen twice.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Literal

import mujoco
import mujoco.batch
import numpy as np
import torch
from torch import Tensor

from egoskin.bounds import Interval, check_bounds
from egoskin.robots import RobotConfig
from egoskin.shapes import Sphere

# Contact bits of the model files: geoms listen to balls (1) and to the floor (2);
# every further bit is self-collision.
_BALL_BIT, _FLOOR_BIT = 1, 2
# Inactive objects wait here, far above everything [m].
_PARKING = np.array([0.0, 0.0, 1000.0])
# A faster robot than this has left physics behind: the row is reset and counted.
_MAX_SPEED = 200.0


@dataclass(frozen=True, kw_only=True)
class PhysicsConfig:
    """Actuation, rates and accuracy of the simulation."""

    gains: str = "rotor_inertia"
    """Named PD gain set of the robot ("real", "rotor_inertia")."""
    control_hz: Annotated[float, Interval(ge=1, le=1000)] = 60.0
    """Rate at which the policy acts [Hz]."""
    substeps: Annotated[int, Interval(ge=1, le=1000)] = 2
    """Physics steps in each control step."""
    self_collision: bool = True
    """Whether arms, torso and legs collide with each other."""
    solver_iterations: Annotated[int, Interval(ge=1, le=1000)] = 10
    """Most Newton iterations in each physics step."""
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
class PhysicsState:
    """Float32 copies of the state of some rows.

    ``J`` joints, ``O`` objects; quaternions are (w, x, y, z); suffix ``_w`` world,
    ``_b`` base frame.
    """

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

    object_contact: Tensor
    """Whether each link touched an object, ``[B, L]`` bool."""
    floor_contact: Tensor
    """Whether each link touched the floor, ``[B, L]`` bool."""
    object_hit: Tensor
    """Whether each object touched the robot, ``[B, O]`` bool."""
    self_contact: Tensor
    """Whether the robot touched itself, ``[B]`` bool."""
    power: Tensor
    """Mean over the substeps of sum |torque x joint velocity| [W], ``[B]``."""
    torque_saturation: Tensor
    """Mean over the substeps of the share of joints at their torque limit, ``[B]``."""
    diverged: Tensor
    """Whether the simulation failed and must be reset, ``[B]`` bool."""


def build_scene(
    robot: RobotConfig,
    objects: Sequence[Sphere],
    config: PhysicsConfig,
    *,
    weightless_objects: bool,
    objects_bounce: bool,
    object_mass: float,
) -> mujoco.MjModel:
    """Return the compiled model of a robot on a floor with objects to throw.

    Args:
        robot: Robot; its MJCF holds neither floor, actuators nor sensors.
        objects: Shapes, one body each.
        config: Rates, gains, accuracy.
        weightless_objects: Whether gravity spares the objects.
        objects_bounce: Whether objects collide with the floor and with each other.
        object_mass: Mass of each object [kg].

    Returns:
        The model. Position actuators carry the PD law
        torque = clip(kp (q* - q) - kd qdot, +-limit), evaluated in every substep.

    Raises:
        ValueError: If the robot's base does not float, a joint is no hinge, or MuJoCo
            cannot make the model.
    """
    robot.check_floating_base()
    spec = robot.spec()
    option = spec.option
    option.timestep = config.timestep
    option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    option.cone = mujoco.mjtCone.mjCONE_PYRAMIDAL
    # Dense: MuJoCo 4.0.0's Newton solver can be wrong with a sparse Jacobian.
    option.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
    option.iterations = config.solver_iterations
    if not config.self_collision:
        for geom in spec.geoms:
            geom.contype &= _BALL_BIT | _FLOOR_BIT
            geom.conaffinity &= _BALL_BIT | _FLOOR_BIT

    spec.worldbody.add_geom(
        name="floor",
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        size=[0, 0, 1],
        contype=_FLOOR_BIT,
        conaffinity=0,
    )
    # Slides instead of a free joint: a ball needs no rotation, three degrees of
    # freedom fewer; and one common parent lets a contact sensor name all objects.
    shelf = spec.worldbody.add_body(name="objects")
    axes = ([1, 0, 0], [0, 1, 0], [0, 0, 1])
    for i, shape in enumerate(objects):
        body = shelf.add_body(name=f"object_{i}", gravcomp=float(weightless_objects))
        for axis, letter in zip(axes, "xyz", strict=True):
            body.add_joint(
                name=f"object_{i}_{letter}",
                type=mujoco.mjtJoint.mjJNT_SLIDE,
                axis=axis,
            )
        shape.add_geom(
            body,
            name=f"object_{i}",
            mass=object_mass,
            contype=_BALL_BIT,
            conaffinity=(_BALL_BIT | _FLOOR_BIT) if objects_bounce else 0,
            rgba=[0.9, 0.35, 0.1, 1],
        )

    kp, kd = robot.joint_gains(config.gains)
    for name, p, d, limit in zip(robot.joints, kp, kd, robot.torque_limit, strict=True):
        actuator = spec.add_actuator(
            name=name,
            trntype=mujoco.mjtTrn.mjTRN_JOINT,
            target=name,
            gaintype=mujoco.mjtGain.mjGAIN_FIXED,
            biastype=mujoco.mjtBias.mjBIAS_AFFINE,
            forcelimited=True,
            forcerange=[-limit, limit],
        )
        actuator.gainprm[0] = p
        actuator.biasprm[1:3] = -p, -d
    _add_contact_sensors(spec, robot, len(objects))
    try:
        return spec.compile()
    except (ValueError, mujoco.FatalError) as error:
        text = " ".join(str(error).split())
        raise ValueError(f"MuJoCo cannot make the scene: {text}") from error


def _add_contact_sensors(
    spec: mujoco.MjSpec, robot: RobotConfig, num_objects: int
) -> None:
    """Add binary contact sensors in the order that `Physics.step` reads them."""
    body, subtree = mujoco.mjtObj.mjOBJ_BODY, mujoco.mjtObj.mjOBJ_XBODY
    geom = mujoco.mjtObj.mjOBJ_GEOM

    def add(obj: tuple, ref: tuple) -> None:
        sensor = spec.add_sensor(
            type=mujoco.mjtSensor.mjSENS_CONTACT,
            objtype=obj[0],
            objname=obj[1],
            reftype=ref[0],
            refname=ref[1],
        )
        # intprm: data fields (bit 0: found), reduction (0: none), slots.
        sensor.intprm[:3] = 1, 0, 1

    for link in robot.links:
        add((body, link), (subtree, "objects"))
    for link in robot.links:
        add((body, link), (geom, "floor"))
    for i in range(num_objects):
        add((subtree, robot.base), (body, f"object_{i}"))
    add((subtree, robot.base), (subtree, robot.base))


class Physics:
    """MuJoCo simulations of ``num_envs`` rows on a thread pool.

    Args:
        model: Scene from `build_scene`.
        robot: The robot in it.
        num_envs: Number of rows ``B``.
        config: The configuration the scene was built with.
        num_threads: Threads that step the rows; results do not depend on it.
        hold: Whether the robot is held rigid where it is put.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        robot: RobotConfig,
        num_envs: int,
        config: PhysicsConfig,
        *,
        num_threads: int = 1,
        hold: bool = False,
    ) -> None:
        self.model = model
        self.config = config
        self._hold = hold
        self._batch = mujoco.batch.Batch(model, num_envs, num_threads)
        bind = self._batch.bind
        self._qpos, self._qvel = bind("qpos"), bind("qvel")
        self._ctrl, self._sensordata = bind("ctrl"), bind("sensordata")
        self._torque = bind("actuator_force")
        self._torque_limit = model.actuator_forcerange[:, 1]
        self.num_envs = num_envs
        self._num_links = len(robot.links)
        self._num_joints = len(robot.joints)
        self.num_objects = (model.nq - 7 - self._num_joints) // 3
        kp, kd = robot.joint_gains(config.gains)
        self._kd_over_kp = torch.from_numpy(kd / kp).float()
        self._last_target = torch.zeros(num_envs, self._num_joints)
        joints = slice(7, 7 + self._num_joints)
        self._robot_q, self._object_q = slice(0, joints.stop), slice(joints.stop, None)
        self._robot_v = slice(0, joints.stop - 1)
        self._object_v = slice(joints.stop - 1, None)
        self._joint_v = slice(6, joints.stop - 1)
        self._failures = [
            int(mujoco.mjtWarning.mjWARN_BADQPOS),
            int(mujoco.mjtWarning.mjWARN_BADQVEL),
            int(mujoco.mjtWarning.mjWARN_BADQACC),
        ]

    def step(self, target: Tensor, active: Tensor) -> StepResult:
        """Advance every row by one control step.

        Args:
            target: Position targets [rad], ``[B, J]``.
            active: Objects in play, ``[B, O]`` bool; the others stay parked.

        Returns:
            Contacts, power, saturation and failures of the step.
        """
        self.park(~active)
        self.set_target(target)
        held = self._qpos[:, self._robot_q].copy() if self._hold else None
        warnings = self._failure_count()
        found = np.zeros(self._sensordata.shape, dtype=bool)
        power = np.zeros(len(self._qpos))
        saturation = np.zeros(len(self._qpos))
        errors = np.zeros(len(self._qpos), dtype=bool)
        for _ in range(self.config.substeps):
            try:
                self._batch.step()
            except mujoco.batch.SimulationError as error:
                errors[error.ids] = True
            found |= self._sensordata > 0
            power += np.abs(self._torque * self._qvel[:, self._joint_v]).sum(1)
            saturation += (np.abs(self._torque) >= self._torque_limit).mean(1)
            if held is not None:
                self._qpos[:, self._robot_q] = held
                self._qvel[:, self._robot_v] = 0.0
        speed = np.abs(self._qvel[:, self._robot_v]).max(1)
        # The comparison is also False for NaN.
        diverged = errors | (self._failure_count() > warnings) | ~(speed < _MAX_SPEED)
        links, objects = self._num_links, self.num_objects
        contact = torch.from_numpy(found)
        return StepResult(
            object_contact=contact[:, :links],
            floor_contact=contact[:, links : 2 * links],
            object_hit=contact[:, 2 * links : 2 * links + objects],
            self_contact=contact[:, -1],
            power=torch.from_numpy(power / self.config.substeps).float(),
            torque_saturation=torch.from_numpy(
                saturation / self.config.substeps
            ).float(),
            diverged=torch.from_numpy(diverged),
        )

    def set_target(self, target: Tensor) -> None:
        """Set the position targets of the PD law [rad], ``[B, J]``."""
        ctrl = target
        if self.config.target_velocity == "finite_difference":
            # kp (q* - q) + kd (qdot* - qdot) = kp ((q* + kd/kp qdot*) - q) - kd qdot
            velocity = (target - self._last_target) * self.config.control_hz
            ctrl = target + self._kd_over_kp * velocity
            self._last_target.copy_(target)
        self._ctrl[:] = ctrl.numpy()

    def park(self, objects: Tensor) -> None:
        """Take objects out of play, ``[B, O]`` bool: they wait at rest far above."""
        parked = objects.numpy()
        self._objects(self._object_q)[parked] = _PARKING
        self._objects(self._object_v)[parked] = 0.0

    def step_raw(self) -> None:
        """Advance one control step and look at nothing: what physics alone costs."""
        self._batch.step(nstep=self.config.substeps)

    def reset(self, rows: np.ndarray, base_pose: Tensor, joint_pos: Tensor) -> None:
        """Put the robots of some rows at rest into a pose and park their objects.

        Args:
            rows: Row indices, ``[n]``.
            base_pose: Base pose in the world, ``[n, 7]``.
            joint_pos: Joint positions [rad], ``[n, J]``.
        """
        self._batch.reset(rows, stage=mujoco.mjtStage.mjSTAGE_NONE)
        robot = torch.cat((base_pose, joint_pos), -1).double().numpy()
        self._qpos[rows, self._robot_q] = robot
        self._qpos[rows, self._object_q] = np.tile(_PARKING, self.num_objects)
        if self.config.target_velocity == "finite_difference":
            self._last_target[torch.from_numpy(rows)] = joint_pos

    def throw(
        self, rows: np.ndarray, objects: np.ndarray, position: Tensor, velocity: Tensor
    ) -> None:
        """Release one object in each of some rows.

        Args:
            rows: Row indices, ``[n]``.
            objects: Which object of each row, ``[n]``.
            position: Positions in the world [m], ``[n, 3]``.
            velocity: Velocities in the world [m/s], ``[n, 3]``.
        """
        self._objects(self._object_q)[rows, objects] = position.double().numpy()
        self._objects(self._object_v)[rows, objects] = velocity.double().numpy()

    def read(self, rows: np.ndarray | None = None) -> PhysicsState:
        """Return float32 copies of the state of some rows, or of all.

        Values that are not finite (diverged rows) are replaced by finite ones.
        """
        select = slice(None) if rows is None else rows
        qpos = torch.tensor(self._qpos[select], dtype=torch.float32)
        qvel = torch.tensor(self._qvel[select], dtype=torch.float32)
        qpos, qvel = qpos.nan_to_num_(0.0), qvel.nan_to_num_(0.0)
        object_pos = qpos[:, self._object_q].unflatten(-1, (-1, 3))
        upright = object_pos.new_tensor([1.0, 0.0, 0.0, 0.0])
        object_quat = upright.expand(*object_pos.shape[:-1], 4)
        return PhysicsState(
            base_pose=qpos[:, :7].contiguous(),
            base_lin_vel_w=qvel[:, :3].contiguous(),
            base_ang_vel_b=qvel[:, 3:6].contiguous(),
            joint_pos=qpos[:, 7 : self._robot_q.stop].contiguous(),
            joint_vel=qvel[:, self._joint_v].contiguous(),
            object_pose=torch.cat((object_pos, object_quat), -1),
            object_lin_vel_w=qvel[:, self._object_v].unflatten(-1, (-1, 3)).clone(),
        )

    def state(self) -> Tensor:
        """Return everything needed to continue bit for bit, ``[B, n]`` float64."""
        parts = [torch.tensor(self._batch.state)]
        if self.config.target_velocity == "finite_difference":
            parts.append(self._last_target.double())
        return torch.cat(parts, -1)

    def load_state(self, state: Tensor) -> None:
        """Continue from a state that `state` returned."""
        size = self._batch.nstate
        self._batch.state[:] = state[:, :size].numpy()
        if self.config.target_velocity == "finite_difference":
            self._last_target.copy_(state[:, size:])

    def _objects(self, part: slice) -> np.ndarray:
        """Live view of object positions or velocities, ``[B, O, 3]``."""
        array = self._qpos if part == self._object_q else self._qvel
        view = array[:, part].reshape(len(array), self.num_objects, 3)
        assert np.shares_memory(view, array)
        return view

    def _failure_count(self) -> np.ndarray:
        # [..., 0] is the last argument, [..., 1] the number of warnings.
        return self._batch.warning[:, self._failures, 1].sum(1)
