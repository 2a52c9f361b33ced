"""A small robot in its own folder, as provided by a user."""

from __future__ import annotations

import re
from pathlib import Path

PAGE = (Path(__file__).parents[1] / "docs" / "your-robot.md").read_text()
# Nothing of it is written for this package: bits of collision are MuJoCo's defaults.
(MODEL,) = re.findall(r"^```xml walker/walker.xml\n(.*?)^```", PAGE, re.DOTALL | re.M)
TOML = """\
model = "walker.xml"
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
    (folder / "walker.xml").write_text(model)
    return folder
