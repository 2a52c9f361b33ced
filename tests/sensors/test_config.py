"""Contradictory sensor configurations."""

from __future__ import annotations

import pytest

from egoskin.sensors import Field, Ray
from egoskin.sensors.config import SensorConfig


@pytest.mark.parametrize(
    ("options", "message"),
    [
        *(
            ({"coverage": coverage, name: value}, f"{text} has no effect with cov")
            for coverage in ("none", "oracle")
            for name, value, text in (
                ("corruption", "acoustic", "corruption"),
                ("occlusion", True, "occlusion"),
                ("reduce", "min", "reduce"),
                ("signal", "localization", "signal=localization"),
            )
        ),
        ({"ray": Ray(grid=(4, 4))}, "ray options need coverage=ray, not field"),
        (
            {"coverage": "none", "ray": Ray(grid=(4, 4))},
            "ray options need coverage=ray, not none",
        ),
        (
            {"coverage": "ray", "field": Field(half_angle_deg=60)},
            "field options need coverage=field, not ray",
        ),
        ({"keep_last": True}, "keep_last needs signal=localization, not proximity"),
        (
            {"signal": "localization", "corruption": "acoustic"},
            "corruption=acoustic needs a measured signal",
        ),
        ({"signal": "Binary"}, "signal must be one of .*binary, got 'Binary'"),
        ({"coverage": "rays"}, "coverage must be one of field, .*, got 'rays'"),
        ({"range": 0.0}, "range must be at least 0.001, got 0"),
    ],
)
def test_what_has_no_effect_or_no_sense_is_refused(options, message):
    with pytest.raises(ValueError, match=message):
        SensorConfig(**options)
