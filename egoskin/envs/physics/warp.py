"""Engine on MuJoCo Warp: all rows on one device, intended for an NVIDIA GPU.

Contract: that of `egoskin.envs.physics.contract`, computed in float32. PyTorch tensors
are views of Warp arrays: nothing is copied to the host. `WarpPhysics.note` reports
contacts that did not fit into Warp's fixed buffers; rows that may be affected count as
diverged.

Warp's CPU device runs the same computation slowly; it is meant for tests.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import mujoco_warp as mjw  # pyright: ignore[reportMissingImports]
import torch
import warp as wp  # pyright: ignore[reportMissingImports]
from torch import Tensor

from egoskin.envs.physics.contract import (
    Physics,
    PhysicsState,
    Scene,
    StepResult,
    Variation,
)
from egoskin.envs.physics.model import PARKING, build_scene
from egoskin.envs.physics.warp_step import (
    begin,
    end,
    hold,
    launch,
    observe,
    outcome_of,
)
from egoskin.gpu import init_warp
from egoskin.robots.model import body_id

SETTING = "EGOSKIN_WARP_CONTACTS"
"""Environment variable: capacity of the buffers, in contacts per robot."""
# Four times the number observed for a robot flailing on the floor.
_CONTACTS = 48
# Model fields that a variation sets per row, and those that MuJoCo derives from masses.
_VARIED = (
    *("body_mass", "body_inertia", "geom_friction", "jnt_actfrcrange"),
    *("actuator_gainprm", "actuator_biasprm", "actuator_forcerange"),
)
_DERIVED = ("body_subtreemass", "body_invweight0", "dof_invweight0", "actuator_acc0")


class WarpPhysics(Physics):
    """Simulations of a scene on one device; see `Physics`.

    Args:
        scene: The scene.
        num_envs: Number of rows ``B``.
        num_threads: Ignored.
        device: A CUDA device, or the CPU.
    """

    def __init__(
        self,
        scene: Scene,
        num_envs: int,
        *,
        num_threads: int = 1,
        device: torch.device | str = "cpu",
    ) -> None:
        robot, config = scene.robot, scene.config
        self.scene, self.config, self.num_envs = scene, config, num_envs
        self.device = torch.device(device)
        init_warp()
        self._mujoco, contacts = build_scene(scene), self.num_contacts()
        model = self._mujoco
        # Constraint rows: sides of each contact's friction pyramid, joint limits, etc.
        sides = max(2 * (int(model.geom_condim.max()) - 1), 1)
        others = int(model.jnt_limited.sum() + (model.dof_frictionloss > 0).sum())
        others += 6 * model.neq + model.ntendon
        with self._in_order():
            try:
                self._model = self._put_model()
                self._data = data = mjw.make_data(
                    model,
                    nworld=num_envs,
                    nconmax=contacts,
                    njmax=sides * contacts + others,
                )
            except (NotImplementedError, ValueError) as error:
                text = " ".join(str(error).split())
                raise ValueError(
                    f"MuJoCo Warp cannot load the scene: {text}"
                ) from error
            self._outcome = outcome_of(scene, data)
            shape = num_envs, len(scene.objects)
            self._active = wp.zeros(shape, dtype=wp.bool)
            self._held = wp.zeros_like(data.qpos) if scene.hold else None
        self._overflowed = wp.to_torch(self._outcome.overflowed)
        self._qpos, self._qvel = wp.to_torch(data.qpos), wp.to_torch(data.qvel)
        self._ctrl = wp.to_torch(data.ctrl)
        self._warmstart = wp.to_torch(data.qacc_warmstart)
        # CUDA graphs by function; None: its kernels are loaded.
        self._graphs: dict[Callable[..., None], Any] = {}
        # Of each varied field: a view, the entries that vary, and their own values.
        self._varied: dict[str, tuple[Tensor, Tensor, Tensor]] = {}
        num_joints = len(robot.joints)
        kp, kd = robot.joint_gains(config.gains)
        self._kd_over_kp = torch.from_numpy(kd / kp).float().to(self.device)
        self._last_target = torch.zeros_like(self._ctrl)
        self._robot_q, self._robot_v = slice(0, 7 + num_joints), slice(6 + num_joints)
        # Views, [B, O, 3].
        self._object_pos = self._qpos[:, 7 + num_joints :].unflatten(-1, (-1, 3))
        self._object_vel = self._qvel[:, 6 + num_joints :].unflatten(-1, (-1, 3))

    @staticmethod
    def num_contacts() -> int:
        """Return the capacity of the buffers, in contacts per robot.

        Raises:
            ValueError: If the environment variable is not a positive integer.
        """
        text = os.environ.get(SETTING, str(_CONTACTS))
        if not (text.isdecimal() and int(text)):
            raise ValueError(f"{SETTING} must be a positive integer, got {text!r}")
        return int(text)

    def _put_model(self, **options: Any) -> mjw.Model:
        model = mjw.put_model(self._mujoco, **options)
        # `note` reports overflows; reaching the iteration limit invalidates no row.
        model.opt.warn_overflow = 0
        model.opt.contact_sensor_maxmatch = self.num_contacts()
        return model

    @contextmanager
    def _in_order(self) -> Iterator[None]:
        """Run Warp on this device, after the work that PyTorch has already queued."""
        if self.device.type == "cpu":
            with wp.ScopedDevice("cpu"):
                yield
        else:
            stream = torch.cuda.current_stream(self.device)
            with wp.ScopedStream(wp.stream_from_torch(stream), sync_enter=False):
                yield

    def _run(self, function: Callable[[mjw.Model, mjw.Data], None]) -> None:
        """Call a function of MuJoCo Warp; on a GPU as one CUDA graph, if possible.

        It is captured at the second call, because the first one loads the kernels.
        """
        device = wp.device_from_torch(self.device)
        graph = self._graphs.get(function)
        if graph is None and function in self._graphs and device.is_mempool_enabled:
            torch.cuda.synchronize(self.device)
            with wp.ScopedDevice(device), wp.ScopedCapture() as capture:
                function(self._model, self._data)
            graph = self._graphs[function] = capture.graph
        with self._in_order():
            if graph is not None:
                wp.capture_launch(graph, wp.get_stream())
                return
            function(self._model, self._data)
            if device.is_cuda:
                self._graphs[function] = None

    def step(self, target: Tensor, active: Tensor) -> StepResult:
        """Advance every row by one control step; see `Physics.step`."""
        wp.to_torch(self._active).copy_(active)
        self._set_target(target)
        self._run(self._control_step)
        out, objects = self._outcome, active.shape[1]
        found = wp.to_torch(out.found).clone()
        fallen, power, saturation, diverged = (
            wp.to_torch(x).clone()
            for x in (out.fallen, out.power, out.saturation, out.diverged)
        )
        by_link = None
        if self.scene.link_contacts:
            links = found[:, objects + 2 + len(self.scene.robot.feet) :]
            by_link = links.unflatten(-1, (-1, 2)).any(-1)
        return StepResult(
            object_hit=found[:, :objects],
            fallen=fallen,
            self_contact=found[:, objects],
            link_contact=by_link,
            power=power,
            torque_saturation=saturation,
            diverged=diverged,
        )

    def _control_step(self, model: mjw.Model, data: mjw.Data) -> None:
        """Launch the kernels of a control step."""
        out, q, v = self._outcome, data.qpos, data.qvel
        launch(begin, out, self._active, q, v, data.overflow)
        if self._held is not None:
            wp.copy(self._held, q)
        for _ in range(self.config.substeps):
            mjw.step(model, data)
            torque, limit = data.actuator_force, model.actuator_forcerange
            launch(observe, out, data.sensordata, torque, limit, v)
            if self._held is not None:
                launch(hold, out, self._held, q, v)
        launch(end, out, q, v, data.overflow)

    def _set_target(self, target: Tensor) -> None:
        """Set the position targets of the PD law [rad], ``[B, J]``."""
        if self.config.target_velocity == "zero":
            self._ctrl.copy_(target)
            return
        # kp (q* - q) + kd (qdot* - qdot) = kp ((q* + kd/kp qdot*) - q) - kd qdot
        velocity = (target - self._last_target) * self.config.control_hz
        self._ctrl.copy_(target + self._kd_over_kp * velocity)
        self._last_target.copy_(target)

    def step_raw(self) -> None:
        """Advance one control step without reading results, to time physics alone."""
        for _ in range(self.config.substeps):
            self._run(mjw.step)

    def note(self) -> str | None:
        """Report contacts that did not fit; see `Physics.note`."""
        overflowed = bool(self._overflowed)
        self._overflowed.zero_()
        if not overflowed:
            return None
        return (
            "contacts did not fit into MuJoCo Warp's buffers "
            f"({self.num_contacts()} contacts per robot); affected rows count as "
            f"diverged: increase {SETTING}"
        )

    def reset(self, rows: Tensor, base_pose: Tensor, joint_pos: Tensor) -> None:
        """Put the robots of some rows at rest in a pose; see `Physics.reset`."""
        self._qpos[rows, self._robot_q] = torch.cat((base_pose, joint_pos), -1)
        self._object_pos[rows] = 0.0
        self._object_pos[rows, :, 2] = PARKING[2]
        # Everything else is computed from these.
        self._qvel[rows] = 0.0
        self._warmstart[rows] = 0.0
        self._last_target[rows] = joint_pos

    def throw(
        self, rows: Tensor, objects: Tensor, position: Tensor, velocity: Tensor
    ) -> None:
        """Release one object in each of some rows; see `Physics.throw`."""
        self._object_pos[rows, objects] = position
        self._object_vel[rows, objects] = velocity

    def vary(self, rows: Tensor, variation: Variation) -> None:
        """Scale model fields per row; see `Physics.vary`."""
        if not self._varied:
            self._expand()

        def scale(name: str, factor: Tensor) -> None:
            values, places, own = self._varied[name]
            factor = factor.reshape(*factor.shape, *[1] * (own.ndim - 1))
            values[rows[:, None], places] = factor * own

        scale("geom_friction", variation.friction[:, None])
        scale("actuator_gainprm", variation.gains)
        scale("actuator_biasprm", variation.gains)
        scale("actuator_forcerange", variation.torque_limit)
        # The joints clip the actuator torque again.
        scale("jnt_actfrcrange", variation.torque_limit)
        if variation.varies_mass:
            scale("body_mass", variation.link_mass)
            scale("body_inertia", variation.link_mass)
            self._run(mjw.set_const)

    def _expand(self) -> None:
        """Give each row its own values of the fields that a variation scales."""
        model, n = self._mujoco, self.num_envs
        links = [body_id(model, link) for link in self.scene.robot.links]
        joints = model.actuator_trnid[:, 0].tolist()
        some = {"body_mass": links, "body_inertia": links, "jnt_actfrcrange": joints}
        with self._in_order():
            self._model = self._put_model(
                batch_sizes=dict.fromkeys((*_VARIED, *_DERIVED), n)
            )
        self._graphs.clear()
        for name in _VARIED:
            values = wp.to_torch(getattr(self._model, name))
            which = some.get(name, [*range(values.shape[1])])
            own = torch.from_numpy(getattr(model, name)[which])
            places = torch.tensor(which, device=values.device)
            self._varied[name] = values, places, own.to(values)

    def push(self, rows: Tensor, velocity: Tensor) -> None:
        """Change the velocity of the base of some rows; see `Physics.push`."""
        self._qvel[rows, :3] += velocity

    def read(self, rows: Tensor | None = None) -> PhysicsState:
        """Return the state of some rows, or of all; see `Physics.read`."""
        select = slice(None) if rows is None else rows
        qpos = self._qpos[select].nan_to_num(0.0)
        qvel = self._qvel[select].nan_to_num(0.0)
        object_pos = qpos[:, self._robot_q.stop :].unflatten(-1, (-1, 3))
        upright = torch.nn.functional.pad(torch.ones_like(object_pos[..., :1]), (0, 3))
        return PhysicsState(
            base_pose=qpos[:, :7].contiguous(),
            base_lin_vel_w=qvel[:, :3].contiguous(),
            base_ang_vel_b=qvel[:, 3:6].contiguous(),
            joint_pos=qpos[:, 7 : self._robot_q.stop].contiguous(),
            joint_vel=qvel[:, 6 : self._robot_v.stop].contiguous(),
            object_pose=torch.cat((object_pos, upright), -1),
            object_lin_vel_w=qvel[:, self._robot_v.stop :]
            .unflatten(-1, (-1, 3))
            .clone(),
        )

    def state(self) -> Tensor:
        """Return everything needed to continue, ``[B, n]`` float64."""
        return torch.cat(self._parts(), -1).double()

    def load_state(self, state: Tensor) -> None:
        """Restore a state that `state` returned."""
        parts = self._parts()
        sizes = [part.shape[1] for part in parts]
        for part, value in zip(parts, state.split(sizes, -1), strict=True):
            part.copy_(value)

    def _parts(self) -> list[Tensor]:
        """Return the tensors that make up the state, ``[B, ...]`` each, not copied."""
        parts = [self._qpos, self._qvel, self._warmstart]
        if self.config.target_velocity == "finite_difference":
            parts.append(self._last_target)
        return parts
