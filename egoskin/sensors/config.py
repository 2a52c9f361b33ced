"""Configuration of a skin, its sensors and their signal.

`egoskin.sensors.pipeline` builds the transforms from it.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from egoskin.bounds import NOT_NEGATIVE, Interval, check_bounds
from egoskin.robots.config import RobotConfig
from egoskin.sensors.skin.coverage import KINDS, Coverage, Field, Ray
from egoskin.sensors.skin.placement import MAX_SENSORS, place_sensors
from egoskin.sensors.skin.skin import Skin


@dataclass(frozen=True, kw_only=True)
class SkinConfig:
    """Where the sensors sit."""

    path: Path | None = None
    """Skin file; None places sensors at random on the robot's skin_links."""
    num_sensors: Annotated[int, Interval(ge=1, le=MAX_SENSORS)] = 64
    """Number of sensors to place (not with a file)."""
    seed: Annotated[int, NOT_NEGATIVE] = 0
    """Seed of the placement (not with a file)."""
    placement: Literal["area_uniform", "poisson_disk"] = "area_uniform"
    """Independent or evenly spread points; ``egoskin skin`` has more options."""

    def __post_init__(self) -> None:
        """Raise ValueError for numbers out of bounds."""
        check_bounds(self)

    def build(self, robot: RobotConfig) -> Skin:
        """Return the skin, checked against the robot.

        Raises:
            ValueError: If the file is not a skin of this robot, or a placement option
                is given together with a file.
        """
        if self.path is None:
            return place_sensors(
                robot, self.num_sensors, self.seed, method=self.placement
            )
        # Checked here and not at construction: old runs and policies must still load.
        for name in ("num_sensors", "seed", "placement"):
            if getattr(self, name) != getattr(SkinConfig, name):
                raise ValueError(
                    f"skin.{name} has no effect with skin.path: the sensors come "
                    f"from the file {self.path}"
                )
        skin = Skin.load(self.path)
        skin.check_robot(robot.name, robot.links, f"skin file {self.path}")
        return skin


@dataclass(frozen=True, kw_only=True)
class SensorConfig:
    """Measurements of the sensors and the signal that the actor observes.

    A type or range that the skin file sets for a sensor takes precedence.
    """

    coverage: Literal["field", "ray", "none", "oracle"] = "field"
    """Spherical field, grid of beams, none (a blind robot), or oracle: the true
    position and velocity of every ball instead of sensors, for comparison. None and
    oracle ignore signal and range."""
    signal: Literal["localization", "proximity", "closeness", "binary"] = "proximity"
    """localization: position of the nearest detected ball; proximity: distance / range
    (d / (d + 1 m) with range inf); closeness: 1 - proximity; binary: 1 if in range."""
    range: Annotated[float, Interval(ge=1e-3, le=math.inf)] = 2.0
    """Detection range [m], to the ball's surface; "inf" is allowed."""
    field: Field = dataclasses.field(default_factory=Field)
    """Field sensors."""
    ray: Ray = dataclasses.field(default_factory=Ray)
    """Ray sensors."""
    reduce: Literal["none", "min"] = "none"
    """Ray sensors: all beams, or each sensor's minimum (binary: any beam)."""
    occlusion: bool = False
    """Whether the robot's own body hides objects behind it."""
    corruption: Literal["none", "time_of_flight", "capacitive", "acoustic"] = "none"
    """Ideal sensors, or a model of real ones (docs/sensor-models.md), applied to each
    beam; reduce takes the minimum afterwards, as on a real robot."""
    keep_last: bool = False
    """Localization: keep the last position while nothing is detected."""

    def __post_init__(self) -> None:
        """Raise ValueError for invalid values or options without effect."""
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
        for name, kind in KINDS.items():
            if name != self.coverage and getattr(self, name) != kind():
                raise ValueError(
                    f"{name} options need coverage={name}, not {self.coverage} (types "
                    "in a skin file have their own options)"
                )
        if self.corruption != "none" and self.signal == "localization":
            raise ValueError(
                f"corruption={self.corruption} needs a measured signal: perfect "
                "localization has no noise"
            )
        if self.reduce != "none" and self.signal == "localization":
            raise ValueError(
                "reduce has no effect with signal=localization, the position of the "
                "nearest ball that any beam detects"
            )
        if self.keep_last and self.signal != "localization":
            raise ValueError(f"keep_last needs signal=localization, not {self.signal}")

    @property
    def uses_skin(self) -> bool:
        """Whether the actor observes measurements of the skin."""
        return self.coverage in KINDS

    @property
    def default_coverage(self) -> Coverage:
        """Coverage of the sensors for which the skin sets none."""
        return getattr(self, self.coverage) if self.uses_skin else self.field

    def label(self) -> str:
        """Return a short label of the actor's observation, without spaces."""
        if not self.uses_skin:
            return {"none": "blind", "oracle": "oracle"}[self.coverage]
        return f"{self.coverage}-{self.signal}-{self.range:g}m"
