"""Configuration of a skin and of what its sensors give, and its transforms."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from tensordict import TensorDictBase
from torchrl.envs import Transform

from egoskin.bounds import NOT_NEGATIVE, Interval, check_bounds
from egoskin.rng import offset_seed
from egoskin.robots.config import RobotConfig
from egoskin.sensors.field import FieldSensor
from egoskin.sensors.history import HoldLast
from egoskin.sensors.imperfections.corruption import Corruption
from egoskin.sensors.imperfections.presets import PRESETS
from egoskin.sensors.ray import RaySensor, SparseRays
from egoskin.sensors.signals import Binary, Localization, Proximity, SkinOrder
from egoskin.sensors.skin.coverage import Field, Ray
from egoskin.sensors.skin.placement import MAX_SENSORS, place_sensors
from egoskin.sensors.skin.skin import Skin
from egoskin.shapes import Shape

# The golden ratio's bits: seeds far apart for sensors of different kinds.
_GROUP_SEED = 0x9E3779B9


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
    """Independent points or well-spread ones; `egoskin skin` has more to choose."""

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
class LocalizationConfig:
    """How the position of a detected ball is given."""

    frame: Literal["base", "yaw", "torso"] = "base"
    """Axes and origin: the base, level axes at the base, or the torso."""
    over_range: bool = False
    """Divide the position by the range."""
    hold: bool = False
    """Keep the last position while nothing is detected."""


@dataclass(frozen=True, kw_only=True)
class SensorConfig:
    """What the sensors of the skin measure, and what the actor is given of it.

    A sensor whose skin file gives it a type or a range of its own keeps them.
    """

    coverage: Literal["field", "ray", "none", "oracle"] = "field"
    """Spherical field, grid of beams, no sensor at all (a blind robot), or no sensor
    but the truth: position and velocity of every ball, to find the task's ceiling."""
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
    per_object: bool = False
    """One signal for each ball, instead of that of the nearest."""
    validity: bool = False
    """Append to each signal whether it is one now, 1 or 0."""
    corruption: Literal["none", "time_of_flight", "capacitive", "acoustic"] = "none"
    """Ideal sensors, or a model of real ones (docs/sensor-models.md), of each beam or,
    reduced, of each sensor's closest."""
    localization: LocalizationConfig = dataclasses.field(
        default_factory=LocalizationConfig
    )
    """The position of the ball (signal=localization)."""

    def __post_init__(self) -> None:
        """Raise ValueError for a range out of bounds, or what has no effect."""
        check_bounds(self)
        if not self.uses_skin:
            ignored = {
                "reduce": self.reduce != "none",
                "occlusion": self.occlusion,
                "per_object": self.per_object,
                "validity": self.validity,
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
        if self.validity and self.signal == "binary":
            raise ValueError("a binary signal is its own validity: leave validity off")
        if self.localization.over_range and math.isinf(self.range):
            raise ValueError("localization.over_range needs a finite range")
        if self.corruption != "none" and self.signal == "localization":
            raise ValueError(
                f"corruption={self.corruption} needs a measured signal: perfect "
                "localization has no noise"
            )
        if self.localization.hold and self.per_object:
            raise ValueError("localization.hold keeps one position: no per_object")
        if self.localization != LocalizationConfig() and self.signal != "localization":
            raise ValueError(
                f"localization options need signal=localization, not {self.signal}"
            )

    @property
    def uses_skin(self) -> bool:
        """Whether the actor is given anything that the skin measures."""
        return self.coverage in ("field", "ray")

    def label(self) -> str:
        """Return what the actor is given, in a few words without spaces."""
        if not self.uses_skin:
            return {"none": "blind", "oracle": "oracle"}[self.coverage]
        return f"{self.coverage}-{self.signal}-{self.range:g}m"

    def filled(self, skin: Skin) -> Skin:
        """Return a skin whose sensors all have a coverage and a range.

        Raises:
            ValueError: If ``reduce`` would reduce nothing.
        """
        filled = skin.filled(
            self.ray if self.coverage == "ray" else self.field, self.range
        )
        if self.reduce != "none" and not any(
            isinstance(coverage, Ray) for coverage in filled.coverage
        ):
            raise ValueError(
                f"reduce={self.reduce} is for ray sensors, and the skin has none: use "
                "coverage=ray"
            )
        return filled

    def transforms(
        self,
        robot: RobotConfig,
        skin: Skin,
        objects: Sequence[Shape],
        *,
        dt: float,
        seed: int = 0,
        row_offset: int = 0,
        out_key: str = "signal",
        masked: Collection[int] = (),
    ) -> list[Transform]:
        """Return the transforms that write the signal (none without a skin).

        It holds the readings of the skin's first sensor, of its second and so on, of
        whatever kinds they are; then, if asked for, their validity.

        Args:
            robot: The robot.
            skin: The sensors.
            objects: Shapes of what is sensed.
            dt: Duration of a control step [s].
            seed: Seed of what real sensors draw.
            row_offset: Global index of the first row.
            out_key: Key of the signal.
            masked: Indices of sensors that detect nothing.
        """
        if not self.uses_skin:
            return []
        skin = self.filled(skin)
        groups = self._groups(skin)
        transforms: list[Transform] = []
        detected, signals = [], []
        for number, (suffix, index) in enumerate(groups.items()):
            part, key = skin.select(index), f"distance{suffix}"
            detected.append(f"object_detected{suffix}")
            out_keys = (key, detected[-1])
            sensor = self._sensor(robot, part, objects, out_keys)
            sensor.mask([i for i, own in enumerate(index) if own in masked])
            transforms.append(sensor)
            if self.signal == "localization":
                continue
            if self.corruption != "none":
                models = PRESETS[self.corruption]()
                moving = any(model.per_speed > 0 for model in models)
                transforms.append(
                    Corruption(
                        models,
                        dt=dt,
                        # Two groups of sensors must not fail alike.
                        seed=offset_seed(seed, number * _GROUP_SEED),
                        row_offset=row_offset,
                        in_keys=[key, "joint_vel"] if moving else [key],
                        out_keys=[f"reading{suffix}"],
                    )
                )
                key = f"reading{suffix}"
            signals.append(f"signal{suffix}" if suffix else out_key)
            transforms.append(self._signal(part, key, signals[-1]))
        if self.signal == "localization":
            transforms += self._localization(robot, detected, out_key)
        elif len(groups) > 1:
            transforms.append(
                SkinOrder(
                    list(groups.values()),
                    validity=self.validity,
                    in_keys=signals,
                    out_keys=[out_key],
                )
            )
        return transforms

    def sparse_rays(
        self,
        robot: RobotConfig,
        skin: Skin,
        objects: Sequence[Shape],
    ) -> SparseRays | None:
        """Return what gives the signal as sparse rows, or None if it is not sparse.

        Sparse are the beams of ideal rays of one grid and one range.

        Args:
            robot: The robot.
            skin: The sensors.
            objects: Shapes of what is sensed.
        """
        skin = self.filled(skin)
        dense = self.signal == "localization" or self.corruption != "none"
        dense |= self.reduce != "none" or self.per_object or self.validity
        mixed = len(set(skin.range.tolist())) > 1 or len(self._groups(skin)) > 1
        rays = self.uses_skin and isinstance(skin.coverage[0], Ray)
        if dense or mixed or not rays:
            return None

        keys = ("distance", "object_detected")
        sensor = self._sensor(robot, skin, objects, keys)
        assert isinstance(sensor, RaySensor)
        reading = self._signal(skin.select([0]), "distance", "signal")
        return SparseRays(sensor, reading)

    def _groups(self, skin: Skin) -> dict[str, list[int]]:
        """Return the sensors of each kind, by the suffix of their keys.

        One transform computes one kind; most skins have one, with no suffix.
        """
        groups = self.filled(skin).groups()
        if len(groups) == 1:
            return {"": groups[0]}
        return {f"_{i}": index for i, index in enumerate(groups)}

    def detecting(self, skin: Skin, state: TensorDictBase) -> np.ndarray:
        """Return which sensors detect something in one row, ``[S]`` bool.

        Args:
            skin: The sensors.
            state: One row of the environment's output, raw keys kept.
        """
        result = np.zeros(len(skin), dtype=bool)
        if self.uses_skin:
            for suffix, index in self._groups(skin).items():
                distance = state[f"distance{suffix}"].reshape(len(index), -1)
                result[index] = distance.isfinite().any(-1).numpy()
        return result

    def _sensor(
        self,
        robot: RobotConfig,
        skin: Skin,
        objects: Sequence[Shape],
        out_keys: Sequence[str],
    ) -> FieldSensor | RaySensor:
        """Return the coverage of some sensors of one kind."""
        common: dict[str, Any] = {
            "body": robot.primitives if self.occlusion else (),
            "per_object": self.per_object and self.signal != "localization",
            "out_keys": out_keys,
            "compile": True,
        }
        args = (skin, robot.chain, objects, self.range)
        if isinstance(skin.coverage[0], Ray):
            return RaySensor(*args, reduce=self.reduce, **common)
        return FieldSensor(*args, **common)

    def _signal(self, skin: Skin, in_key: str, out_key: str) -> Proximity | Binary:
        """Return the signal of some sensors' readings."""
        keys: dict[str, Any] = {"in_keys": [in_key], "out_keys": [out_key]}
        # A corrupted reading may be one of something beyond the range.
        ranges = skin.range.tolist()
        if self.signal == "binary":
            return Binary(ranges, **keys)
        return Proximity(
            ranges,
            closeness=self.signal == "closeness",
            validity=self.validity,
            **keys,
        )

    def _localization(
        self, robot: RobotConfig, detected: Sequence[str], out_key: str
    ) -> list[Transform]:
        """Return the position of what is detected."""
        options = self.localization
        torso = (robot.chain, "torso_link")
        position = Localization(
            scale=self.range if options.over_range else 1.0,
            slots="all" if self.per_object else "nearest",
            yaw_only=options.frame == "yaw",
            centre=torso if options.frame == "torso" else None,
            validity=self.validity,
            in_keys=["base_pose", "object_pose", "joint_pos", *detected],
            out_keys=["position" if options.hold else out_key],
        )
        if not options.hold:
            return [position]
        held = HoldLast(["position", *detected], [out_key], flags=int(self.validity))
        return [position, held]
