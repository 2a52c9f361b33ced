"""Configurations as plain values: round trips, and errors that name the field."""

from __future__ import annotations

import math
import re
from typing import Any

import pytest

from egoskin.runs.config import TrainConfig
from egoskin.storage.serialization import from_plain, read_json, to_plain
from egoskin.study.manifest import Study


def test_a_configuration_comes_back(tmp_path):
    plain = to_plain(TrainConfig(run_dir=tmp_path))
    plain["env"]["sensor"]["range"] = "inf"
    plain["ppo"]["clip_epsilon"] = 1
    config = from_plain(TrainConfig, plain, "here")
    assert config.run_dir == tmp_path
    assert config.env.sensor.range == math.inf
    assert config.ppo.clip_epsilon == 1.0
    assert isinstance(config.ppo.clip_epsilon, float)
    assert to_plain(config) == plain


@pytest.mark.parametrize("value", [None, [2.0], "abc", {}])
def test_a_value_of_the_wrong_type_is_named(value: Any):
    plain = to_plain(TrainConfig())
    plain["env"]["sensor"]["range"] = value
    with pytest.raises(ValueError, match=r"my\.json: .*env\.sensor\.range"):
        from_plain(TrainConfig, plain, "my.json")
    with pytest.raises(ValueError, match=r"my\.json: .*run_dir"):
        from_plain(TrainConfig, {"run_dir": 3}, "my.json")
    with pytest.raises(ValueError, match=r"my\.json: expected an object, got list"):
        from_plain(TrainConfig, [], "my.json")


@pytest.mark.parametrize(
    "value", [None, 3, "ab", [1.0], [1.0, "x"], [[1.0, 2.0]], {}, {"low": 1.0}]
)
def test_a_range_that_is_none_is_named(value: Any):
    plain = to_plain(TrainConfig())
    plain["env"]["task"]["throws"]["interval"] = value
    with pytest.raises(ValueError, match=r"my\.json: .*env\.task\.throws\.interval"):
        from_plain(TrainConfig, plain, "my.json")


@pytest.mark.parametrize(
    ("content", "text"),
    [
        ({"standard": 2}, r'standard must be one of "2", "1", "paper", got 2'),
        ({"seeds": ["0"]}, r'seeds must be a list, each item an integer, got \["0"\]'),
        ({"seeds": "all"}, r"seeds must be a list, each item an integer$"),
        ({"cells": ["a"]}, r"cells must be a list, each item an object$"),
        (
            {"cells": {"sensor.range": 1}},
            r'cells must be a list, each item an object, got \{"sensor.range": 1\}$',
        ),
        ({"purpose": 3}, "purpose must be a string, got 3"),
        ({"frame": 1}, "there is no field 'frame', did you mean 'frames'?"),
        ({}, "name is missing"),
    ],
)
def test_the_types_of_a_study_file_are_told_in_words(content, text):
    if content:
        content = {"name": "a", "cells": [{}], "seeds": [0], "frames": 1, **content}
        content = {"purpose": "", **content}
    with pytest.raises(ValueError, match=text):
        from_plain(Study, content, "my.json")


@pytest.mark.parametrize(
    ("content", "hint"),
    [
        ({"env": {"sensor": {"signl": "binary"}}}, "'signl', did you mean 'signal'?"),
        ({"env": {"task": {"throws": {"sped": 1}}}}, "'sped', did you mean 'speed'?"),
        ({"env": {"sensr": {}}}, "'sensr', did you mean 'sensor'?"),
        # A field of other parts, but not of this.
        ({"env": {"sensor": {"history": 3}}}, "'history'"),
    ],
    ids=str,
)
def test_an_unknown_field_inside_is_compared_with_those_beside_it(content, hint):
    with pytest.raises(ValueError, match=f"there is no field {re.escape(hint)}$"):
        from_plain(TrainConfig, content, "my.json")


def test_a_range_of_whole_numbers_is_one_of_numbers():
    plain = to_plain(TrainConfig())
    plain["env"]["task"]["throws"]["interval"] = [1, 2]
    interval = from_plain(TrainConfig, plain, "here").env.task.throws.interval
    assert interval == (1.0, 2.0)
    assert all(isinstance(bound, float) for bound in interval)


def test_what_a_configuration_refuses_is_told_with_the_file():
    plain = to_plain(TrainConfig())
    plain["env"]["task"]["throws"]["interval"] = [2.0, 1.0]
    with pytest.raises(ValueError, match=r"my\.json: interval must be"):
        from_plain(TrainConfig, plain, "my.json")


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("env.task.reward.survival", math.nan),
        ("ppo.entropy_coeff", math.nan),
        ("env.sensor.range", math.nan),
        ("env.task.throws.lead", math.inf),
        ("env.task.throws.speed", [4.0, math.inf]),
        ("env.task.throws.height", [2.0, math.inf]),
        ("env.task.throws.azimuth_deg", [-math.inf, 180.0]),
        ("env.task.start_joint_noise", math.inf),
    ],
)
def test_what_is_not_finite_is_refused_wherever_it_stands(field: str, value: object):
    plain = to_plain(TrainConfig())
    *parents, name = field.split(".")
    inner = plain
    for parent in parents:
        inner = inner[parent]
    inner[name] = value
    with pytest.raises(
        ValueError, match=rf"{field} must be a finite number|range must"
    ):
        from_plain(TrainConfig, plain, "here")


def test_a_range_may_be_infinite():
    plain = to_plain(TrainConfig())
    plain["env"]["sensor"]["range"] = "inf"
    assert from_plain(TrainConfig, plain, "here").env.sensor.range == math.inf


def test_a_file_that_is_no_json_is_named(tmp_path):
    for content in (b"{", b"\xff\xfe"):
        (tmp_path / "bad.json").write_bytes(content)
        with pytest.raises(ValueError, match=r"bad\.json is not JSON"):
            read_json(tmp_path / "bad.json")
