"""The built-in robots; their MJCF is in ``assets/``."""

from __future__ import annotations

from pathlib import Path

from egoskin.robots.config import Gain, RobotConfig

_ASSETS = Path(__file__).parents[1] / "assets"

_ARMS = tuple(
    f"{side}_{part}_link"
    for side in ("left", "right")
    for part in (
        "shoulder_pitch",
        "shoulder_roll",
        "shoulder_yaw",
        "elbow",
        "wrist_roll",
        "wrist_pitch",
        "wrist_yaw",
    )
)
_SHINS_AND_FEET = tuple(
    f"{side}_{part}_link"
    for side in ("left", "right")
    for part in ("knee", "ankle_pitch", "ankle_roll")
)

H1_2 = RobotConfig(
    name="h1_2",
    model_path=_ASSETS / "h1_2.xml",
    base="pelvis",
    # Stance of Unitree's training code for the H1-2.
    default_pose={
        "*_hip_pitch_joint": -0.16,
        "*_knee_joint": 0.36,
        "*_ankle_pitch_joint": -0.2,
        "*_shoulder_pitch_joint": 0.4,
        "*_elbow_joint": 0.3,
    },
    gains={
        # kp = I w^2, kd = 2 zeta I w with the reflected rotor inertia I, w = 10 Hz
        # and damping ratio zeta = 2.
        "rotor_inertia": {
            "*_hip_*_joint": Gain(kp=98.7, kd=6.3),
            "*_knee_joint": Gain(kp=157.7, kd=10.1),
            "*_ankle_*_joint": Gain(kp=19.7, kd=1.3),
            "torso_joint": Gain(kp=98.7, kd=6.3),
            "*_shoulder_pitch_joint": Gain(kp=19.7, kd=1.3),
            "*_shoulder_roll_joint": Gain(kp=19.7, kd=1.3),
            "*_shoulder_yaw_joint": Gain(kp=7.9, kd=0.5),
            "*_elbow_joint": Gain(kp=7.9, kd=0.5),
        },
        # Unitree's figures for the real robot.
        "real": {
            "*_hip_*_joint": Gain(kp=200.0, kd=2.5),
            "*_knee_joint": Gain(kp=300.0, kd=4.0),
            "*_ankle_*_joint": Gain(kp=40.0, kd=2.0),
            "torso_joint": Gain(kp=300.0, kd=3.0),
            "*_shoulder_*_joint": Gain(kp=120.0, kd=2.0),
            "*_elbow_joint": Gain(kp=80.0, kd=1.0),
        },
    },
    feet=tuple(
        f"{s}_ankle_{a}_link" for s in ("left", "right") for a in ("pitch", "roll")
    ),
    skin_links=("torso_link", *_ARMS),
    untargeted_links=_SHINS_AND_FEET,
)
"""Unitree H1-2 without hands, wrists locked: 21 joints."""

G1 = RobotConfig(
    name="g1",
    model_path=_ASSETS / "g1.xml",
    base="pelvis",
    # Knees bent, the centre of mass above the soles; arms clear of the body.
    default_pose={
        "*_hip_pitch_joint": -0.28,
        "*_knee_joint": 0.56,
        "*_ankle_pitch_joint": -0.28,
        "*_shoulder_pitch_joint": 0.2,
        "left_shoulder_roll_joint": 0.2,
        "right_shoulder_roll_joint": -0.2,
        "*_elbow_joint": 0.6,
    },
    gains={
        # As for the H1-2: from the armatures, at 10 Hz and damping ratio 2, as in
        # public controllers of the G1 (BeyondMimic, mjlab).
        "rotor_inertia": {
            "*_hip_pitch_joint": Gain(kp=40.2, kd=2.56),
            "*_hip_yaw_joint": Gain(kp=40.2, kd=2.56),
            "*_hip_roll_joint": Gain(kp=99.1, kd=6.31),
            "*_knee_joint": Gain(kp=99.1, kd=6.31),
            "*_ankle_*_joint": Gain(kp=28.5, kd=1.81),
            "waist_yaw_joint": Gain(kp=40.2, kd=2.56),
            "waist_[rp]*_joint": Gain(kp=28.5, kd=1.81),
            "*_shoulder_*_joint": Gain(kp=14.3, kd=0.907),
            "*_elbow_joint": Gain(kp=14.3, kd=0.907),
            "*_wrist_roll_joint": Gain(kp=14.3, kd=0.907),
            "*_wrist_[py]*_joint": Gain(kp=16.8, kd=1.07),
        },
        # Unitree's low-level example for the real robot (unitree_sdk2).
        "real": {
            "*_hip_*_joint": Gain(kp=60.0, kd=1.0),
            "*_knee_joint": Gain(kp=100.0, kd=2.0),
            "*_ankle_*_joint": Gain(kp=40.0, kd=1.0),
            "waist_yaw_joint": Gain(kp=60.0, kd=1.0),
            "waist_[rp]*_joint": Gain(kp=40.0, kd=1.0),
            "*_shoulder_*_joint": Gain(kp=40.0, kd=1.0),
            "*_elbow_joint": Gain(kp=40.0, kd=1.0),
            "*_wrist_*_joint": Gain(kp=40.0, kd=1.0),
        },
    },
    feet=H1_2.feet,
    skin_links=("torso_link", *_ARMS),
    untargeted_links=_SHINS_AND_FEET,
)
"""Unitree G1 with rubber hands: 29 joints."""

ROBOTS = {robot.name: robot for robot in (H1_2, G1)}
"""Robots that can be chosen by name."""
