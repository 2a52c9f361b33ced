"""Use the proximity sensors on an arm from a URDF file, without any simulator.

python scripts/reuse_urdf_arm.py

pytorch-kinematics builds the chain from the URDF. A fixed robot has a constant base
pose.
"""

from __future__ import annotations

from egoskin.interrupts import end_quietly

if __name__ == "__main__":
    end_quietly()

# isort: split

import numpy as np
import pytorch_kinematics as pk
import torch
import tyro
from tensordict import TensorDict
from torchrl.envs import Compose

from egoskin.commands.errors import clear_errors
from egoskin.sensors import FieldSensor, Ray, RaySensor, Skin
from egoskin.shapes import Sphere

# Six tubes: name of the link, length [m], axis of its joint.
TUBES = (
    ("shoulder", 0.20, "0 0 1"),
    ("upper_arm", 0.35, "0 1 0"),
    ("forearm", 0.30, "0 1 0"),
    ("wrist_1", 0.12, "0 0 1"),
    ("wrist_2", 0.12, "0 1 0"),
    ("tool", 0.10, "0 0 1"),
)
RADIUS = 0.05
RANGE = 0.4
# The arm is bolted to a table: position [m] and quaternion (w, x, y, z).
BASE_POSE = (0.0, 0.0, 0.7, 1.0, 0.0, 0.0, 0.0)
BALL = Sphere(radius=0.1)
BALL_POSE = (0.85, 0.2, 1.1, 1.0, 0.0, 0.0, 0.0)


def urdf() -> str:
    """Return the arm: each tube sits on the previous one and turns about its foot."""
    parts, parent, foot = ["<link name='base'/>"], "base", 0.0
    for name, length, axis in TUBES:
        parts.append(
            f"<link name='{name}'><collision><origin xyz='0 0 {length / 2}'/><geometry>"
            f"<cylinder radius='{RADIUS}' length='{length}'/></geometry></collision>"
            f"</link><joint name='{name}_joint' type='revolute'>"
            f"<parent link='{parent}'/><child link='{name}'/>"
            f"<origin xyz='0 0 {foot}'/><axis xyz='{axis}'/>"
            "<limit lower='-3' upper='3' effort='50' velocity='2'/></joint>"
        )
        parent, foot = name, length
    return f"<robot name='arm'>{''.join(parts)}</robot>"


def skin_of_rings() -> Skin:
    """Return a skin of four sensors around the middle of each tube."""
    ring = np.array([[1.0, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0]])
    middle = np.array([[0, 0, length / 2] for _, length, _ in TUBES])
    return Skin(
        robot="arm",
        links=tuple(name for name, _, _ in TUBES for _ in ring),
        position=(middle[:, None] + RADIUS * ring).reshape(-1, 3),
        normal=np.tile(ring, (len(TUBES), 1)),
    )


def sweep(steps: int) -> TensorDict:
    """Return a motion past the ball, ``[T]``, with the keys that sensors read."""
    joint_pos = torch.zeros(steps, len(TUBES))
    joint_pos[:, 0] = torch.linspace(-1.5, 1.5, steps)  # [rad]
    joint_pos[:, 1], joint_pos[:, 2] = 0.6, 0.9
    return TensorDict(
        {
            "base_pose": torch.tensor(BASE_POSE).expand(steps, 7),
            "joint_pos": joint_pos,
            "object_pose": torch.tensor([BALL_POSE]).expand(steps, 1, 7),
            "object_active": torch.ones(steps, 1, dtype=torch.bool),
        },
        batch_size=[steps],
    )


def sensors(skin: Skin) -> Compose:
    """Return two kinds of sensors at the same positions, with different keys."""
    chain = pk.build_chain_from_urdf(urdf())
    beams = ("beams", "beams_detected")
    return Compose(
        [
            FieldSensor(skin, chain, BALL, RANGE),
            RaySensor(skin, chain, BALL, RANGE, Ray(), out_keys=beams),
        ]
    )


def main() -> None:
    """Sweep the arm past a ball and print what the sensors see of it."""
    skin = skin_of_rings()
    motion = sensors(skin)(sweep(31))
    print(f"arm of {len(TUBES)} joints with {len(skin)} sensors, turning past a ball")
    print("turn [deg]  field: closest [m]  on            beams that hit the ball")
    for row in motion[::2].unbind(0):
        closest, sensor = row["distance"].min(0)
        on = skin.links[int(sensor)] if closest.isfinite() else "-"
        hits = int(row["beams"].isfinite().sum())
        turn = float(row["joint_pos"][0].rad2deg())
        print(f"{turn:10.0f}  {closest:18.2f}  {on:12s}  {hits:23d}")


if __name__ == "__main__":
    with clear_errors():
        tyro.cli(main)
