"""CPU engine on MuJoCo's batch: bit-identical results for any number of threads.

Contract: that of `egoskin.envs.physics.contract`. Only this file accesses the live
arrays of the simulations.
"""

from __future__ import annotations

import mujoco
import mujoco.batch
import numpy as np
import torch
from torch import Tensor

from egoskin.envs.physics.contract import (
    Physics,
    PhysicsState,
    Scene,
    StepResult,
    Variation,
)
from egoskin.envs.physics.model import MAX_SPEED, PARKING, build_scene
from egoskin.robots.model import body_id


class MujocoPhysics(Physics):
    """MuJoCo simulations of a scene on a thread pool; see `Physics`.

    Args:
        scene: The scene.
        num_envs: Number of rows ``B``.
        num_threads: Threads that step the rows; results do not depend on it.
        device: The CPU.
        model: The compiled scene, by default that of `build_scene`.
    """

    def __init__(
        self,
        scene: Scene,
        num_envs: int,
        *,
        num_threads: int = 1,
        device: torch.device | str = "cpu",
        model: mujoco.MjModel | None = None,
    ) -> None:
        if torch.device(device).type != "cpu":
            raise ValueError(f"engine mujoco simulates on the CPU, not on {device}")
        robot, config = scene.robot, scene.config
        self.model = build_scene(scene) if model is None else model
        self.scene, self.config = scene, config
        self._batch = mujoco.batch.Batch(self.model, num_envs, num_threads)
        bind = self._batch.bind
        self._qpos, self._qvel = bind("qpos"), bind("qvel")
        self._ctrl, self._sensordata = bind("ctrl"), bind("sensordata")
        self._torque = bind("actuator_force")
        self._torque_limit = self.model.actuator_forcerange[:, 1]
        self.num_envs, self.num_objects = num_envs, len(scene.objects)
        num_joints = len(robot.joints)
        kp, kd = robot.joint_gains(config.gains)
        self._kd_over_kp = torch.from_numpy(kd / kp).float()
        self._last_target = torch.zeros(num_envs, num_joints, dtype=torch.float32)
        joints = slice(7, 7 + num_joints)
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
        """Advance every row by one control step; see `Physics.step`."""
        self.park(~active)
        self.set_target(target)
        held = self._qpos[:, self._robot_q].copy() if self.scene.hold else None
        warnings = self._failure_count()
        found = np.zeros(self._sensordata.shape, dtype=bool)
        fallen = np.zeros(self.num_envs, dtype=bool)
        power = np.zeros(self.num_envs)
        saturation = np.zeros(self.num_envs)
        errors = np.zeros(self.num_envs, dtype=bool)
        floor = self.num_objects + 1
        links = floor + 1 + len(self.scene.robot.feet)
        for _ in range(self.config.substeps):
            try:
                self._batch.step()
            except mujoco.batch.SimulationError as error:
                errors[error.ids] = True
            counts = self._sensordata
            found |= counts > 0
            # Fallen: the floor has more contacts with the robot than with its feet.
            fallen |= counts[:, floor] > counts[:, floor + 1 : links].sum(1)
            power += np.abs(self._torque * self._qvel[:, self._joint_v]).sum(1)
            saturation += (np.abs(self._torque) >= self._torque_limit).mean(1)
            if held is not None:
                self._qpos[:, self._robot_q] = held
                self._qvel[:, self._robot_v] = 0.0
        speed = np.abs(self._qvel[:, self._robot_v]).max(1)
        # The comparison is also False for NaN.
        diverged = errors | (self._failure_count() > warnings) | ~(speed < MAX_SPEED)
        contact = torch.from_numpy(found)
        by_link = None
        if self.scene.link_contacts:
            by_link = contact[:, links:].unflatten(-1, (-1, 2)).any(-1)
        power, saturation = (
            torch.from_numpy(total / self.config.substeps).float()
            for total in (power, saturation)
        )
        return StepResult(
            object_hit=contact[:, : self.num_objects],
            fallen=torch.from_numpy(fallen),
            self_contact=contact[:, self.num_objects],
            link_contact=by_link,
            power=power,
            torque_saturation=saturation,
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

    def vary(self, rows: Tensor, variation: Variation) -> None:
        """Scale model fields per row; see `Physics.vary`."""
        model, which, expand = self.model, rows.numpy(), self._batch.expand
        links = np.array([body_id(model, link) for link in self.scene.robot.links])
        joints = model.actuator_trnid[:, 0]
        at_links, at_joints = np.ix_(which, links), np.ix_(which, joints)
        mass, gains, limit = (
            factor.double().numpy()
            for factor in (variation.link_mass, variation.gains, variation.torque_limit)
        )
        friction = variation.friction.double().numpy()[:, None, None]
        expand("body_mass")[at_links] = mass * model.body_mass[links]
        expand("body_inertia")[at_links] = mass[..., None] * model.body_inertia[links]
        expand("geom_friction")[which] = friction * model.geom_friction
        expand("actuator_gainprm")[which] = gains[..., None] * model.actuator_gainprm
        expand("actuator_biasprm")[which] = gains[..., None] * model.actuator_biasprm
        ranges = expand("actuator_forcerange")
        ranges[which] = limit[..., None] * model.actuator_forcerange
        self._torque_limit = ranges[..., 1]
        # The joints clip the actuator torque again.
        clip = limit[..., None] * model.jnt_actfrcrange[joints]
        expand("jnt_actfrcrange")[at_joints] = clip
        self._batch.set_const(which)

    def push(self, rows: Tensor, velocity: Tensor) -> None:
        """Change the velocity of the base of some rows; see `Physics.push`."""
        self._qvel[rows.numpy(), :3] += velocity.double().numpy()

    def park(self, objects: Tensor) -> None:
        """Park objects out of play, ``[B, O]`` bool, at rest far above the scene."""
        parked = objects.numpy()
        self._objects(self._object_q)[parked] = PARKING
        self._objects(self._object_v)[parked] = 0.0

    def step_raw(self) -> None:
        """Advance one control step without reading results, to time physics alone."""
        self._batch.step(nstep=self.config.substeps)

    def reset(self, rows: Tensor, base_pose: Tensor, joint_pos: Tensor) -> None:
        """Put the robots of some rows at rest in a pose; see `Physics.reset`."""
        which = rows.numpy()
        self._batch.reset(which, stage=mujoco.mjtStage.mjSTAGE_NONE)
        robot = torch.cat((base_pose, joint_pos), -1).double().numpy()
        self._qpos[which, self._robot_q] = robot
        self._qpos[which, self._object_q] = np.tile(PARKING, self.num_objects)
        if self.config.target_velocity == "finite_difference":
            self._last_target[rows] = joint_pos

    def throw(
        self, rows: Tensor, objects: Tensor, position: Tensor, velocity: Tensor
    ) -> None:
        """Release one object in each of some rows; see `Physics.throw`."""
        where = rows.numpy(), objects.numpy()
        self._objects(self._object_q)[where] = position.double().numpy()
        self._objects(self._object_v)[where] = velocity.double().numpy()

    def read(self, rows: Tensor | None = None) -> PhysicsState:
        """Return the state of some rows, or of all; see `Physics.read`."""
        select = slice(None) if rows is None else rows.numpy()
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
        state = torch.tensor(self._batch.state)
        if self.config.target_velocity == "finite_difference":
            state = torch.cat((state, self._last_target.double()), -1)
        return state

    def load_state(self, state: Tensor) -> None:
        """Restore a state that `state` returned."""
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
