"""Bounds of numbers and names, declared in the type of a configuration field.

    mass: Annotated[float, Interval(gt=0, le=1e6)] = 0.4

Contract: every number of a checked configuration lies in the interval of its field;
this includes each number of a tuple. Numbers without an interval are finite, and
integers fit into 64 bits. A name is one of the literals of its field.
"""

from __future__ import annotations

import dataclasses
import functools
import math
import sys
import typing
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from numbers import Integral, Real
from typing import Any


@dataclass(frozen=True, kw_only=True)
class Interval:
    """An interval of numbers; it contains infinity only with ``le=inf``."""

    gt: float | None = None
    """Numbers are above this."""
    ge: float | None = None
    """Numbers are at least this."""
    lt: float | None = None
    """Numbers are below this."""
    le: float | None = None
    """Numbers are at most this."""

    def violation(self, value: float) -> str | None:
        """Return the violated condition as text, or None for a number inside."""
        if isinstance(value, Integral):
            # Not converted: an int of 400 digits does not fit into a float.
            if not -(2**63) <= value < 2**63:
                return "fit into 64 bits"
        elif math.isnan(value) or (math.isinf(value) and self.le != value):
            return "be a finite number"
        if self.gt is not None and not value > self.gt:
            return f"be above {self.gt:,}" if self.gt else "be positive"
        if self.ge is not None and not value >= self.ge:
            return f"be at least {self.ge:,}" if self.ge else "not be negative"
        if self.lt is not None and not value < self.lt:
            return f"be below {self.lt:,}"
        if self.le is not None and not value <= self.le:
            return f"be at most {self.le:,}"
        return None


def is_number(value: object) -> bool:
    """Whether a value of a file is a finite number.

    Python's JSON allows NaN and 10^400, TOML integers of any size.
    """
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return False
    return abs(value) <= sys.float_info.max


POSITIVE, NOT_NEGATIVE = Interval(gt=0), Interval(ge=0)
COUNT, SHARE = Interval(ge=1), Interval(ge=0, le=1)


class BoundsError(ValueError):
    """A number of a configuration is out of bounds, or a name is unknown.

    Args:
        owner: Class of the configuration.
        text: Name of the field, the condition and the actual value.
    """

    def __init__(self, owner: type, text: str) -> None:
        super().__init__(text)
        self.owner = owner


def check_bounds(config: Any) -> None:
    """Raise BoundsError if a number of a dataclass is out of bounds, or a name unknown.

    Numbers are checked against the `Interval` of their field, names against its
    literals. Nested dataclasses must be such; they check their own fields.

    Args:
        config: The dataclass; it calls this first in its ``__post_init__``.
    """
    for name, interval in _intervals(type(config)).items():
        value = getattr(config, name)
        for number in value if isinstance(value, tuple) else (value,):
            if not isinstance(number, Real) or isinstance(number, bool):
                continue
            # NumPy's numbers are Real too, but no float by their type.
            if wrong := interval.violation(number):  # pyright: ignore
                raise BoundsError(type(config), f"{name} must {wrong}, got {value}")
    for name, choices in _choices(type(config)).items():
        value = getattr(config, name)
        if value not in choices:
            text = f"{name} must be one of {', '.join(choices)}, got {value!r}"
            raise BoundsError(type(config), text)
    for field in dataclasses.fields(config):
        value, kind = getattr(config, field.name), field.default_factory
        if dataclasses.is_dataclass(kind) and not isinstance(value, kind):
            text = f"{field.name} must be a {kind.__name__}, got {type(value).__name__}"
            raise BoundsError(type(config), text)


def check_ranges(config: Any, other: Collection[str] = ()) -> None:
    """Raise ValueError if a range of a dataclass is not (low, high), low <= high.

    Args:
        config: The dataclass; its tuples are ranges, except for those named in
            ``other``.
        other: Names of other tuples.
    """
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        is_range = isinstance(value, tuple) and field.name not in other
        if is_range and not value[0] <= value[1]:
            raise ValueError(
                f"{field.name} must be (low, high) with low <= high, got {value}"
            )


@functools.cache
def _intervals(kind: type) -> Mapping[str, Interval]:
    """Return the interval of each field of a dataclass."""
    hints = typing.get_type_hints(kind, include_extras=True)
    found = {}
    for field in dataclasses.fields(kind):
        declared = getattr(hints[field.name], "__metadata__", ())
        own = [what for what in declared if isinstance(what, Interval)]
        found[field.name] = own[0] if own else Interval()
    return found


@functools.cache
def _choices(kind: type) -> Mapping[str, tuple[str, ...]]:
    """Return the literals of each field of a dataclass that has some."""
    hints = typing.get_type_hints(kind)
    return {
        field.name: typing.get_args(hints[field.name])
        for field in dataclasses.fields(kind)
        if typing.get_origin(hints[field.name]) is typing.Literal
    }


def path_to(owner: type, kind: type) -> str:
    """Return the path of a nested configuration ("env.task."), or "" if not nested.

    Args:
        owner: Class of the inner configuration, which occurs once.
        kind: Class of the outer configuration.
    """
    for name, hint in typing.get_type_hints(kind).items():
        if hint is owner:
            return f"{name}."
        if isinstance(hint, type) and dataclasses.is_dataclass(hint):
            inner = path_to(owner, hint)
            if inner:
                return f"{name}.{inner}"
    return ""
