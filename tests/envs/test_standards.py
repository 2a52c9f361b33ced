"""Versions of the standard throw: frozen, recognised, and version 2 is the default."""

from __future__ import annotations

import dataclasses
from dataclasses import replace
from typing import get_args

import pytest
import torch

from egoskin.envs.dodgeball import DodgeballConfig
from egoskin.envs.physics import PhysicsConfig
from egoskin.envs.rewards import RewardConfig
from egoskin.envs.standards import (
    CUSTOM,
    Standard,
    evaluation_task,
    standard_of,
    training_task,
)
from egoskin.envs.throws import ThrowConfig, Thrower
from egoskin.make import EnvConfig
from egoskin.robots.builtin import H1_2

# All values are repeated here: a standard never changes; a better one is a new version.
SHARED = {
    "shape": "sphere",
    "radius": 0.15,
    "size": (),
    "num_balls": 2,
    "interval": (1.0, 2.0),
    "height": (2.0, 3.0),
    "distance": (4.0, 6.0),
    "speed": (4.0, 8.0),
    "azimuth_deg": (-180.0, 180.0),
    "box_half_width": 0.45,
    "box_height": (0.3, 1.8),
    "lead": 1.0,
    "flight": "straight",
}
THROWS = {
    "2": {**SHARED, "aim": "skin", "first_delay": (0.0, 2.0)},
    "1": {**SHARED, "aim": "body", "first_delay": (0.0, 0.0)},
    "paper": {**SHARED, "aim": "skin", "first_delay": (0.0, 0.0)},
}
ENDS = {
    "start_joint_noise": 0.05,
    "episode_length_s": 10.0,
    "success_s": 3.0,
    "self_contact_ends": False,
}
VERSIONS = list(THROWS)


def test_these_are_all_versions():
    assert set(get_args(Standard)) == set(VERSIONS)


@pytest.mark.parametrize("version", VERSIONS)
def test_a_version_never_changes(version):
    task = training_task(version, DodgeballConfig())
    assert dataclasses.asdict(task.throws) == THROWS[version]
    assert {name: getattr(task, name) for name in ENDS} == ENDS
    assert standard_of(task) == version


def test_the_throws_of_version_2_never_change():
    # The first throws of three rows with seed 0, at the standing H1-2: position [m] and
    # velocity [m/s].
    throws = [
        [(-5.9488, 0.3115, 2.2012), (7.2496, -0.0755, -1.4212)],
        [(-1.4918, 4.5346, 2.7447), (2.1704, -6.6584, -2.3826)],
        [(3.2464, 3.1262, 2.3862), (-3.9907, -3.4984, -1.5190)],
    ]
    thrower = Thrower(DodgeballConfig().throws, H1_2, PhysicsConfig().timestep)
    row = torch.arange(3)
    release = thrower.release_at_standing_robot(thrower.draw(0, row, 0 * row, 0 * row))
    found = torch.stack((release.position, release.velocity), 1)
    torch.testing.assert_close(found, torch.tensor(throws), atol=2e-4, rtol=0)


@pytest.mark.parametrize("version", VERSIONS)
def test_it_is_judged_with_the_first_ball_at_the_start(version):
    task = evaluation_task(version, DodgeballConfig())
    expected = {**THROWS[version], "first_delay": (0.0, 0.0)}
    assert dataclasses.asdict(task.throws) == expected
    assert {name: getattr(task, name) for name in ENDS} == ENDS


def test_the_defaults_are_version_2():
    assert DodgeballConfig() == training_task("2", DodgeballConfig())
    assert EnvConfig().standard == "2"


def test_a_version_leaves_the_rest_of_a_task_alone():
    # The robot's control and rewards are not part of any standard.
    own = DodgeballConfig(
        physics=PhysicsConfig(substeps=8),
        reward=RewardConfig(energy=-1.0),
        action_scale=0.5,
        # What it replaces.
        throws=ThrowConfig(lead=0.0, speed=(1.0, 2.0)),
        start_joint_noise=0.5,
        success_s=1.0,
        self_contact_ends=True,
    )
    for make in (training_task, evaluation_task):
        task = make("1", own)
        for name in ("physics", "reward", "action_scale"):
            assert getattr(task, name) == getattr(own, name), name
        assert task.throws == make("1", DodgeballConfig()).throws
        assert {name: getattr(task, name) for name in ENDS} == ENDS
    assert standard_of(training_task("1", own)) == "1"


OTHER_THROWS = {
    "radius": 0.14,
    "num_balls": 3,
    "first_delay": (0.0, 1.0),
    "interval": (1.0, 1.9),
    "height": (2.0, 2.9),
    "distance": (4.0, 5.9),
    "speed": (4.0, 8.1),
    "azimuth_deg": (-180.0, 179.0),
    "lead": 0.9,
    "flight": "ballistic",
    "aim": "box",
}
# They have no effect, or are not valid, without another option.
TOGETHER = {"box_half_width", "box_height", "shape", "size"}
OTHER_ENDS = {
    "start_joint_noise": 0.04,
    "episode_length_s": 9.0,
    "success_s": 2.0,
    "self_contact_ends": True,
}


@pytest.mark.parametrize("version", VERSIONS)
@pytest.mark.parametrize("name", OTHER_THROWS)
def test_another_throw_is_custom(version, name):
    task = training_task(version, DodgeballConfig())
    throws = replace(task.throws, **{name: OTHER_THROWS[name]})
    assert standard_of(replace(task, throws=throws)) == CUSTOM == "custom"


@pytest.mark.parametrize("version", VERSIONS)
def test_other_objects_than_spheres_are_custom(version):
    task = training_task(version, DodgeballConfig())
    throws = replace(task.throws, shape="ellipsoid", size=(0.15, 0.15, 0.15))
    assert standard_of(replace(task, throws=throws)) == "custom"
    assert training_task(version, replace(task, throws=throws)) == task


@pytest.mark.parametrize("version", VERSIONS)
@pytest.mark.parametrize("name", OTHER_ENDS)
def test_another_start_or_end_is_custom(version, name):
    task = training_task(version, DodgeballConfig())
    assert standard_of(replace(task, **{name: OTHER_ENDS[name]})) == "custom"


def test_no_field_of_the_throws_is_forgotten_here():
    fields = {field.name for field in dataclasses.fields(ThrowConfig)}
    assert fields == SHARED.keys() | {"aim", "first_delay"}
    assert fields - TOGETHER == OTHER_THROWS.keys()
