"""A simple reference implementation of the physics contract: a loop over `MjData`."""

from __future__ import annotations

import copy

import mujoco
import numpy as np
import torch
from torch import Tensor

from egoskin.envs.physics import (
    Physics,
    PhysicsState,
    Scene,
    StepResult,
    Variation,
)
from egoskin.envs.physics.model import build_scene

FAR = 1000.0
WHOLE = mujoco.mjtState.mjSTATE_INTEGRATION


class SimplePhysics(Physics):
    """One `MjData` per row, stepped in turn and inspected contact by contact."""

    def __init__(
        self,
        scene: Scene,
        num_envs: int,
        *,
        num_threads: int = 1,
        device: torch.device | str = "cpu",
    ) -> None:
        self.scene, robot = scene, scene.robot
        self.model = model = build_scene(scene)
        self.models = [copy.copy(model) for _ in range(num_envs)]
        self.rows = [mujoco.MjData(model) for _ in range(num_envs)]
        # Targets of the step before, for a velocity target by finite differences.
        self.last = torch.zeros(num_envs, len(robot.joints))
        self.stop = 7 + len(robot.joints)
        self.body_of = [model.body(body).name for body in model.geom_bodyid]

    def reset(self, rows: Tensor, base_pose: Tensor, joint_pos: Tensor) -> None:
        for row, pose, joints in zip(rows.tolist(), base_pose, joint_pos, strict=True):
            data = self.rows[row]
            mujoco.mj_resetData(self.models[row], data)
            data.qpos[: self.stop] = torch.cat((pose, joints))
            data.qpos[self.stop :] = [0, 0, FAR] * len(self.scene.objects)
            self.last[row] = joints

    def throw(
        self, rows: Tensor, objects: Tensor, position: Tensor, velocity: Tensor
    ) -> None:
        for i, row in enumerate(rows.tolist()):
            first = self.stop + 3 * int(objects[i])
            self.rows[row].qpos[first : first + 3] = position[i]
            self.rows[row].qvel[first - 1 : first + 2] = velocity[i]

    def vary(self, rows: Tensor, variation: Variation) -> None:
        robot = self.scene.robot
        for i, row in enumerate(rows.tolist()):
            self.models[row] = model = copy.copy(self.model)
            for name, factor in zip(robot.links, variation.link_mass[i], strict=True):
                model.body(name).mass *= float(factor)
                model.body(name).inertia *= float(factor)
            model.geom_friction *= float(variation.friction[i])
            factors = zip(variation.gains[i], variation.torque_limit[i], strict=True)
            for name, (gain, limit) in zip(robot.joints, factors, strict=True):
                model.actuator(name).gainprm[0] *= float(gain)
                model.actuator(name).biasprm[1:3] *= float(gain)
                model.actuator(name).forcerange *= float(limit)
                model.jnt_actfrcrange[model.joint(name).id] *= float(limit)
            mujoco.mj_setConst(model, mujoco.MjData(model))

    def push(self, rows: Tensor, velocity: Tensor) -> None:
        for row, change in zip(rows.tolist(), velocity, strict=True):
            self.rows[row].qvel[:3] += change.double().numpy()

    def step(self, target: Tensor, active: Tensor) -> StepResult:
        given = zip(range(len(self.rows)), target, active, strict=True)
        columns = zip(*(self.step_row(*row) for row in given), strict=True)
        hit, fallen, own, links, power, limited, diverged = map(np.array, columns)
        return StepResult(
            object_hit=torch.from_numpy(hit),
            fallen=torch.from_numpy(fallen),
            self_contact=torch.from_numpy(own),
            link_contact=torch.from_numpy(links) if self.scene.link_contacts else None,
            power=torch.from_numpy(power).float(),
            torque_saturation=torch.from_numpy(limited).float(),
            diverged=torch.from_numpy(diverged),
        )

    def step_row(self, row: int, target: Tensor, active: Tensor) -> tuple:
        config, robot, data = self.scene.config, self.scene.robot, self.rows[row]
        for ball in (~active).nonzero()[:, 0].tolist():
            first = self.stop + 3 * ball
            data.qpos[first : first + 3] = 0, 0, FAR
            data.qvel[first - 1 : first + 2] = 0
        data.ctrl[:] = target
        if config.target_velocity == "finite_difference":
            # kp (q* - q) + kd (v* - v) = kp ((q* + kd / kp v*) - q) - kd v
            kp, kd = robot.joint_gains(config.gains)
            velocity = (target - self.last[row]) * config.control_hz
            data.ctrl[:] = target + torch.from_numpy(kd / kp).float() * velocity
            self.last[row] = target
        start = data.qpos[: self.stop].copy()
        low, high = self.models[row].actuator_forcerange.T
        hit, links = np.zeros(len(active), bool), np.zeros(len(robot.links), bool)
        fallen, own, power, limited = False, False, 0.0, 0.0
        before = sum(warning.number for warning in data.warning)
        for _ in range(config.substeps):
            mujoco.mj_step(self.models[row], data)
            for pair in data.contact.geom:
                touching = [self.body_of[g] for g in pair]
                mine = [name for name in touching if name in robot.links]
                other = [name for name in touching if name not in robot.links]
                own |= len(mine) == 2
                links[[robot.links.index(name) for name in mine if other]] = True
                if other == ["world"]:
                    fallen |= mine[0] not in robot.feet
                elif other:
                    hit[int(other[0].removeprefix("object_"))] = True
            force = data.actuator_force
            power += np.abs(force * data.qvel[6 : self.stop - 1]).sum()
            limited += ((force == low) | (force == high)).mean()
            if self.scene.hold:
                data.qpos[: self.stop], data.qvel[: self.stop - 1] = start, 0
        bad = sum(warning.number for warning in data.warning) > before
        bad |= not np.abs(data.qvel[: self.stop - 1]).max() < 200
        n = config.substeps
        return hit, fallen, own, links, power / n, limited / n, bad

    def read(self, rows: Tensor | None = None) -> PhysicsState:
        which = range(len(self.rows)) if rows is None else rows.tolist()

        def stacked(name: str) -> Tensor:
            values = np.stack([getattr(self.rows[row], name) for row in which])
            return torch.from_numpy(values).float().nan_to_num(0.0)

        qpos, qvel = stacked("qpos"), stacked("qvel")
        place = qpos[:, self.stop :].reshape(len(qpos), -1, 3)
        upright = torch.tensor([1.0, 0, 0, 0]).expand(*place.shape[:2], 4)
        return PhysicsState(
            base_pose=qpos[:, :7],
            base_lin_vel_w=qvel[:, :3],
            base_ang_vel_b=qvel[:, 3:6],
            joint_pos=qpos[:, 7 : self.stop],
            joint_vel=qvel[:, 6 : self.stop - 1],
            object_pose=torch.cat((place, upright), -1),
            object_lin_vel_w=qvel[:, self.stop - 1 :].reshape(place.shape),
        )

    def state(self) -> Tensor:
        size = mujoco.mj_stateSize(self.model, WHOLE)
        values = np.zeros((len(self.rows), size))
        for data, value in zip(self.rows, values, strict=True):
            mujoco.mj_getState(self.model, data, value, WHOLE)
        parts = [torch.from_numpy(values)]
        if self.scene.config.target_velocity == "finite_difference":
            parts.append(self.last.double())
        return torch.cat(parts, -1)

    def load_state(self, state: Tensor) -> None:
        size = mujoco.mj_stateSize(self.model, WHOLE)
        for data, value in zip(self.rows, state[:, :size].numpy(), strict=True):
            mujoco.mj_setState(self.model, data, value, WHOLE)
        if self.scene.config.target_velocity == "finite_difference":
            self.last.copy_(state[:, size:])
