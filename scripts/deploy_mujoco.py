"""Run a policy on a simulated robot, without PyTorch.

python scripts/deploy_mujoco.py prepare field_proximity --out deployed
python scripts/deploy_mujoco.py run deployed

The first exports a policy, writes the model of the robot and a set of throws, and
prints how many the policy survives in PyTorch. The second plays the same throws without
PyTorch: it uses `egoskin.deploy` on the model as a driver would on a robot.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from egoskin.deploy import Controller

# Files that `prepare` writes.
POLICY, MODEL, THROWS = "policy.onnx", "scene.mjb", "throws.npz"
# Position of balls that are not in play [m].
PARKING = (0.0, 0.0, 1000.0)
# The aim leads a moving robot by at most this share of the ball's speed.
MAX_LEAD_RATIO = 0.9


def prepare(policy: str, out: Path, episodes: int, throw_set: int) -> None:
    """Write policy, model and throws to a folder; only this part needs PyTorch."""
    import torch

    from egoskin.envs.physics.contract import Scene
    from egoskin.envs.physics.model import build_scene
    from egoskin.envs.throws import Thrower
    from egoskin.evaluation.throw_set import play_throws, standard_task, throw_seed
    from egoskin.make import make_worker_env
    from egoskin.policies.export import export_onnx, metadata, needs_tracker
    from egoskin.policies.policy import load_policy

    loaded = load_policy(policy)
    if needs_tracker(loaded):
        raise ValueError(f"{policy} reads positions of balls, which needs a tracker")
    check_supported(metadata(loaded, None))
    config = standard_task(loaded.env_config, "2")
    # What comes later is not used.
    task = replace(config.task, episode_length_s=config.task.success_s)
    config = replace(config, task=task)
    robot, skin = config.robot_config, loaded.skin
    throws, physics = task.throws, task.physics
    out.mkdir(parents=True, exist_ok=True)
    (out / POLICY).write_bytes(export_onnx(loaded)[0])
    scene = Scene(
        robot=robot, objects=throws.balls, config=physics, weightless_objects=True
    )
    mujoco.mj_saveModel(build_scene(scene), str(out / MODEL), None)
    seed = throw_seed(config, throw_set)
    env = make_worker_env(config, skin, num_envs=episodes, seed=seed, keep_raw=True)
    start = env.reset()
    # More throws than fit into the time.
    number = int(task.success_s / throws.interval[0]) + 2
    row, throw = torch.arange(episodes).repeat_interleave(number), torch.arange(number)
    thrower = Thrower(throws, robot, physics.timestep)
    draw = thrower.draw(seed, row, torch.zeros_like(row), throw.repeat(episodes))
    played = play_throws(loaded, config, skin, throw_set=throw_set, episodes=episodes)
    failed = played.hit | played.fallen | played.diverged
    success = 1 - float(failed.double().mean())
    shape = (episodes, number)
    np.savez(
        out / THROWS,
        base_pose=start["base_pose"].numpy(),
        joint_pos=start["joint_pos"].numpy(),
        azimuth=draw.azimuth.reshape(shape).numpy(),
        distance=draw.distance.reshape(shape).numpy(),
        height=draw.height.reshape(shape).numpy(),
        speed=draw.speed.reshape(shape).numpy(),
        interval=draw.interval.reshape(shape).numpy(),
        aim_link=np.array(thrower.aim_link(draw)).reshape(shape),
        aim_point=thrower.aim_point(draw).reshape(*shape, 3).numpy(),
        success_s=task.success_s,
        success=success,
    )
    print(f"{out}: {episodes} episodes; PyTorch succeeds in {success:.1%}")


def check_supported(metadata: dict[str, Any]) -> None:
    """Raise ValueError if a policy needs what the driver below does not have."""
    sensor, around = metadata["sensor"], {"coverage": "field", "half_angle_deg": 180}
    kinds = metadata["skin"].get("types", {}).values()
    if any(kind != around for kind in kinds) or sensor["occlusion"]:
        raise ValueError("this example needs field sensors that see all around")
    if sensor["corruption"] != "none":
        raise ValueError("this example has no model of real sensors")
    if metadata["target_velocity"] != "zero":
        raise ValueError("this example sends no velocity targets")


class Robot:
    """The robot, its skin and the balls in MuJoCo, as a driver would access them.

    Args:
        model: The model.
        metadata: The exported policy's metadata on the robot and its skin.
    """

    def __init__(self, model: mujoco.MjModel, metadata: dict[str, Any]) -> None:
        check_supported(metadata)
        self.model, self.data = model, mujoco.MjData(model)
        joints = [model.joint(name) for name in metadata["joints"]]
        self._q = np.array([joint.qposadr[0] for joint in joints])
        self._v = np.array([joint.dofadr[0] for joint in joints])
        self._u = np.array([model.actuator(name).id for name in metadata["joints"]])
        self.num_balls = sum(
            model.body(i).name[:7] == "object_" for i in range(model.nbody)
        )
        balls = [model.joint(f"object_{i}_x") for i in range(self.num_balls)]
        self._ball_q = np.array(
            [[ball.qposadr[0] + k for k in range(3)] for ball in balls]
        )
        self._ball_v = np.array(
            [[ball.dofadr[0] + k for k in range(3)] for ball in balls]
        )
        self._radius = float(model.geom("object_0").size[0])
        skin = metadata["skin"]["sensors"]
        self._link = np.array([model.body(sensor["link"]).id for sensor in skin])
        self._position = np.array([sensor["position"] for sensor in skin])
        self._range = np.array(metadata["range"], dtype=float)
        self._substeps = round(1 / (metadata["control_hz"] * model.opt.timestep))
        self.in_play = np.zeros(self.num_balls, dtype=bool)

    def reset(self, base_pose: np.ndarray, joint_pos: np.ndarray) -> None:
        """Set the robot to a pose, at rest; no ball is in play."""
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[:7], self.data.qpos[self._q] = base_pose, joint_pos
        self.in_play[:] = False
        self._look()

    def body(self) -> dict[str, Any]:
        """Return the readings of the robot's encoders and IMU."""
        return {
            "base_quat": self.data.qpos[3:7],
            "base_ang_vel_b": self.data.qvel[3:6],
            "joint_pos": self.data.qpos[self._q],
            "joint_vel": self.data.qvel[self._v],
        }

    def distance(self) -> np.ndarray:
        """Return the measured distances [m], infinite where nothing is in range."""
        turn = self.data.xmat[self._link].reshape(-1, 3, 3)
        sensor = self.data.xpos[self._link] + (turn @ self._position[..., None])[..., 0]
        balls = self.data.qpos[self._ball_q[self.in_play]]
        gap = np.linalg.norm(sensor[:, None] - balls, axis=-1) - self._radius
        nearest = np.maximum(gap, 0.0).min(1, initial=np.inf)
        return np.where(nearest <= self._range, nearest, np.inf)

    def step(self, target: np.ndarray) -> bool:
        """Simulate a control step; return whether it is untouched and upright."""
        data, balls = self.data, self.num_balls
        data.qpos[self._ball_q[~self.in_play]] = PARKING
        data.qvel[self._ball_v[~self.in_play]] = 0.0
        data.ctrl[self._u] = target
        fine = True
        for _ in range(self._substeps):
            mujoco.mj_step(self.model, data)
            # Numbers of contacts: with each ball, itself, the floor, and feet on floor.
            hits, floor, feet = np.split(data.sensordata, [balls + 1, balls + 2])
            fine &= not hits[:balls][self.in_play].any() and not floor > feet.sum()
        self.in_play &= data.qpos[self._ball_q[:, 2]] > self._radius
        self._look()
        return bool(fine)

    def throw(self, ball: int, throw: dict[str, Any]) -> None:
        """Throw a ball at a point of the robot, leading its motion."""
        data, link = self.data, self.model.body(str(throw["aim_link"])).id
        base, forward = data.qpos[:3], np.zeros(3)
        mujoco.mju_rotVecQuat(forward, np.array([1.0, 0, 0]), data.qpos[3:7])
        bearing = np.arctan2(forward[1], forward[0]) + throw["azimuth"]
        side = np.array([np.cos(bearing), np.sin(bearing)])
        start = np.array([*(base[:2] + throw["distance"] * side), throw["height"]])
        target = data.xpos[link] + data.xmat[link].reshape(3, 3) @ throw["aim_point"]
        run = np.array([*data.qvel[:2], 0.0])
        speed = throw["speed"]
        run *= min(1.0, MAX_LEAD_RATIO * speed / max(np.linalg.norm(run), 1e-6))
        # Time of arrival at the moving target: |gap + run T| = speed T
        gap = target - start
        a, b = speed**2 - run @ run, gap @ run
        time = (b + np.sqrt(b * b + a * (gap @ gap))) / a
        data.qpos[self._ball_q[ball]] = start
        data.qvel[self._ball_v[ball]] = gap / time + run
        self.in_play[ball] = True

    def _look(self) -> None:
        """Update the poses of the links."""
        mujoco.mj_kinematics(self.model, self.data)


def run(folder: Path, episodes: int | None, margin: float) -> None:
    """Play the throws that `prepare` wrote, and print how many are survived."""
    controller = Controller(folder / POLICY, margin=margin)
    hz = controller.metadata["control_hz"]
    model = mujoco.MjModel.from_binary_path(str(folder / MODEL))
    robot, throws = Robot(model, controller.metadata), dict(np.load(folder / THROWS))
    success_s, expected = float(throws.pop("success_s")), float(throws.pop("success"))
    poses = throws.pop("base_pose"), throws.pop("joint_pos")
    number = len(poses[0]) if episodes is None else episodes
    if not 1 <= number <= len(poses[0]):
        raise SystemExit(
            f"--episodes must be from 1 to {len(poses[0])}, as prepared, got {number}"
        )
    successes = 0
    for row in range(number):
        robot.reset(*(pose[row] for pose in poses))
        controller.reset()
        thrown, next_throw, fine = 0, 0, True
        for step in range(round(success_s * hz)):
            if step >= next_throw:
                throw = {key: value[row, thrown] for key, value in throws.items()}
                robot.throw(thrown % robot.num_balls, throw)
                next_throw = step + max(round(float(throw["interval"]) * hz), 1)
                thrown += 1
            target = controller.step(
                **robot.body(), body_age=0.0, distance=robot.distance(), skin_age=0.0
            )
            if controller.stopped is not None:
                raise SystemExit(f"stopped: {controller.stopped}")
            fine = robot.step(target)
            if not fine:
                break
        successes += fine
    assert "torch" not in sys.modules
    print(
        f"without PyTorch: success in {successes / number:.1%} of {number} episodes "
        f"(with it: {expected:.1%} of {len(poses[0])})"
    )


def main() -> None:
    """Run the command."""
    parser = argparse.ArgumentParser(description="Deploy without PyTorch.")
    commands = parser.add_subparsers(dest="command", required=True)
    first = commands.add_parser("prepare", help="write what `run` needs (with PyTorch)")
    first.add_argument("policy", help="run, checkpoint, policy file, or shipped name")
    first.add_argument("--out", type=Path, required=True, help="folder to write")
    first.add_argument("--episodes", type=int, default=512, help="throw sequences")
    first.add_argument("--throw-set", type=int, default=0, help="seed of the throws")
    second = commands.add_parser("run", help="play the throws, without PyTorch")
    second.add_argument("folder", type=Path, help="folder that `prepare` wrote")
    second.add_argument("--episodes", type=int, help="number of episodes (all)")
    second.add_argument(
        "--margin", type=float, default=1.0, help="how far targets may be out of range"
    )
    args = vars(parser.parse_args())
    try:
        {"prepare": prepare, "run": run}[args.pop("command")](**args)
    except (OSError, ValueError) as error:
        raise SystemExit(f"error: {error}") from None


if __name__ == "__main__":
    main()
