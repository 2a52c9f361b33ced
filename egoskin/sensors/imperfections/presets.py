"""Models of real sensors, ready for use; `docs/sensor-models.md` has the tables.

A figure says where it comes from. "Assumption" is a figure of plausible size that
nobody measured: replace it by your sensor's own.
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
    """Return the models of an optical ranging sensor of 8 x 8 zones, the VL53L5CX.

    Source: ST, VL53L5CX (product page and driver manual): 4 m, 8 x 8 zones at up to
    15 Hz, whole millimetres. All else are assumptions.
    """
    return (
        # Assumption: calibrated to 5 mm and 1 %.
        Bias(offset_std=0.005, gain_std=0.01),
        # Assumption: 5 mm near, 2 % of the distance far.
        Noise(constant=0.005, linear=0.02),
        # Assumption: a tenth of what is at 4 m goes unseen.
        Dropout(per_metre=0.025),
        # Assumption: one reading of nothing in ten thousand, at any distance alike.
        FalsePositives(probability=1e-4, max_range=4.0),
        # Assumption: one sensor in a hundred has failed.
        DeadSensors(probability=0.01),
        # Range from the source; assumption: 2 cm is the nearest it can measure.
        RangeLimits(minimum=0.02, maximum=4.0),
        Quantisation(step=0.001),
        SampleAndHold(rate_hz=15.0),
        # Assumption: half a period, for exposure, computation and transfer.
        Latency(seconds=1 / 30),
    )


def capacitive() -> tuple[Model, ...]:
    """Return the models of a capacitive skin.

    Source: d = alpha / C, so that constant noise of the capacitance C grows as d
    squared (first order); a range of 18 cm (Kohlbrenner et al. 2026, GenTact-Prox).
    All else are assumptions.
    """
    return (
        # Assumption: the coupling to what comes near varies by 10 %.
        Bias(gain_std=0.1),
        # Assumption: 1 mm at 5 cm, which is 13 mm at 18 cm.
        Noise(quadratic=0.4),
        # Assumption: hum and supply, half as much.
        Noise(quadratic=0.2, common=True),
        # Assumption: in ten seconds, what noise gives at once.
        Drift(quadratic=0.13),
        DeadSensors(probability=0.01),  # Assumption.
        RangeLimits(maximum=0.18),
        # Assumption: fast for a field of many electrodes read in turn.
        SampleAndHold(rate_hz=50.0),
        Latency(seconds=0.02),  # Assumption: one period.
    )


def acoustic() -> tuple[Model, ...]:
    """Return the models of an acoustic skin that listens through the robot's shell.

    Source: true positives 100 % of static and 95 % of moving obstacles (Fan et al.
    2021, AuraSense). That joint speed stands for that motion, and all else, are
    assumptions.
    """
    return (
        Bias(offset_std=0.01, gain_std=0.02),  # Assumption.
        # Assumption: 1 cm or 5 %, and louder by a tenth for each rad/s.
        Noise(constant=0.01, linear=0.05, per_speed=0.1),
        # 5 % unseen in motion; assumption: at 5 rad/s, in proportion to the speed.
        Dropout(per_speed=0.01),
        # Assumption: one reading of nothing in a thousand, up to half a metre.
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
