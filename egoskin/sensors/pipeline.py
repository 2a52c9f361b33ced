"""Build the transforms from a skin and a configuration to the signal.

Contract: a `SensorPipeline` resolves the skin once. All other code takes the coverage,
range and group of a sensor from it.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from tensordict import TensorDictBase
from torchrl.envs import Transform

from egoskin.hints import matching
from egoskin.rng import offset_seed
from egoskin.robots.config import RobotConfig
from egoskin.sensors.config import SensorConfig
from egoskin.sensors.field import FieldSensor
from egoskin.sensors.history import KeepLast
from egoskin.sensors.imperfections.corruption import Corruption
from egoskin.sensors.imperfections.presets import PRESETS
from egoskin.sensors.ray import RaySensor, SparseRays
from egoskin.sensors.signals import (
    BeamMinimum,
    Binary,
    Localization,
    Proximity,
    SkinOrder,
)
from egoskin.sensors.skin.coverage import Ray
from egoskin.sensors.skin.skin import Skin
from egoskin.shapes import Shape

READINGS: dict[str, Callable[..., Proximity | Binary]] = {
    "proximity": Proximity,
    "closeness": partial(Proximity, closeness=True),
    "binary": Binary,
}
"""Transforms of the signals of one number for each measurement, by their names."""
MASK_ALL = ("all",)
"""Mask of all sensors, or of the whole observation of an oracle."""

# Bits of the golden ratio: the seeds of different groups are far apart.
_GROUP_SEED = 0x9E3779B9


def masks_all(mask: Sequence[str]) -> bool:
    """Whether a mask is the mask of all sensors."""
    return tuple(mask) == MASK_ALL


@dataclass(frozen=True, kw_only=True, eq=False)
class SensorGroup:
    """Sensors of one kind, computed by one transform."""

    suffix: str
    """Suffix of the group's keys, as in ``distance{suffix}``; "" for a single group."""
    index: list[int]
    """Indices of the group's sensors in the skin."""
    skin: Skin
    """Resolved skin with the group's sensors only."""

    @property
    def is_ray(self) -> bool:
        """Whether the sensors are ray sensors."""
        return isinstance(self.skin.coverage[0], Ray)


class SensorPipeline:
    """The sensors of a robot's skin, their measurements and their signal.

    For skins with several kinds of sensors also in a project of your own, where
    ``Compose(*SensorPipeline(config, robot, skin).transforms(objects, dt=dt))`` takes
    the place of a single sensor and its signal.

    Args:
        config: Measurements and signal.
        robot: The robot.
        skin: The sensors; a missing coverage or range is taken from the configuration.

    Raises:
        ValueError: If the configuration does not fit the skin.
    """

    def __init__(self, config: SensorConfig, robot: RobotConfig, skin: Skin) -> None:
        self.config, self.robot = config, robot
        self.skin = skin.resolved(config.default_coverage, config.range)
        """The sensors, each with a coverage and a range."""
        groups = self.skin.groups() if config.uses_skin else []
        self.groups = [
            SensorGroup(
                suffix=f"_{i}" if len(groups) > 1 else "",
                index=index,
                skin=self.skin.select(index),
            )
            for i, index in enumerate(groups)
        ]
        """The sensors grouped by kind; empty if no skin is used."""
        if config.reduce != "none" and not any(g.is_ray for g in self.groups):
            raise ValueError(
                f"reduce={config.reduce} is for ray sensors, and the skin has none: "
                "use coverage=ray"
            )

    def num_readings(self, group: SensorGroup) -> int:
        """Return the number of readings per sensor of a group, ``K`` or 1."""
        coverage = group.skin.coverage[0]
        if isinstance(coverage, Ray) and self.config.reduce == "none":
            return coverage.num_beams
        return 1

    @property
    def signal_size(self) -> int:
        """Size of the signal of one row; 0 without a skin."""
        if self.config.signal == "localization":
            return 3
        return sum(len(g.index) * self.num_readings(g) for g in self.groups)

    # --- masks ------------------------------------------------------------------

    def check_mask(self, mask: Sequence[str]) -> None:
        """Raise ValueError if a mask, or part of it, has no effect.

        The text lists the valid links.

        Args:
            mask: Links whose sensors detect nothing, by name or shell pattern, or
                `MASK_ALL`.
        """
        if not mask:
            return
        if self.config.coverage == "none":
            raise ValueError("a blind robot has no sensors to mask")
        if masks_all(mask):
            return
        if not self.groups:
            raise ValueError(
                "an oracle has no sensors on links: its mask must be 'all'"
            )
        self.masked(mask)

    def masked(self, mask: Sequence[str]) -> list[int]:
        """Return the indices of the masked sensors.

        Args:
            mask: Links, by name or shell pattern, or `MASK_ALL`.

        Raises:
            ValueError: If a pattern matches no link with sensors.
        """
        if masks_all(mask):
            return list(range(len(self.skin)))
        links = sorted(set(self.skin.links))
        wanted = matching(mask, links, "sensor on", "links with sensors")
        return [i for i, name in enumerate(self.skin.links) if name in wanted]

    def mask(self, transforms: Iterable[Transform], masked: Collection[int]) -> None:
        """Mask sensors in the result of `transforms`; replaces the previous mask.

        Args:
            transforms: The result of `transforms`, also among others.
            masked: Indices of sensors that detect nothing.
        """
        transforms = list(transforms)
        for kind in ((FieldSensor, RaySensor), Corruption):
            own = [t for t in transforms if isinstance(t, kind)]
            # One for each group; without corruption there is no second kind.
            for group, transform in zip(self.groups, own, strict=False):
                transform.mask([i for i, s in enumerate(group.index) if s in masked])

    # --- transforms -------------------------------------------------------------

    def sensors(self, objects: Sequence[Shape]) -> list[FieldSensor | RaySensor]:
        """Return the transforms that compute the measurements, one per group.

        With corruption they measure all beams, also if the signal is each sensor's
        minimum.

        Args:
            objects: Shapes of the objects.
        """
        sensors: list[FieldSensor | RaySensor] = []
        for group in self.groups:
            args = (group.skin, self.robot.chain, objects)
            keys = ("distance", "object_detected")
            common: dict[str, Any] = {
                "body": self.robot.primitives if self.config.occlusion else (),
                "out_keys": [f"{key}{group.suffix}" for key in keys],
                "compile": True,
            }
            if group.is_ray:
                # The beams of a real sensor have their own errors.
                real = self.config.corruption != "none"
                reduce = "none" if real else self.config.reduce
                sensors.append(RaySensor(*args, reduce=reduce, **common))
            else:
                sensors.append(FieldSensor(*args, **common))
        return sensors

    def transforms(
        self,
        objects: Sequence[Shape],
        *,
        dt: float,
        seed: int = 0,
        row_offset: int = 0,
        out_key: str = "signal",
    ) -> list[Transform]:
        """Return the transforms that write the signal (none without a skin).

        The readings in the signal are in the order of the sensors in the skin, also if
        the skin has several kinds of sensors.

        They read ``base_pose``, ``joint_pos``, ``object_pose`` and ``object_active``
        (as `FieldSensor`) and, with corruption that depends on it, ``joint_vel``. They
        write ``signal [*B, signal_size]`` and, each with the suffix ``_i`` of the i-th
        kind if there are several, ``distance``, ``object_detected`` and, if configured,
        ``reading`` (with its state, see `Corruption`) and ``least``; with several kinds
        also ``signal_i``, and ``position`` with ``keep_last``.

        Args:
            objects: Shapes of the objects.
            dt: Duration of a control step [s].
            seed: Seed of the sensor models (`SensorConfig.corruption`), in [0, 2**32),
                or the result of `egoskin.rng.held_out`.
            row_offset: Global index of the first row.
            out_key: Key of the signal.
        """
        if not self.groups:
            return []
        config = self.config
        transforms: list[Transform] = [*self.sensors(objects)]
        suffixes = [group.suffix for group in self.groups]
        if config.signal == "localization":
            detected = [f"object_detected{suffix}" for suffix in suffixes]
            position = "position" if config.keep_last else out_key
            keys = ["base_pose", "object_pose", "joint_pos", *detected]
            transforms.append(Localization(keys, [position]))
            if config.keep_last:
                transforms.append(KeepLast([position, *detected], [out_key]))
            return transforms
        signals = [f"signal{suffix}" if suffix else out_key for suffix in suffixes]
        readings = [f"distance{suffix}" for suffix in suffixes]
        if config.corruption != "none":
            models = PRESETS[config.corruption]()
            joints = ["joint_vel"] if any(m.per_speed > 0 for m in models) else []
            distances, readings = readings, [f"reading{suffix}" for suffix in suffixes]
            transforms += [
                Corruption(
                    models,
                    dt=dt,
                    # The errors of two groups must be independent.
                    seed=offset_seed(seed, number * _GROUP_SEED),
                    row_offset=row_offset,
                    in_keys=[distance, *joints],
                    out_keys=[reading],
                )
                for number, (distance, reading) in enumerate(
                    zip(distances, readings, strict=True)
                )
            ]
            if config.reduce == "min":
                for i, group in enumerate(self.groups):
                    if group.is_ray:
                        least = f"least{group.suffix}"
                        transforms.append(BeamMinimum([readings[i]], [least]))
                        readings[i] = least
        skins = [group.skin for group in self.groups]
        transforms += map(self._signal, skins, readings, signals)
        if len(signals) > 1:
            transforms.append(
                SkinOrder(
                    [group.index for group in self.groups],
                    [self.num_readings(group) for group in self.groups],
                    in_keys=signals,
                    out_keys=[out_key],
                )
            )
        return transforms

    def sparse_rays(self, objects: Sequence[Shape]) -> SparseRays | None:
        """Return the function that computes the signal as sparse rows, or None.

        It is available for the full grids of ideal ray sensors that all have the same
        grid and the same range.

        Args:
            objects: Shapes of the objects.
        """
        config = self.config
        measured = config.signal in READINGS and config.corruption == "none"
        grid = config.reduce == "none" and len(self.groups) == 1
        one_range = len(set(self.skin.range.tolist())) == 1
        if not (measured and grid and one_range and self.groups[0].is_ray):
            return None
        (sensor,) = self.sensors(objects)
        assert isinstance(sensor, RaySensor)
        reading = self._signal(self.skin.select([0]), "distance", "signal")
        return SparseRays(sensor, reading)

    def detecting(self, state: TensorDictBase) -> np.ndarray:
        """Return which sensors detect something in one row, ``[S]`` bool.

        Args:
            state: One row of the environment's output, including ``distance``.
        """
        result = np.zeros(len(self.skin), dtype=bool)
        for group in self.groups:
            distance = state[f"distance{group.suffix}"].reshape(len(group.index), -1)
            result[group.index] = distance.isfinite().any(-1).numpy()
        return result

    def _signal(self, skin: Skin, in_key: str, out_key: str) -> Proximity | Binary:
        """Return the transform from readings of some sensors to their signal."""
        # A corrupted reading can lie beyond the range.
        ranges = skin.range.tolist()
        make = READINGS[self.config.signal]
        return make(ranges, in_keys=[in_key], out_keys=[out_key])
