"""The signal of a skin whose sensors differ, put together by its configuration."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.data import Composite, Unbounded

from egoskin.robots.config import H1_2
from egoskin.sensors import Field, Ray, Skin, place_sensors
from egoskin.sensors.config import SensorConfig
from egoskin.shapes import Sphere

BALLS = [Sphere(radius=0.15), Sphere(radius=0.3)]
BIG, SMALL, HALF = Ray(grid=(4, 4)), Ray(grid=(2, 3)), Field(half_angle_deg=90)


@pytest.fixture(scope="module")
def mixed() -> Skin:
    """Nine sensors of three kinds by turns, each with a range of its own."""
    return replace(
        place_sensors(H1_2, 9, seed=0),
        coverage=(BIG, Field(), SMALL, None, HALF, SMALL, BIG, None, Field()),
        range=np.linspace(0.3, 2.0, 9),
    )


def signal(config: SensorConfig, skin: Skin, state: TensorDict) -> torch.Tensor:
    """The signal of stored states, each the first of an episode."""
    stored = state.clone().unsqueeze(-1)
    stored["is_init"] = torch.ones(*stored.shape, 1, dtype=torch.bool)
    for transform in config.transforms(H1_2, skin, BALLS, dt=1 / 60):
        stored = transform(stored)
    return stored["signal"][:, 0]


@pytest.mark.parametrize(
    ("options", "named"),
    [
        ({"corruption": "acoustic"}, "corruption"),
        ({"occlusion": True}, "occlusion"),
        ({"per_object": True}, "per_object"),
        ({"validity": True}, "validity"),
        ({"reduce": "min"}, "reduce"),
        ({"signal": "localization"}, "signal=localization"),
    ],
)
@pytest.mark.parametrize("coverage", ["none", "oracle"])
def test_what_needs_a_skin_is_refused_without_one(coverage, options, named):
    text = f"{named} has no effect with coverage={coverage}"
    with pytest.raises(ValueError, match=text):
        SensorConfig(coverage=coverage, **options)


@pytest.mark.parametrize(
    ("coverage", "options", "named"),
    [
        ("field", {"ray": Ray(grid=(4, 4))}, "ray"),
        ("none", {"ray": Ray(grid=(4, 4))}, "ray"),
        ("ray", {"field": Field(half_angle_deg=60)}, "field"),
    ],
)
def test_options_of_another_coverage_are_refused(coverage, options, named):
    text = f"{named} options need coverage={named}, not {coverage}"
    with pytest.raises(ValueError, match=text):
        SensorConfig(coverage=coverage, **options)


@pytest.mark.parametrize("options", [{}, {"per_object": True}, {"reduce": "min"}])
@pytest.mark.parametrize("kind", ["proximity", "binary"])
def test_a_mixed_skin_signals_sensor_by_sensor(mixed, random_state, kind, options):
    config = SensorConfig(signal=kind, range=1.0, **options)
    state = random_state(200, seed=3)
    # By the skin of a single sensor, which cannot be out of order.
    parts = []
    for i, coverage in enumerate(mixed.coverage):
        own = options if isinstance(coverage, Ray) else {**options, "reduce": "none"}
        alone = SensorConfig(signal=kind, range=1.0, **own)
        parts.append(signal(alone, mixed.select([i]), state))
    assert len({part.shape for part in parts}) == (1 if "reduce" in options else 3)
    assert all(len(part.unique()) > 1 for part in parts)
    expected = torch.cat(parts, -1)
    assert torch.equal(signal(config, mixed, state), expected)
    if kind == "proximity":
        told = signal(replace(config, validity=True), mixed, state)
        valid = signal(replace(config, signal="binary"), mixed, state)
        assert torch.equal(told, torch.cat((expected, valid), -1))


def test_the_spec_of_a_mixed_skin_is_that_of_its_signal(mixed, random_state):
    config, state = SensorConfig(validity=True), random_state(5)
    spec = Composite(
        {key: Unbounded(x.shape, dtype=x.dtype) for key, x in state.items()}, shape=[5]
    )
    for transform in config.transforms(H1_2, mixed, BALLS, dt=1 / 60):
        spec = transform.transform_observation_spec(spec)
    assert spec["signal"].is_in(signal(config, mixed, state))


@pytest.mark.parametrize("preset", ["time_of_flight", "acoustic"])
@pytest.mark.parametrize("reach", [0.2, 0.6])
def test_a_real_sensor_tells_nothing_from_beyond_its_range(
    skin, random_state, preset, reach
):
    # False positives go up to 4 m and 0.5 m, noise beyond any range.
    config = SensorConfig(signal="binary", range=reach, corruption=preset)
    state = random_state(4000, seed=1)
    stored = state.unsqueeze(-1)
    stored["is_init"] = torch.ones(*stored.shape, 1, dtype=torch.bool)
    for transform in config.transforms(H1_2, skin, BALLS, dt=1 / 60):
        stored = transform(stored)
    reading, told = stored["reading"], stored["signal"]
    beyond = (reading > reach) & (reading < math.inf)
    assert beyond.sum() > 50
    assert torch.equal(told, (reading <= reach).float())
