"""Versions of the standard throw: how balls are thrown and when an episode ends.

A version never changes: what was trained or judged on it stays comparable. A better
throw is a new version.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

from egoskin.envs.dodgeball import DodgeballConfig
from egoskin.envs.randomization import RandomizationConfig
from egoskin.envs.throws import ThrowConfig

Standard = Literal["2", "1", "paper"]
"""Name of a version: 2 is the default; 1 aims at the whole body, the first ball at the
start; ``paper`` is 2 with the first ball at the start in training, too."""
CUSTOM = "custom"
"""Name of throws and ends that are those of no version."""

# What the versions share, and what they differ in.
_SHARED = {
    "radius": 0.15,
    "num_balls": 2,
    "interval": (1.0, 2.0),
    "height": (2.0, 3.0),
    "distance": (4.0, 6.0),
    "speed": (4.0, 8.0),
    "azimuth_deg": (-180.0, 180.0),
    "lead": 1.0,
    "flight": "straight",
}
_AT_ONCE = (0.0, 0.0)
_THROWS: dict[Standard, ThrowConfig] = {
    "2": ThrowConfig(**_SHARED, aim="skin", first_delay=(0.0, 2.0)),
    "1": ThrowConfig(**_SHARED, aim="body", first_delay=_AT_ONCE),
    "paper": ThrowConfig(**_SHARED, aim="skin", first_delay=_AT_ONCE),
}
# Start and ends of an episode, of every version.
_ENDS = {
    "start_joint_noise": 0.05,
    "episode_length_s": 10.0,
    "success_s": 3.0,
    "self_contact_ends": False,
}


def training_task(version: Standard, task: DodgeballConfig) -> DodgeballConfig:
    """Return a task with the throws and ends that a version trains on.

    Args:
        version: The version.
        task: What else the task is made of.
    """
    return replace(task, throws=_THROWS[version], **_ENDS)


def evaluation_task(version: Standard, task: DodgeballConfig) -> DodgeballConfig:
    """Return a task with the throws and ends that a version judges by.

    The first ball is thrown at the start of the episode, and the robot is its model.

    Args:
        version: The version.
        task: What else the task is made of.
    """
    trained = training_task(version, task)
    return replace(
        trained,
        throws=replace(trained.throws, first_delay=_AT_ONCE),
        randomization=RandomizationConfig(),
    )


def standard_of(task: DodgeballConfig) -> str:
    """Return the version that a task trains on, `CUSTOM` if it is none."""
    for version in _THROWS:
        if task == training_task(version, task):
            return version
    return CUSTOM
