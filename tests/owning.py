"""A small robot in its own folder, as provided by a user."""

from __future__ import annotations

from pathlib import Path

# A box on two straight legs with feet; arms that hang beside it. Nothing of it is
# written for this package: bits of collision are MuJoCo's defaults.
MODEL = """
<mujoco model="pip">
  <compiler angle="radian"/>
  <default><joint actuatorfrcrange="-60 60" range="-1.5 1.5" armature="0.02"/></default>
  <worldbody>
    <light pos="0 0 3"/>
    <geom name="ground" type="plane" size="0 0 1"/>
    <body name="trunk" pos="0 0 0.7">
      <freejoint/>
      <geom type="box" size="0.1 0.15 0.2" pos="0 0 0.2" mass="10"/>
      <body name="left_arm" pos="0 0.25 0.3">
        <joint name="left_shoulder" axis="0 1 0"/>
        <geom type="capsule" size="0.04" fromto="0 0 0 0 0 -0.3" mass="1"/>
      </body>
      <body name="right_arm" pos="0 -0.25 0.3">
        <joint name="right_shoulder" axis="0 1 0"/>
        <geom type="capsule" size="0.04" fromto="0 0 0 0 0 -0.3" mass="1"/>
      </body>
      <body name="left_leg" pos="0 0.1 -0.05">
        <joint name="left_hip" axis="0 1 0"/>
        <geom type="cylinder" size="0.05 0.28" pos="0 0 -0.3" mass="2"/>
        <body name="left_foot" pos="0 0 -0.62">
          <joint name="left_ankle" axis="0 1 0"/>
          <geom type="box" size="0.15 0.06 0.02" mass="0.5"/>
        </body>
      </body>
      <body name="right_leg" pos="0 -0.1 -0.05">
        <joint name="right_hip" axis="0 1 0"/>
        <geom type="cylinder" size="0.05 0.28" pos="0 0 -0.3" mass="2"/>
        <body name="right_foot" pos="0 0 -0.62">
          <joint name="right_ankle" axis="0 1 0"/>
          <geom type="box" size="0.15 0.06 0.02" mass="0.5"/>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator><motor joint="left_hip"/></actuator>
</mujoco>
"""
TOML = """\
model = "pip.xml"
base = "trunk"
feet = ["*_foot"]
skin_links = [
    "trunk",
    "*_arm",
]
untargeted_links = ["*_leg", "*_foot"]

[default_pose]
left_shoulder = 0.1

[gains.stiff]
"*_hip" = { kp = 150, kd = 5 }
"*_ankle" = { kp = 150, kd = 5 }
"*_shoulder" = { kp = 20, kd = 1 }
"""


def write_robot(folder: Path, toml: str = TOML, model: str = MODEL) -> Path:
    """Write the robot into a folder, and return it."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "robot.toml").write_text(toml)
    (folder / "pip.xml").write_text(model)
    return folder
