"""Measure a recording with other sensors, offline.

python scripts/reuse_recording.py --folder /tmp/recording

A recording is a TensorDict ``[B, T]`` on disk with the poses of robot and objects; it
may also come from motion capture or a real robot.
"""

from __future__ import annotations

from egoskin.interrupts import end_quietly

if __name__ == "__main__":
    end_quietly()

# isort: split

import tempfile
from dataclasses import dataclass
from pathlib import Path

import torch
import tyro
from tensordict import TensorDict
from torch import Tensor

from egoskin.commands.errors import clear_errors
from egoskin.envs.dodgeball import DodgeballConfig, DodgeballEnv
from egoskin.envs.throws import ThrowConfig
from egoskin.robots.builtin import H1_2
from egoskin.sensors import FieldSensor, Ray, RaySensor, place_sensors

# The first ball comes at once, because recordings are short.
TASK = DodgeballConfig(throws=ThrowConfig(first_delay=(0.0, 0.0)))
KEYS = ("base_pose", "joint_pos", "object_pose", "object_active")
STEP = 1 / TASK.physics.control_hz


@dataclass(frozen=True, kw_only=True)
class ReplayConfig:
    """Measure a recording with several sensors."""

    folder: Path | None = None
    """Memory-mapped recording, created if missing; None: a temporary one."""
    num_envs: int = 64
    """Number of robots ``B`` in a new recording."""
    num_steps: int = 60
    """Number of control steps ``T`` in a new recording."""

    def __post_init__(self) -> None:
        """Raise ValueError for counts below 1."""
        if min(self.num_envs, self.num_steps) < 1:
            raise ValueError("num_envs and num_steps must be at least 1")


def record(folder: Path, num_envs: int, num_steps: int) -> None:
    """Write a recording of robots that hold still while balls are thrown at them."""
    env = DodgeballEnv(H1_2, TASK, num_envs=num_envs, seed=0, hold=True)
    states = env.rollout(num_steps, break_when_any_done=False)
    states.select(*KEYS).memmap(folder)
    env.close()


def seconds_of_warning(seen: Tensor, gap: Tensor) -> Tensor:
    """Return how long an object was seen without interruption until it was closest.

    Args:
        seen: Whether the object is seen, ``[B, T]`` bool.
        gap: Distance between object and skin [m], ``[B, T]``.

    Returns:
        Time [s], ``[B]``; 0 for an object not seen before it was closest.
    """
    step = torch.arange(gap.shape[-1])
    closest = gap.argmin(-1)
    unseen = ~seen & (step < closest[:, None])
    last_unseen = torch.where(unseen, step, -1).amax(-1)
    return (closest - 1 - last_unseen) * STEP


def main(config: ReplayConfig) -> None:
    """Replay a recording and print what each kind of sensor would have seen."""
    with tempfile.TemporaryDirectory() as scratch:
        folder = config.folder or Path(scratch)
        if not (folder / "meta.json").exists():
            record(folder, config.num_envs, config.num_steps)
        states = TensorDict.load_memmap(folder)
        report(states)


def report(states: TensorDict) -> None:
    """Print a table of sensors: how often and how early they see the first ball."""
    skin, balls = place_sensors(H1_2, 64, seed=0), TASK.throws.balls
    chain, inf = H1_2.chain, float("inf")
    rows, steps = states.batch_size
    print(f"{rows} robots, {steps} steps of {1000 * STEP:.0f} ms, {len(skin)} sensors")
    everything = FieldSensor(skin, chain, balls, inf, per_object=True)
    gap = everything(states.copy())["distance"].amin(-2)
    print("sensor  range [m]  balls seen [% of time]  median warning [s]")
    for max_range in (0.25, 0.5, 1.0, 2.0):
        for name, sensor in {
            "field": FieldSensor(skin, chain, balls, max_range),
            "ray": RaySensor(skin, chain, balls, max_range, Ray(), reduce="min"),
        }.items():
            seen = sensor(states.copy())["object_detected"]
            share = 100 * seen.any(-1).float().mean()
            warning = seconds_of_warning(seen[..., 0], gap[..., 0]).median()
            print(f"{name:6s}  {max_range:9.2f}  {share:22.0f}  {warning:18.2f}")


if __name__ == "__main__":
    with clear_errors():
        main(tyro.cli(ReplayConfig))
