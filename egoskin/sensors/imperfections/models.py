"""Models of sensor imperfections, one dataclass each, applied by `Corruption`.

Parameters are in metres, seconds, Hz and radians; ``std`` is a standard deviation.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Literal

import torch
from torch import Tensor

from egoskin.bounds import NOT_NEGATIVE, POSITIVE, SHARE, Interval
from egoskin.rng import halfwords, standard_normal
from egoskin.sensors.imperfections.corruption import (
    FrameModel,
    Moment,
    Places,
    PointModel,
    State,
    find,
    put,
)

# Ticks per period of a sampling clock; phases and rates are whole ticks.
_TICKS = 1 << 16

_NotNegative = Annotated[float, NOT_NEGATIVE]
_Positive = Annotated[float, POSITIVE]
_Probability = Annotated[float, SHARE]


def _hide(distance: Tensor, half: Tensor, probability: Tensor | float) -> Tensor:
    """Return the distances, each infinite with a probability, from 16-bit numbers."""
    return distance.masked_fill((half + 0.5) * 2.0**-16 < probability, torch.inf)


@dataclass(frozen=True, kw_only=True)
class Bias(PointModel):
    """Calibration error per sensor: d becomes d + offset + gain d."""

    offset: float = 0.0
    """Mean offset over all sensors [m]."""
    offset_std: _NotNegative = 0.0
    """Standard deviation of the offset from sensor to sensor [m]."""
    gain: float = 0.0
    """Mean gain error over all sensors [1]."""
    gain_std: _NotNegative = 0.0
    """Standard deviation of the gain error from sensor to sensor [1]."""

    def change(self, distance: Tensor, places: Places, moment: Moment) -> Tensor:
        """Return the distances with the errors of their sensors [m], ``[n]``."""

        def error(mean: float, std: float, purpose: int) -> Tensor | float:
            if not std:
                return mean
            half = places.draw_trait(moment, purpose)
            return mean + std * standard_normal(half, distance.dtype)

        offset = error(self.offset, self.offset_std, 0)
        gain = error(self.gain, self.gain_std, 1)
        return distance + offset + gain * distance


@dataclass(frozen=True, kw_only=True)
class _Spread:
    """A standard deviation that depends on the distance d.

    It is the maximum of constant, linear x d and quadratic x d squared. A capacitive
    sensor has d = alpha / C, so constant noise of C gives noise quadratic in d.
    """

    constant: _NotNegative = 0.0
    """[m]"""
    linear: _NotNegative = 0.0
    """[1]"""
    quadratic: _NotNegative = 0.0
    """[1/m]"""

    def std(self, distance: Tensor) -> Tensor:
        """Return the standard deviation at some distances [m]."""
        far = (self.linear * distance).maximum(self.quadratic * distance * distance)
        return far.clamp(min=self.constant)


@dataclass(frozen=True, kw_only=True)
class Noise(_Spread, PointModel):
    """Gaussian noise, drawn anew for every reading; may depend on d (`_Spread`)."""

    per_speed: _NotNegative = 0.0
    """Ego noise: relative increase with the speed of the fastest joint [s/rad]."""
    common: bool = False
    """Whether all sensors of a robot share one draw (hum, power supply)."""

    def change(self, distance: Tensor, places: Places, moment: Moment) -> Tensor:
        """Return the distances with noise [m], ``[n]``."""
        draw = places.draw_common if self.common else places.draw
        half = draw(moment)
        noise = self.std(distance) * standard_normal(half, distance.dtype)
        if self.per_speed:
            speed = moment.speed.to(distance.dtype).take(places.row)
            noise *= 1 + self.per_speed * speed
        return distance + noise


@dataclass(frozen=True, kw_only=True)
class Drift(_Spread, FrameModel):
    """A baseline error that is a random walk from 0, with a step before each reading.

    The standard deviation after t seconds is sqrt(t) times the given one, which may
    depend on the distance (`_Spread`). All beams of a sensor share one walk.
    """

    def start(self, reading: Tensor, moment: Moment) -> State:
        """Return the initial walk, zeros ``[B, S]``."""
        return {"walk": torch.zeros_like(reading[:, :, 0])}

    def apply(
        self, reading: Tensor, state: State, moment: Moment
    ) -> tuple[Tensor, State]:
        """Return the readings with the walk after one more step."""
        rows, sensors = reading.shape[:2]
        # Steps of equal size with random sign; their sum soon is nearly Gaussian. One
        # call of the generator gives 128 random bits.
        calls = -(-sensors // 128)
        half = halfwords(
            moment.words(
                torch.arange(rows, device=reading.device).repeat_interleave(calls),
                torch.arange(calls, device=reading.device).repeat(rows),
            )
        ).to(torch.int32)
        half = half.reshape(rows, 8 * calls)[:, : -(-sensors // 16), None]
        coin = (half >> torch.arange(16, dtype=half.dtype, device=half.device)) & 1
        coin = coin.flatten(1)[:, :sensors].to(reading.dtype)
        walk = state["walk"] + math.sqrt(moment.dt) * (2 * coin - 1)
        distance, places = find(reading)
        drift = self.std(distance) * walk.take(
            places.row * walk.shape[1] + places.sensor
        )
        return put(reading, places, distance + drift), {"walk": walk}


@dataclass(frozen=True, kw_only=True)
class Dropout(PointModel):
    """Readings that randomly detect nothing, drawn independently for each reading."""

    probability: _Probability = 0.0
    """Probability at distance 0 and at rest."""
    per_metre: _NotNegative = 0.0
    """Increase with the distance [1/m]."""
    per_speed: _NotNegative = 0.0
    """Increase with the speed of the fastest joint [s/rad]."""

    def change(self, distance: Tensor, places: Places, moment: Moment) -> Tensor:
        """Return the distances, infinite where dropped [m], ``[n]``."""
        chance = self.probability + self.per_metre * distance
        if self.per_speed:
            speed = moment.speed.to(distance.dtype).take(places.row)
            chance += self.per_speed * speed
            # A speed of NaN gives a reading of NaN: 0 NaN = NaN.
            distance = distance + 0.0 * speed
        return _hide(distance, places.draw(moment), chance)


@dataclass(frozen=True, kw_only=True)
class DeadSensors(PointModel):
    """Sensors that never detect anything."""

    probability: _Probability
    """Probability that a sensor is dead."""

    def change(self, distance: Tensor, places: Places, moment: Moment) -> Tensor:
        """Return the distances, infinite where the sensor is dead [m], ``[n]``."""
        return _hide(distance, places.draw_trait(moment), self.probability)


@dataclass(frozen=True, kw_only=True)
class FalsePositives(FrameModel):
    """False detections, uniformly distributed over distance."""

    probability: _Probability
    """Probability of a false detection in a reading that detects nothing."""
    max_range: _Positive
    """False distances are uniform from 0 to this [m]."""

    def apply(
        self, reading: Tensor, state: State, moment: Moment
    ) -> tuple[Tensor, State]:
        """Return the readings with false ones, ``[B, S, K]``."""
        rows, sensors, beams = reading.shape
        row, place = self._strikes(rows, sensors * beams, moment)
        nothing = reading.flatten(1)[row, place] == torch.inf
        places = Places(row[nothing], place[nothing], beams)
        half = places.draw(moment, purpose=1).to(reading.dtype)
        false = (half + 0.5) * (2.0**-16 * self.max_range)
        return put(reading, places, false), state

    def _strikes(self, rows: int, size: int, moment: Moment) -> tuple[Tensor, ...]:
        """Return the row and place of random events among ``[rows, size]`` elements.

        Each element has an event with the model's probability, independently. The gaps
        between events are drawn, so the cost depends on the number of events and not of
        readings.
        """
        struck = torch.zeros(rows, size, dtype=torch.bool, device=moment.row.device)
        # P(gap <= g) = 1 - (1 - p)^(g + 1)
        gaps = torch.arange(1, size + 1, dtype=torch.float64, device=struck.device)
        chance = 1 - (1 - self.probability) ** gaps
        row = torch.arange(rows, device=struck.device)
        last, block = torch.full_like(row, -1), 0
        while len(row):
            words = moment.words(row, torch.full_like(row, block)).t().contiguous()
            gap = torch.searchsorted(chance, words.double() * 2.0**-32, right=True)
            place = last[:, None] + (gap + 1).cumsum(1)
            hit = place < size
            struck[row[:, None].expand_as(place)[hit], place[hit]] = True
            more = hit[:, -1]
            row, last, block = row[more], place[more, -1], block + 1
        return struck.nonzero(as_tuple=True)


@dataclass(frozen=True, kw_only=True)
class RangeLimits(PointModel):
    """The smallest and largest distance that a sensor can measure."""

    minimum: _NotNegative = 0.0
    """Minimum range [m]."""
    maximum: Annotated[float, Interval(le=math.inf)] = math.inf
    """Maximum range [m]; beyond it nothing is detected."""
    below: Literal["nothing", "minimum"] = "minimum"
    """Reading of an object nearer than the minimum."""

    def __post_init__(self) -> None:
        """Raise ValueError for invalid values."""
        super().__post_init__()
        if not self.minimum < self.maximum:
            raise ValueError(
                "RangeLimits must have minimum < maximum, got "
                f"{self.minimum} and {self.maximum}"
            )

    def change(self, distance: Tensor, places: Places, moment: Moment) -> Tensor:
        """Return the distances within the limits, or infinite [m], ``[n]``."""
        near = torch.inf if self.below == "nothing" else self.minimum
        limited = distance.masked_fill(distance < self.minimum, near)
        return limited.masked_fill(distance > self.maximum, torch.inf)


@dataclass(frozen=True, kw_only=True)
class Quantisation(PointModel):
    """Readings are rounded to multiples of a step."""

    step: _Positive
    """Resolution of the readings [m]."""

    def change(self, distance: Tensor, places: Places, moment: Moment) -> Tensor:
        """Return the nearest multiples [m], ``[n]``."""
        return (distance / self.step).round() * self.step


@dataclass(frozen=True, kw_only=True)
class SampleAndHold(FrameModel):
    """Each sensor measures at a fixed rate with its own phase; readings are held.

    The first reading of an episode is always a new measurement. Measurements are made
    at control steps: if the rate is at least the control rate, at every step.
    """

    rate_hz: _Positive
    """Measurement rate of a sensor [Hz]."""

    def start(self, reading: Tensor, moment: Moment) -> State:
        """Return the held reading ``[B, S, K]`` and the phases ``[B, S]`` [ticks]."""
        rows, sensors = reading.shape[:2]
        everywhere = torch.ones(rows, sensors, device=reading.device)
        all_sensors = Places(*everywhere.nonzero(as_tuple=True), beams=1)
        phase = all_sensors.draw_trait(moment).reshape(rows, sensors)
        return {"held": reading, "phase": phase.to(torch.int32)}

    def apply(
        self, reading: Tensor, state: State, moment: Moment
    ) -> tuple[Tensor, State]:
        """Return new readings of sensors that are due, held ones of the others."""
        # Integers, so that no measurement is lost to rounding.
        rate = round(self.rate_hz * moment.dt * _TICKS)
        ticks = (moment.step * rate % _TICKS).to(torch.int32)
        due = ((ticks[:, None] + state["phase"]) & (_TICKS - 1)) < rate
        held = torch.where(due[..., None], reading, state["held"])
        return held, {"held": held, "phase": state["phase"]}


@dataclass(frozen=True, kw_only=True)
class Latency(FrameModel):
    """Readings are delayed by a whole number of control steps.

    At the start of an episode, its first reading is repeated until later ones arrive.
    """

    seconds: _NotNegative
    """Delay [s], rounded to control steps: half a step or less is no delay."""

    def start(self, reading: Tensor, moment: Moment) -> State:
        """Return the queue of delayed readings, oldest first, ``[B, steps, S, K]``."""
        steps = round(self.seconds / moment.dt)
        if not steps:
            return {}
        return {"queue": reading[:, None].repeat(1, steps, 1, 1)}

    def apply(
        self, reading: Tensor, state: State, moment: Moment
    ) -> tuple[Tensor, State]:
        """Return the oldest reading in the queue, and the new queue."""
        if not state:
            return reading, state
        queue = state["queue"]
        later = torch.cat((queue[:, 1:], reading[:, None]), 1)
        return queue[:, 0], {"queue": later}
