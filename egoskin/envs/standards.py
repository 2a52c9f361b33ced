"""Versions of the standard throw: how balls are thrown and when an episode ends.

A version never changes, so policies trained or evaluated on it stay comparable. An
improved throw gets a new version.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

from egoskin.envs.dodgeball import DodgeballConfig
from egoskin.envs.randomization import RandomizationConfig
from egoskin.envs.throws import ThrowConfig

Standard = Literal["2", "1", "paper"]
"""Name of a version: 2 is the default; ``paper`` is 2 with the first ball at the start
in training, too, as in the paper (docs/paper.md lists what it leaves open); 1 is
``paper`` aimed at the whole body."""
CUSTOM = "custom"
"""Name of a task that matches no version."""

# Settings shared by all versions, followed by those that differ.
_SHARED = {
    "shape": "sphere",
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
# Start and ends of an episode, the same in every version.
_ENDS = {
    "start_joint_noise": 0.05,
    "episode_length_s": 10.0,
    "success_s": 3.0,
    "self_contact_ends": False,
}


def training_task(version: Standard, task: DodgeballConfig) -> DodgeballConfig:
    """Return a task with the throws and episode ends of a version in training.

    Args:
        version: The version.
        task: Task that provides all other settings.
    """
    return replace(task, throws=_THROWS[version], **_ENDS)


def evaluation_task(version: Standard, task: DodgeballConfig) -> DodgeballConfig:
    """Return a task with the throws and episode ends of a version in evaluation.

    The first ball is thrown at the start of the episode; nothing is randomised.

    Args:
        version: The version.
        task: Task that provides all other settings.
    """
    trained = training_task(version, task)
    return replace(
        trained,
        throws=replace(trained.throws, first_delay=_AT_ONCE),
        randomization=RandomizationConfig(),
    )


def standard_of(task: DodgeballConfig) -> str:
    """Return the version whose training task this is, or `CUSTOM` if there is none."""
    for version in _THROWS:
        if task == training_task(version, task):
            return version
    return CUSTOM
