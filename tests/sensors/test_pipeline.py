"""Pipeline from skin and configuration to signal, in the order of the skin."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import get_args, get_type_hints

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.data import Composite, Unbounded

from egoskin.envs.physics import PhysicsConfig
from egoskin.make import EnvConfig, make_worker_env
from egoskin.robots.builtin import H1_2
from egoskin.sensors import Field, Ray, SensorPipeline, Skin, place_sensors
from egoskin.sensors.config import SensorConfig
from egoskin.sensors.imperfections.models import FalsePositives, Latency
from egoskin.sensors.imperfections.presets import PRESETS
from egoskin.sensors.pipeline import READINGS
from egoskin.shapes import Sphere
from throwing import TASK

BALLS = [Sphere(radius=0.15), Sphere(radius=0.3)]
BIG, SMALL, HALF = Ray(grid=(4, 4)), Ray(grid=(2, 3)), Field(half_angle_deg=90)


@pytest.fixture(scope="module")
def mixed() -> Skin:
    """Nine sensors of three alternating kinds, each with its own range."""
    return replace(
        place_sensors(H1_2, 9, seed=0),
        coverage=(BIG, Field(), SMALL, None, HALF, SMALL, BIG, None, Field()),
        range=np.linspace(0.3, 2.0, 9),
    )


def measured(config: SensorConfig, skin: Skin, state: TensorDict) -> TensorDict:
    """Stored states, each the first of an episode, and all values derived from them."""
    stored = state.clone().unsqueeze(-1)
    stored["is_init"] = torch.ones(*stored.shape, 1, dtype=torch.bool)
    for transform in SensorPipeline(config, H1_2, skin).transforms(BALLS, dt=1 / 60):
        stored = transform(stored)
    return stored


@pytest.mark.parametrize("options", [{}, {"reduce": "min"}], ids=["all", "least"])
@pytest.mark.parametrize("kind", ["proximity", "binary"])
def test_a_mixed_skin_signals_sensor_by_sensor(mixed, random_state, kind, options):
    config = SensorConfig(signal=kind, range=1.0, **options)
    state = random_state(200, seed=3)
    # Computed with single-sensor skins, which cannot be out of order.
    parts = []
    for i, coverage in enumerate(mixed.coverage):
        own = options if isinstance(coverage, Ray) else {}
        alone = SensorConfig(signal=kind, range=1.0, **own)
        parts.append(measured(alone, mixed.select([i]), state)["signal"])
    assert len({part.shape for part in parts}) == (1 if "reduce" in options else 3)
    assert all(len(part.unique()) > 1 for part in parts)
    signal = measured(config, mixed, state)["signal"]
    assert torch.equal(signal, torch.cat(parts, -1))
    pipeline = SensorPipeline(config, H1_2, mixed)
    assert pipeline.signal_size == signal.shape[-1]
    spec = Composite(
        {key: Unbounded(x.shape, dtype=x.dtype) for key, x in state.items()},
        shape=[200],
    )
    for transform in pipeline.transforms(BALLS, dt=1 / 60):
        spec = transform.transform_observation_spec(spec)
    assert spec["signal"].is_in(signal[:, 0])


@pytest.mark.parametrize(
    ("options", "size"),
    [
        ({}, 12),
        ({"coverage": "ray"}, 12 * 64),
        ({"coverage": "ray", "reduce": "min"}, 12),
        ({"coverage": "ray", "signal": "localization", "keep_last": True}, 3),
        ({"coverage": "none"}, 0),
    ],
)
def test_a_skin_is_resolved_once_on_its_way_to_the_kernel(options, size, monkeypatch):
    config = EnvConfig(task=TASK, sensor=SensorConfig(range=1.25, **options))
    skin, resolved, calls = place_sensors(H1_2, 12, seed=0), Skin.resolved, []

    def counting(self, *args):
        calls.append(args)
        return resolved(self, *args)

    monkeypatch.setattr(Skin, "resolved", counting)
    env = make_worker_env(config, skin, num_envs=2, seed=0)
    assert calls == [(config.sensor.default_coverage, 1.25)]
    pipeline = config.pipeline(skin)
    assert pipeline.signal_size == size
    assert (pipeline.skin.range == 1.25).all()
    if size:
        assert env.observation_spec["signal"].shape == (2, size)
    else:
        assert "signal" not in env.observation_spec


def test_a_reduction_of_nothing_is_refused():
    with pytest.raises(ValueError, match="reduce=min is for ray sensors, and the skin"):
        EnvConfig(sensor=SensorConfig(reduce="min")).pipeline()


def test_every_signal_has_a_transform_of_its_own():
    signals = get_args(get_type_hints(SensorConfig)["signal"])
    assert {*READINGS, "localization"} == {*signals}


@pytest.mark.parametrize("preset", ["time_of_flight", "acoustic"])
@pytest.mark.parametrize("reach", [0.2, 0.6])
def test_a_real_sensor_signals_nothing_from_beyond_its_range(
    skin, random_state, preset, reach
):
    # False positives go up to 4 m and 0.5 m, noise beyond any range.
    config = SensorConfig(signal="binary", range=reach, corruption=preset)
    stored = measured(config, skin, random_state(4000, seed=1))
    reading = stored["reading"]
    beyond = (reading > reach) & (reading < math.inf)
    assert beyond.sum() > 50
    assert torch.equal(stored["signal"], (reading <= reach).float())


# --- errors of real sensors -----------------------------------------------------------


def make(skin: Skin, corruption="acoustic", hz=60, throws=TASK.throws, **options):
    """Return an environment with real sensors and the first ball at once."""
    physics = PhysicsConfig(control_hz=hz, substeps=120 // hz)
    task = replace(TASK, physics=physics, throws=throws)
    config = EnvConfig(task=task, sensor=SensorConfig(range=5.0, corruption=corruption))
    return make_worker_env(config, skin, **options)


@pytest.fixture
def noisy(monkeypatch) -> None:
    """Half of the sensors that see nothing detect something."""
    false = FalsePositives(probability=0.5, max_range=4.0)
    monkeypatch.setitem(PRESETS, "acoustic", lambda: (false,))


def false_signals(skin: Skin, **options) -> torch.Tensor:
    """Return the first signals of sensors that see nothing, ``[B, S]``."""
    env = make(skin, throws=replace(TASK.throws, first_delay=(1.0, 1.0)), **options)
    signal = env.reset()["signal"]
    assert 0.3 < (signal < 1).float().mean() < 0.7
    return signal


def test_errors_are_drawn_with_the_seed_for_each_global_row(skin, noisy):
    whole = false_signals(skin, num_envs=4, seed=3)
    assert len(whole.unique(dim=0)) == 4
    part = false_signals(skin, num_envs=2, seed=3, row_offset=2)
    assert torch.equal(part, whole[2:])
    other = false_signals(skin, num_envs=4, seed=4)
    assert (other == whole).float().mean() < 0.5


def test_errors_of_two_kinds_of_sensors_are_independent(random_state, noisy):
    wide, tall = Ray(grid=(4, 1)), Ray(grid=(1, 4))
    skin = replace(place_sensors(H1_2, 20, seed=0), coverage=(wide, tall) * 10)
    state = random_state(20, seed=0)
    state["object_active"][:] = False
    config = SensorConfig(coverage="ray", range=5.0, corruption="acoustic")
    stored = measured(config, skin, state)
    one, other = (stored[f"reading_{i}"].isfinite() for i in range(2))
    # Of 800 pairs of independent flags, half are equal.
    assert one.shape == other.shape == (20, 1, 10, 4)
    assert (one == other).float().mean() == pytest.approx(0.5, abs=0.1)


@pytest.mark.parametrize(("hz", "steps"), [(60, 2), (30, 1)])
def test_a_latency_is_a_time_at_any_control_rate(skin, hz, steps, monkeypatch):
    monkeypatch.setitem(PRESETS, "acoustic", lambda: (Latency(seconds=1 / 30),))
    ideal, late = (
        make(skin, hz=hz, corruption=kind, num_envs=4, seed=0, hold=True).rollout(
            hz // 3, lambda td: td.set("action", torch.zeros(4, 21))
        )["signal"]
        for kind in ("none", "acoustic")
    )
    assert torch.equal(late[:, steps:], ideal[:, :-steps])
    assert not torch.equal(late, ideal)


@pytest.mark.parametrize("kind", ["proximity", "closeness", "binary"])
def test_the_closest_beam_of_a_real_sensor_is_that_of_its_readings(
    mixed, random_state, kind
):
    # A chip reports all zones; each can be wrong.
    options = {"signal": kind, "range": 1.0, "corruption": "time_of_flight"}
    state = random_state(500, seed=2)
    every, least = SensorConfig(**options), SensorConfig(**options, reduce="min")
    size = [len(c.directions()) if isinstance(c, Ray) else 1 for c in mixed.coverage]
    choose = torch.amin if kind == "proximity" else torch.amax
    zones = measured(every, mixed, state)["signal"].split(size, -1)
    expected = torch.stack([choose(signal, -1) for signal in zones], -1)
    signal = measured(least, mixed, state)["signal"]
    assert torch.equal(signal, expected)
    assert len(signal.unique()) > 1
    pipeline = SensorPipeline(least, H1_2, mixed)
    assert pipeline.signal_size == signal.shape[-1] == len(mixed)
