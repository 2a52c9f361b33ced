"""Draw what a sensor sees, and what it signals of a ball that flies past.

python docs/pictures/signals.py docs/pictures/signals.svg        (extra: egoskin[plot])
"""

from __future__ import annotations

import math
import sys

import matplotlib
import numpy as np
import torch
from tensordict import TensorDict

matplotlib.use("Agg")
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.patches import Circle, Wedge

from egoskin.sensors import Binary, Corruption, Proximity, Ray
from egoskin.sensors.imperfections.presets import PRESETS

RANGE, RADIUS, HZ = 2.0, 0.15, 60
BLUE, ORANGE, GREY = "#1f5fa8", "#d9731a", "#8a8a8a"


def draw_coverage(axes: Axes, title: str) -> None:
    """Draw what one sensor, on a body at the left, sees of the plane."""
    axes.add_patch(Circle((-0.35, 0), 0.35, color="#d5d5d5"))
    axes.plot(0, 0, "o", color="black", markersize=4)
    axes.annotate("", (0.45, 0), (0, 0), arrowprops={"arrowstyle": "->"}, zorder=4)
    axes.text(-0.1, 0.1, "normal", fontsize=8, ha="right")
    axes.set(xlim=(-2.3, 2.6), ylim=(-2.3, 2.3), aspect="equal", title=title)
    axes.axis("off")


def draw_ball(axes: Axes, centre: tuple[float, float]) -> None:
    """Draw a ball."""
    axes.add_patch(Circle(centre, RADIUS, color=ORANGE, zorder=3))


def draw_field(axes: Axes) -> None:
    """Draw a field: the closest point of the ball, whatever its direction."""
    draw_coverage(axes, "field: one distance")
    axes.add_patch(Circle((0, 0), RANGE, color=BLUE, alpha=0.12))
    ball = np.array([1.0, 1.3])
    draw_ball(axes, tuple(ball))
    near = ball * (1 - RADIUS / np.linalg.norm(ball))
    axes.plot([0, near[0]], [0, near[1]], color=BLUE)
    axes.text(0.1, 0.75, "distance", fontsize=8, color=BLUE)
    axes.text(0, -2.2, "range 2 m", fontsize=8, ha="center", color=BLUE)


def draw_ray(axes: Axes) -> None:
    """Draw a grid of beams, cut through its middle: each its first hit."""
    ray = Ray()
    draw_coverage(axes, "ray: a row of its 8 x 8 beams")
    half = math.degrees(math.atan(ray.half_extent))
    axes.add_patch(Wedge((0, 0), RANGE, -half, half, color=BLUE, alpha=0.12))
    ball = np.array([1.4, 0.25])
    draw_ball(axes, tuple(ball))
    zones = (2 * np.arange(ray.grid[1]) + 1) / ray.grid[1] - 1
    for angle in np.arctan(ray.half_extent * zones):
        way = np.array([math.cos(angle), math.sin(angle)])
        along = way @ ball
        root = RADIUS**2 - (ball @ ball - along**2)
        hit = root > 0
        end = way * (along - math.sqrt(root) if hit else RANGE)
        axes.plot([0, end[0]], [0, end[1]], color=BLUE if hit else GREY, linewidth=0.8)
    text = f"range 2 m\n{ray.fov_deg:.0f} deg from corner to corner"
    axes.text(0, -2.2, text, fontsize=8, ha="center", color=BLUE)


def draw_signals(axes: Axes) -> None:
    """Draw signals of a ball that flies past at 5 m/s, 0.4 m from the sensor."""
    time = torch.arange(-30, 31) / HZ
    distance = (torch.hypot(5 * time, torch.tensor(0.4)) - RADIUS)[:, None]
    seen = torch.where(distance <= RANGE, distance, torch.inf)
    corruption = Corruption(PRESETS["time_of_flight"](), dt=1 / HZ, seed=1)
    clean = TensorDict({"distance": seen}, [len(time)])
    start = torch.arange(len(time))[:, None] == 0
    noisy = corruption(clean.clone().set("is_init", start))
    proximity = Proximity(RANGE)
    late = Proximity(RANGE, in_keys=["reading"])(noisy)["signal"]
    for name, signal, colour in (
        ("proximity", proximity(clean)["signal"], BLUE),
        ("binary", Binary(RANGE)(clean.clone())["signal"], GREY),
        ("proximity of a time-of-flight sensor", late, ORANGE),
    ):
        axes.step(time, signal[:, 0], where="post", label=name, color=colour)
    axes.set(xlabel="time [s]", ylabel="signal", title="a ball flies past")
    axes.set(ylim=(-0.05, 1.5), yticks=[0, 0.25, 0.5, 0.75, 1])
    axes.legend(fontsize=8, frameon=False, loc="upper left")
    axes.spines[["top", "right"]].set_visible(False)


def main(path: str) -> None:
    """Write the picture."""
    plt.rcParams.update({"svg.hashsalt": "egoskin", "font.size": 9})
    figure, axes = plt.subplots(1, 3, figsize=(9.6, 3.4), layout="constrained")
    draw_field(axes[0])
    draw_ray(axes[1])
    draw_signals(axes[2])
    # The same bytes each time.
    figure.savefig(path, format="svg", metadata={"Date": None})


if __name__ == "__main__":
    main(sys.argv[1])
