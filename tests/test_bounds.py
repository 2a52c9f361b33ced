"""Bounds and names: declared with a field, checked in every configuration."""

from __future__ import annotations

import dataclasses
import math
import typing
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
import pytest

from egoskin.bounds import Interval, check_bounds, path_to
from egoskin.envs.throws import ThrowConfig
from egoskin.runs.config import TrainConfig


@dataclass(frozen=True, kw_only=True)
class Example:
    share: Annotated[float, Interval(ge=0, lt=1)] = 0.5
    counts: Annotated[tuple[int, ...], Interval(ge=1, le=4096)] = (1, 2)
    reach: Annotated[float | None, Interval(gt=0, le=math.inf)] = None
    free: float = 0.0
    whole: int = 0
    flag: bool = True
    name: str = ""

    def __post_init__(self) -> None:
        check_bounds(self)


@pytest.mark.parametrize(
    "values",
    [
        {"share": 0},
        {"counts": (1, 4096)},
        {"counts": ()},
        {"reach": math.inf},
        {"free": -1e300},
        {"whole": 2**63 - 1},
    ],
)
def test_what_lies_within_is_taken(values: Any):
    Example(**values)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"share": -0.1}, "share must not be negative, got -0.1"),
        ({"share": 1.0}, "share must be below 1, got 1.0"),
        ({"counts": (3, 0)}, r"counts must be at least 1, got \(3, 0\)"),
        ({"counts": (5000,)}, r"counts must be at most 4,096, got \(5000,\)"),
        ({"reach": 0.0}, "reach must be positive, got 0.0"),
        ({"reach": math.nan}, "reach must be a finite number, got nan"),
        ({"reach": -math.inf}, "reach must be a finite number, got -inf"),
        ({"free": math.inf}, "free must be a finite number, got inf"),
        ({"share": np.float32(-1)}, "share must not be negative, got -1.0"),
        ({"counts": (np.int64(0),)}, "counts must be at least 1, got"),
        ({"whole": 10**400}, "whole must fit into 64 bits, got 1000"),
        ({"free": 10**400}, "free must fit into 64 bits, got 1000"),
    ],
)
def test_what_lies_outside_is_named(values: Any, message: str):
    with pytest.raises(ValueError, match=f"^{message}"):
        Example(**values)


def numbers(kind: type, path: str = "") -> Iterator[tuple[type, str, Any]]:
    """Each field of numbers of a configuration and of all within: class, name, type."""
    hints = typing.get_type_hints(kind)
    for name in (field.name for field in dataclasses.fields(kind)):
        hint = hints[name]
        if dataclasses.is_dataclass(hint):
            yield from numbers(hint)  # pyright: ignore[reportArgumentType]
        elif {int, float} & {hint, *typing.get_args(hint)}:
            yield kind, name, hint


@pytest.mark.parametrize(
    ("kind", "name", "hint"),
    [*numbers(TrainConfig)],
    ids=lambda x: getattr(x, "__name__", x),
)
@pytest.mark.parametrize("value", [math.nan, 10**400], ids=["nan", "huge"])
def test_each_number_of_a_training_is_checked(kind, name, hint, value):
    is_tuple = typing.get_origin(hint) is tuple
    with pytest.raises(ValueError, match=name):
        kind(**{name: (value, value) if is_tuple else value})


def choices(kind: type) -> Iterator[tuple[type, str]]:
    """Each field of names of a configuration and of all within: class, name."""
    for name, hint in typing.get_type_hints(kind).items():
        if dataclasses.is_dataclass(hint):
            yield from choices(hint)  # pyright: ignore[reportArgumentType]
        elif typing.get_origin(hint) is typing.Literal:
            yield kind, name


@pytest.mark.parametrize(
    ("kind", "name"), [*choices(TrainConfig)], ids=lambda x: getattr(x, "__name__", x)
)
def test_each_name_of_a_training_is_checked(kind, name):
    # A name that is none of them would mean the last of them.
    with pytest.raises(ValueError, match=f"^{name} must be one of .*, got 'typo'"):
        kind(**{name: "typo"})


def test_the_place_of_a_configuration_in_another_is_known():
    assert path_to(ThrowConfig, TrainConfig) == "env.task.throws."
    assert path_to(TrainConfig, TrainConfig) == ""


def test_a_group_of_fields_must_be_its_dataclass():
    for name, value in (("env", {"history": 3}), ("ppo", None)):
        message = f"{name} must be a .*Config, got {type(value).__name__}"
        with pytest.raises(ValueError, match=message):
            TrainConfig(**{name: value})
