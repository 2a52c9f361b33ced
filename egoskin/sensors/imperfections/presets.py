"""Ready-to-use models of real sensors; `docs/sensor-models.md` has the tables.

The source of each number is given. "Assumption" is a plausible number that was not
measured: replace it by that of your sensor.
"""

from __future__ import annotations

from collections.abc import Callable

from egoskin.sensors.imperfections.corruption import Model
from egoskin.sensors.imperfections.models import (
    Bias,
    DeadSensors,
    Drift,
    Dropout,
    FalsePositives,
    Latency,
    Noise,
    Quantisation,
    RangeLimits,
    SampleAndHold,
)


def time_of_flight() -> tuple[Model, ...]:
    """Return the models of a time-of-flight sensor with 8 x 8 zones, the VL53L5CX.

    Source: ST, VL53L5CX (product page and driver manual): 4 m, 8 x 8 zones at up to
    15 Hz, resolution 1 mm. The other numbers are assumptions.
    """
    return (
        # Assumption: calibrated to 5 mm and 1 %.
        Bias(offset_std=0.005, gain_std=0.01),
        # Assumption: 5 mm near, 2 % of the distance far.
        Noise(constant=0.005, linear=0.02),
        # Assumption: 10 % of readings at 4 m are lost.
        Dropout(per_metre=0.025),
        # Assumption: one in 10,000 readings without an object, at any distance.
        FalsePositives(probability=1e-4, max_range=4.0),
        # Assumption: 1 % of the sensors have failed.
        DeadSensors(probability=0.01),
        # Range from the source; assumption: a minimum of 2 cm.
        RangeLimits(minimum=0.02, maximum=4.0),
        Quantisation(step=0.001),
        SampleAndHold(rate_hz=15.0),
        # Assumption: half a period, for exposure, computation and transfer.
        Latency(seconds=1 / 30),
    )


def capacitive() -> tuple[Model, ...]:
    """Return the models of a capacitive skin.

    Source: d = alpha / C, so constant noise of the capacitance C gives noise that grows
    as d squared (first order); a range of 18 cm (Kohlbrenner et al. 2026,
    GenTact-Prox). The other numbers are assumptions.
    """
    return (
        # Assumption: the coupling to objects varies by 10 %.
        Bias(gain_std=0.1),
        # Assumption: 1 mm at 5 cm, which is 13 mm at 18 cm.
        Noise(quadratic=0.4),
        # Assumption: hum and power supply, half as much.
        Noise(quadratic=0.2, common=True),
        # Assumption: after ten seconds as large as the noise.
        Drift(quadratic=0.13),
        DeadSensors(probability=0.01),  # Assumption.
        RangeLimits(maximum=0.18),
        # Assumption: fast for many electrodes that are read one after the other.
        SampleAndHold(rate_hz=50.0),
        Latency(seconds=0.02),  # Assumption: one period.
    )


def acoustic() -> tuple[Model, ...]:
    """Return the models of an acoustic skin that senses through the robot's shell.

    Source: true positive rates of 100 % for static and 95 % for moving obstacles (Fan
    et al. 2021, AuraSense). Assumptions: joint speed represents that motion, and all
    other numbers.
    """
    return (
        Bias(offset_std=0.01, gain_std=0.02),  # Assumption.
        # Assumption: 1 cm or 5 %, and 10 % more for each rad/s.
        Noise(constant=0.01, linear=0.05, per_speed=0.1),
        # 5 % lost in motion; assumption: at 5 rad/s, proportional to the speed.
        Dropout(per_speed=0.01),
        # Assumption: one in 1,000 readings without an object, up to 0.5 m.
        FalsePositives(probability=1e-3, max_range=0.5),
        DeadSensors(probability=0.01),  # Assumption.
        SampleAndHold(rate_hz=20.0),  # Assumption.
        Latency(seconds=0.03),  # Assumption.
    )


PRESETS: dict[str, Callable[[], tuple[Model, ...]]] = {
    "time_of_flight": time_of_flight,
    "capacitive": capacitive,
    "acoustic": acoustic,
}
"""Presets by the name used in configurations."""
