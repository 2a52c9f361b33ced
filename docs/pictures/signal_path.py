"""Draw the path of a signal from the configuration to the kernel and the policy.

python docs/pictures/signal_path.py docs/pictures/signal-path.svg  (extra egoskin[plot])
"""

from __future__ import annotations

import sys

import matplotlib

matplotlib.use("Agg")
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.patches import FancyBboxPatch

FRAME, SENSOR, KERNEL = "#33475b", "#1f5fa8", "#d9731a"
FILLS = {FRAME: "#ffffff", SENSOR: "#e4edf7", KERNEL: "#fbeadb"}
BOXES = {
    "EnvConfig": (0.9, 4.35, 1.5, FRAME, "robot, skin, sensor"),
    "Skin": (3.1, 4.35, 1.5, FRAME, "positions, normals [m]"),
    "SensorPipeline": (5.5, 4.35, 1.8, FRAME, "coverage and range\nof each sensor"),
    "transforms": (8.4, 4.35, 1.9, FRAME, "of the environment"),
    "Physics": (0.9, 2.7, 1.5, FRAME, "MuJoCo, 120 Hz:\nrobot and balls"),
    "sensor": (3.9, 2.7, 1.5, SENSOR, "FieldSensor\nor RaySensor"),
    "Corruption": (6.3, 2.7, 1.5, SENSOR, "optional: noise,\nrate, latency, ..."),
    "signal transform": (8.6, 2.7, 1.7, SENSOR, "Proximity, Binary,\nLocalization"),
    "kernel": (
        3.9,
        1.2,
        2.9,
        KERNEL,
        "C++: spheres, no gradients\nPyTorch: everything else",
    ),
    "policy": (8.6, 0.55, 1.7, FRAME, "also reads the body"),
}
"""Name: centre x and y, width, colour, text."""
HEIGHT = 0.85
STEPS = (
    ("EnvConfig", "Skin", "", ""),
    ("Skin", "SensorPipeline", "", ""),
    ("SensorPipeline", "transforms", "", ""),
    ("Physics", "sensor", "base_pose\njoint_pos", "object_pose\nobject_active"),
    ("sensor", "Corruption", "distance", ""),
    ("Corruption", "signal transform", "reading", ""),
    ("sensor", "kernel", "", ""),
    ("signal transform", "policy", "signal", ""),
)
"""From, to, TensorDict keys above and below the arrow."""


def draw_box(axes: Axes, name: str) -> None:
    """Draw one box with its name and text."""
    x, y, width, colour, text = BOXES[name]
    corner, size = (x - width / 2, y - HEIGHT / 2), (width, HEIGHT)
    style = {"boxstyle": "round,pad=0,rounding_size=0.06", "zorder": 2}
    axes.add_patch(
        FancyBboxPatch(corner, *size, fc=FILLS[colour], ec=colour, lw=1.2, **style)
    )
    axes.text(x, y + 0.24, name, weight="bold", ha="center", va="center", zorder=3)
    below = {"fontsize": 7.5, "color": "#4a5a68", "zorder": 3}
    axes.text(x, y - 0.12, text, ha="center", va="center", **below)


def draw_arrow(axes: Axes, points: list[tuple[float, float]], style: str = "-") -> None:
    """Draw an arrow along some points."""
    axes.plot(*zip(*points, strict=True), color=FRAME, lw=1.2, ls=style)
    arrow = {"arrowstyle": "-|>", "color": FRAME, "lw": 1.2, "shrinkA": 0, "shrinkB": 0}
    start, end = points[-2:]
    near = tuple(
        e - 0.12 * ((e > s) - (e < s)) for s, e in zip(start, end, strict=True)
    )
    axes.annotate("", end, near, arrowprops=arrow)


def draw(path: str) -> None:
    """Write the picture."""
    # Fixed names of elements: the same bytes each time.
    plt.rcParams |= {"svg.hashsalt": "egoskin", "font.size": 9}
    figure, axes = plt.subplots(figsize=(9.6, 5), layout="constrained")
    axes.set(xlim=(0, 9.6), ylim=(0, 5))
    axes.axis("off")
    for bottom, height in ((3.75, 1.25), (0, 3.65)):
        axes.axhspan(bottom, bottom + height, color="#f6f6f6", zorder=-1)
    row = {"color": "#7a7a7a", "fontsize": 7.5, "va": "center"}
    axes.text(0.1, 4.89, "once", **row)
    text = "at every control step; physics and sensors in one worker per core"
    axes.text(0.1, 3.5, text, **row)
    key = {"color": SENSOR, "fontsize": 7.5, "family": "monospace"}
    for name in BOXES:
        draw_box(axes, name)
    for start, end, above, below in STEPS:
        (x, y, width, *_), (to_x, to_y, to_width, *_) = BOXES[start], BOXES[end]
        if y == to_y:
            x, to_x = x + width / 2, to_x - to_width / 2
            middle = (x + to_x) / 2
            draw_arrow(axes, [(x, y), (to_x, y)])
            axes.text(middle, y + 0.07, above, ha="center", va="bottom", **key)
            axes.text(middle, y - 0.07, below, ha="center", va="top", **key)
        else:
            draw_arrow(axes, [(x, y - HEIGHT / 2), (x, to_y + HEIGHT / 2)])
            axes.text(x - 0.1, (y + to_y) / 2, above, ha="right", va="center", **key)
    draw_arrow(axes, [(8.4, 4.35 - HEIGHT / 2), (8.4, 2.7 + HEIGHT / 2)], "--")
    x, y, width, *_ = BOXES["policy"]
    draw_arrow(axes, [(x - width / 2, 0.4), (0.9, 0.4), (0.9, 2.7 - HEIGHT / 2)])
    axes.text(6.6, 0.52, "action", ha="center", va="center", **key)
    axes.text(1.05, 0.52, "position targets, 60 Hz", **row)
    figure.savefig(path, metadata={"Date": None})


if __name__ == "__main__":
    draw(sys.argv[1])
