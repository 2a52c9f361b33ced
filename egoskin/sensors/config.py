"""Configuration of a skin and of what its sensors give.

`egoskin.sensors.pipeline` makes transforms of it.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from egoskin.bounds import NOT_NEGATIVE, Interval, check_bounds
from egoskin.robots.config import RobotConfig
from egoskin.sensors.skin.coverage import Coverage, Field, Ray
from egoskin.sensors.skin.placement import MAX_SENSORS, place_sensors
from egoskin.sensors.skin.skin import Skin


@dataclass(frozen=True, kw_only=True)
class SkinConfig:
    """Where the sensors sit."""

    path: Path | None = None
    """Skin file; None places sensors at random on the upper body."""
    num_sensors: Annotated[int, Interval(ge=1, le=MAX_SENSORS)] = 64
    """Number of sensors to place (none with a file)."""
    seed: Annotated[int, NOT_NEGATIVE] = 0
    """Seed of the placement (none with a file)."""
    placement: Literal["area_uniform", "poisson_disk"] = "area_uniform"
    """Independent points or well-spread ones; ``egoskin skin`` has more to choose."""

    def __post_init__(self) -> None:
        """Raise ValueError for numbers out of bounds."""
        check_bounds(self)

    def build(self, robot: RobotConfig) -> Skin:
        """Return the skin, checked against the robot.

        Raises:
            ValueError: If the file is no skin of this robot, or there is one and an
                option of placing sensors, too.
        """
        if self.path is None:
            return place_sensors(
                robot, self.num_sensors, self.seed, method=self.placement
            )
        # Here, not at construction: runs and policies of before are still read.
        for name in ("num_sensors", "seed", "placement"):
            if getattr(self, name) != getattr(SkinConfig, name):
                raise ValueError(
                    f"skin.{name} has no effect beside skin.path: the sensors are "
                    f"those of the file {self.path}"
                )
        skin = Skin.load(self.path)
        # Robots of one maker name their links alike.
        if skin.robot != robot.name:
            raise ValueError(
                f"skin file {self.path}: made for the robot {skin.robot!r}, not "
                f"{robot.name!r}; if it fits, change its field 'robot'"
            )
        try:
            skin.check_links(robot.links)
        except ValueError as error:
            raise ValueError(f"skin file {self.path}: {error}") from error
        return skin


@dataclass(frozen=True, kw_only=True)
class SensorConfig:
    """What the sensors of the skin measure, and what the actor observes of it.

    A sensor whose skin file gives it a type or a range of its own keeps them.
    """

    coverage: Literal["field", "ray", "none", "oracle"] = "field"
    """Spherical field, grid of beams, no sensor at all (a blind robot), or no sensor
    but the truth: position and velocity of every ball, the most that could be told."""
    signal: Literal["localization", "proximity", "closeness", "binary"] = "proximity"
    """Ball position if any sensor detects it; distance / range; 1 - that; in range?"""
    range: Annotated[float, Interval(ge=1e-3, le=math.inf)] = 2.0
    """Detection range [m], to the ball's surface; "inf" is allowed."""
    field: Field = dataclasses.field(default_factory=Field)
    """Field sensors."""
    ray: Ray = dataclasses.field(default_factory=Ray)
    """Ray sensors."""
    reduce: Literal["none", "min"] = "none"
    """Ray sensors: all beams, or the closest of each sensor's (binary: any beam)."""
    occlusion: bool = False
    """Whether the robot's own body hides what lies behind it."""
    corruption: Literal["none", "time_of_flight", "capacitive", "acoustic"] = "none"
    """Ideal sensors, or a model of real ones (docs/sensor-models.md), of each beam or,
    reduced, of each sensor's closest."""
    keep_last: bool = False
    """Localization: keep the last position while nothing is detected."""

    def __post_init__(self) -> None:
        """Raise ValueError for a range out of bounds, or what has no effect."""
        check_bounds(self)
        if not self.uses_skin:
            ignored = {
                "reduce": self.reduce != "none",
                "occlusion": self.occlusion,
                "corruption": self.corruption != "none",
                "signal=localization": self.signal == "localization",
            }
            for name, given in ignored.items():
                if given:
                    raise ValueError(
                        f"{name} has no effect with coverage={self.coverage}, which "
                        "has no skin"
                    )
        for name, default in (("field", Field()), ("ray", Ray())):
            if name != self.coverage and getattr(self, name) != default:
                raise ValueError(
                    f"{name} options need coverage={name}, not {self.coverage} (types "
                    "of a skin file have options of their own)"
                )
        if self.corruption != "none" and self.signal == "localization":
            raise ValueError(
                f"corruption={self.corruption} needs a measured signal: perfect "
                "localization has no noise"
            )
        if self.keep_last and self.signal != "localization":
            raise ValueError(f"keep_last needs signal=localization, not {self.signal}")

    @property
    def uses_skin(self) -> bool:
        """Whether the actor observes anything that the skin measures."""
        return self.coverage in ("field", "ray")

    @property
    def default_coverage(self) -> Coverage:
        """Coverage of the sensors that have none of their own."""
        return self.ray if self.coverage == "ray" else self.field

    def label(self) -> str:
        """Return what the actor observes, in a few words without spaces."""
        if not self.uses_skin:
            return {"none": "blind", "oracle": "oracle"}[self.coverage]
        return f"{self.coverage}-{self.signal}-{self.range:g}m"
