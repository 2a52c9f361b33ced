"""Use the proximity sensors on Gymnasium's Humanoid, in a plain TorchRL environment.

python scripts/reuse_gymnasium.py       (needs `pip install "gymnasium[mujoco]"`)

The pattern for any environment: write one transform that gives the poses of the base,
the joints and the objects, then append the sensors unchanged.

For several environments at once, use a vector environment whose autoreset is DISABLED,
as below, or ``GymEnv(name, num_workers=4)``. Do not use ``GymEnv(name, num_envs=4)``:
in TorchRL 0.14.1 it writes zeros for the last observation of each episode (and starts
the next from it), so the robot has no orientation there, and sensors return NaN.
"""

from __future__ import annotations

from egoskin.interrupts import end_quietly

if __name__ == "__main__":
    end_quietly()

# isort: split

from pathlib import Path

import gymnasium
import mujoco
import numpy as np
import torch
import tyro
from gymnasium.vector import AutoresetMode
from torch import Tensor
from torchrl.envs import Compose, GymWrapper, StepCounter, TransformedEnv

from egoskin.commands.errors import clear_errors
from egoskin.robots.chains import build_chain
from egoskin.sensors import FieldSensor, Proximity, Skin
from egoskin.shapes import Sphere
from egoskin.transform import RowTransform

MODEL = mujoco.MjModel.from_xml_path(
    str(Path(gymnasium.__file__).parent / "envs" / "mujoco" / "assets" / "humanoid.xml")
)
# Humanoid-v5 simulates five steps of 3 ms for each action.
STEP = 0.015
RANGE = 1.0

BALL = Sphere(radius=0.15)
BALL_START = (1.5, 0.2, 1.4)
BALL_VELOCITY = (-4.0, 0.0, 0.0)


def skin_of_rings() -> Skin:
    """Return a skin of four sensors around each capsule and sphere of the Humanoid."""
    links, position, normal = [], [], []
    for geom in range(MODEL.ngeom):
        if MODEL.geom_type[geom] == mujoco.mjtGeom.mjGEOM_PLANE:
            continue
        axes = np.zeros(9)
        mujoco.mju_quat2Mat(axes, MODEL.geom_quat[geom])
        x, y, _ = axes.reshape(3, 3).T  # a capsule's own axis is z
        for direction in (x, y, -x, -y):
            links.append(MODEL.body(MODEL.geom_bodyid[geom]).name)
            position.append(MODEL.geom_pos[geom] + MODEL.geom_size[geom, 0] * direction)
            normal.append(direction)
    return Skin(
        robot="humanoid",
        links=tuple(links),
        position=np.array(position),
        normal=np.array(normal),
    )


class HumanoidState(RowTransform):
    """Compute the sensors' inputs from Humanoid's observation and the step count.

    Reads ``observation [*B, 350]`` and ``step_count [*B, 1]``. Writes ``base_pose
    [*B, 7]``, ``joint_pos [*B, 17]``, and a ball that flies at the robot:
    ``object_pose [*B, 1, 7]``, ``object_active [*B, 1]``.
    """

    def __init__(self) -> None:
        super().__init__(
            in_keys=["observation", "step_count"],
            out_keys=["base_pose", "joint_pos", "object_pose", "object_active"],
        )

    def compute(self, *inputs: Tensor) -> tuple[Tensor, ...]:
        """Return the four outputs."""
        observation, steps = inputs
        # qpos comes first: the torso's pose, then the joints in the model's order.
        position, quat = observation[:, :3], observation[:, 3:7]
        # Gymnasium's reset adds noise to the quaternion without normalizing it.
        quat = quat / quat.norm(dim=-1, keepdim=True)
        start, velocity = observation.new_tensor([BALL_START, BALL_VELOCITY])
        ball = start + velocity * STEP * steps
        upright = observation.new_tensor([1, 0, 0, 0]).expand(len(ball), 4)
        return (
            torch.cat((position, quat), -1),
            observation[:, 7:24].clone(),
            torch.cat((ball, upright), -1)[:, None],
            torch.ones_like(steps, dtype=torch.bool),
        )


def make_env(skin: Skin, num_envs: int) -> TransformedEnv:
    """Return Humanoids with a skin and a ball, ``[num_envs]``, and key ``signal``."""
    envs = gymnasium.make_vec(
        "Humanoid-v5",
        num_envs,
        vectorization_mode="sync",
        vector_kwargs={"autoreset_mode": AutoresetMode.DISABLED},
        exclude_current_positions_from_observation=False,
    )
    sensor = FieldSensor(skin, build_chain(MODEL, "torso"), BALL, RANGE)
    return TransformedEnv(
        GymWrapper(envs),
        Compose([StepCounter(), HumanoidState(), sensor, Proximity(sensor)]),
    )


def main() -> None:
    """Run an episode of random actions and print what the skin sees of the ball."""
    skin = skin_of_rings()
    env = make_env(skin, num_envs=1)
    torch.manual_seed(0)
    env.set_seed(0)
    rollout = env.rollout(100)[0]
    print(f"Humanoid-v5 with {len(skin)} sensors, a ball flying at it")
    print("time [s]  sensors in range  closest [m]  on")
    for step in range(0, len(rollout), 2):
        distance = rollout["distance"][step]
        seen = int(distance.isfinite().sum())
        closest, sensor = distance.min(0)
        link = skin.links[int(sensor)] if seen else "-"
        print(f"{step * STEP:8.2f}  {seen:16d}  {closest:11.2f}  {link}")
    env.close()


if __name__ == "__main__":
    with clear_errors():
        tyro.cli(main)
