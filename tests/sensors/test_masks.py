"""Masked sensors detect nothing; the readings of the others do not change."""

from __future__ import annotations

import copy
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict

from egoskin.evaluation.throw_set import play_throws
from egoskin.make import EnvConfig, make_env, make_worker_env
from egoskin.robots.builtin import H1_2
from egoskin.sensors import (
    MASK_ALL,
    Field,
    FieldSensor,
    Ray,
    RaySensor,
    Skin,
    place_sensors,
)
from egoskin.sensors.config import SensorConfig
from egoskin.sensors.imperfections.corruption import Corruption
from egoskin.sensors.imperfections.models import Noise
from egoskin.sensors.kernels.compilation import SETTING, can_compile
from egoskin.shapes import Box, Sphere
from sensing import SEED, assert_same_bits, measure
from throwing import TASK

SKIN = place_sensors(H1_2, 24, seed=0)
SENSING = EnvConfig().pipeline(SKIN)
BALLS = [Sphere(radius=0.15), Sphere(radius=0.3)]
FAR = {"range": 5.0}
SENSORS = {
    "field": SensorConfig(**FAR),
    "field, binary": SensorConfig(**FAR, signal="binary"),
    "field, closeness": SensorConfig(**FAR, signal="closeness"),
    "field, localization": SensorConfig(**FAR, signal="localization"),
    "field, occluded": SensorConfig(**FAR, occlusion=True),
    # Real sensors, which also detect what is not there.
    "field, acoustic": SensorConfig(**FAR, corruption="acoustic"),
    "ray, reduced, acoustic": SensorConfig(
        **FAR,
        coverage="ray",
        ray=Ray(grid=(4, 4)),
        reduce="min",
        corruption="acoustic",
    ),
    "ray": SensorConfig(**FAR, coverage="ray", ray=Ray(grid=(4, 4))),
    "ray, reduced": SensorConfig(
        **FAR, coverage="ray", ray=Ray(grid=(4, 4)), reduce="min"
    ),
    "ray, localization": SensorConfig(
        **FAR, coverage="ray", ray=Ray(grid=(4, 4)), signal="localization"
    ),
}
COMPILED = pytest.mark.parametrize(
    "compiled",
    [
        pytest.param(
            True,
            id="C++",
            marks=pytest.mark.skipif(not can_compile(), reason="needs a C++ compiler"),
        ),
        pytest.param(False, id="plain"),
    ],
)


def without(skin: Skin, masked: list[int]) -> tuple[Skin, list[int]]:
    """A skin with some sensors removed, and the indices of the others."""
    kept = [i for i in range(len(skin)) if i not in masked]
    return skin.select(kept), kept


def flown(sensor: SensorConfig, skin: Skin, mask=(), steps: int = 20) -> torch.Tensor:
    """Outputs of an environment while the first balls arrive, ``[B, T]``."""
    config = EnvConfig(task=TASK, sensor=sensor)
    env = make_worker_env(config, skin, num_envs=8, seed=0, keep_raw=True, mask=mask)
    return env.rollout(
        steps,
        lambda td: td.set("action", torch.zeros(8, len(H1_2.joints))),
        break_when_any_done=False,
    )


# --- sensors --------------------------------------------------------------------


@COMPILED
@settings(max_examples=25)
@given(seed=SEED, field=st.booleans(), per_object=st.booleans())
def test_the_others_read_the_same_as_without_those_masked(
    skin, random_state, compiled, seed, field, per_object
):
    rng = np.random.default_rng(seed)
    some = skin.select(rng.permutation(len(skin))[: rng.integers(2, 40)])
    some = replace(some, range=np.exp(rng.uniform(-2, 1.4, len(some))))
    masked = [i for i in range(len(some)) if rng.random() < 0.5][: len(some) - 1]
    kind, coverage = (FieldSensor, Field()) if field else (RaySensor, Ray(grid=(3, 5)))
    common = {"coverage": coverage, "per_object": per_object, "compile": compiled}
    state = random_state(40, int(rng.integers(1000)))
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(SETTING, "1")
        fewer, kept = without(some, masked)
        whole, part = (kind(s, H1_2.chain, BALLS, 1.0, **common) for s in (some, fewer))
        assert compiled == (getattr(whole._kernels, "_library", None) is not None)
        before = measure(whole, state)
        whole.mask(masked)
        distance, detected = measure(whole, state)
        assert torch.isinf(distance[:, masked]).all()
        assert_same_bits((distance[:, kept], detected), measure(part, state))
        # Other sensors instead, then none: no state is kept.
        whole.mask(kept)
        rest = measure(whole, state)[0]
        assert torch.isinf(rest[:, kept]).all()
        assert_same_bits((rest[:, masked],), (before[0][:, masked],))
        whole.mask([])
        assert_same_bits(measure(whole, state), before)


@COMPILED
@pytest.mark.parametrize("kind", [FieldSensor, RaySensor])
@pytest.mark.parametrize(
    "shape", [Sphere(radius=4.0), Box(half_extents=(4.0, 4.0, 4.0))]
)
def test_a_masked_sensor_inside_an_object_detects_nothing(
    kind, shape, compiled, random_state, monkeypatch
):
    monkeypatch.setenv(SETTING, "1")
    state = random_state(8, objects=1)
    state["object_active"][:] = True
    state["object_pose"][:, 0, :3] = state["base_pose"][:, :3]
    sensor = kind(SKIN, H1_2.chain, [shape], 2.0, compile=compiled)
    sensor.mask(range(len(SKIN)))
    distance, detected = measure(sensor, state)
    assert torch.isinf(distance).all()
    assert not detected.any()


@COMPILED
def test_hits_of_a_masked_grid_are_those_of_the_others(
    compiled, random_state, monkeypatch
):
    monkeypatch.setenv(SETTING, "1")
    sensor = RaySensor(SKIN, H1_2.chain, BALLS, 3.0, Ray(grid=(4, 4)), compile=compiled)
    state, masked = random_state(16), [0, 5, 6]
    sensor.mask(masked)
    distance, _ = measure(sensor, state)
    inputs = [state[key] for key in ("base_pose", "joint_pos", "object_pose")]
    place, reading = sensor.hits(*inputs, state["object_active"])
    dense = torch.full((distance.numel(),), torch.inf)
    dense[place] = reading
    assert torch.equal(dense.reshape_as(distance), distance)
    assert distance.isfinite().any()


def test_a_copied_sensor_keeps_its_mask(random_state):
    sensor = FieldSensor(SKIN, H1_2.chain, BALLS, 5.0)
    sensor.mask([0, 1])
    state = random_state(16)
    assert_same_bits(measure(copy.deepcopy(sensor), state), measure(sensor, state))


@COMPILED
@pytest.mark.parametrize("kind", [FieldSensor, RaySensor])
def test_a_clone_has_its_own_mask(kind, compiled, random_state, monkeypatch):
    monkeypatch.setenv(SETTING, "1")
    sensor = kind(SKIN, H1_2.chain, BALLS, 5.0, compile=compiled)
    state = random_state(16)
    before = measure(sensor, state)
    clone = sensor.clone()
    clone.mask(range(24))
    assert torch.isinf(measure(clone, state)[0]).all()
    assert_same_bits(measure(sensor, state), before)
    sensor.mask([0, 1])
    clone.mask([])
    assert_same_bits(measure(clone, state), before)
    # A clone begins with the mask of its original.
    assert_same_bits(measure(sensor.clone(), state), measure(sensor, state))


@COMPILED
def test_a_loaded_state_dict_brings_its_mask(compiled, random_state, monkeypatch):
    monkeypatch.setenv(SETTING, "1")
    masked, plain = (
        FieldSensor(SKIN, H1_2.chain, BALLS, 5.0, compile=compiled) for _ in range(2)
    )
    masked.mask([0, 1])
    state = random_state(16)
    without_mask = measure(plain, state)
    plain.load_state_dict(masked.state_dict())
    assert_same_bits(measure(plain, state), measure(masked, state))
    assert not torch.equal(measure(plain, state)[0], without_mask[0])


@COMPILED
def test_a_loaded_state_dict_brings_no_skin(compiled, random_state, monkeypatch):
    monkeypatch.setenv(SETTING, "1")
    other = place_sensors(H1_2, 24, seed=7)
    for make in (FieldSensor, RaySensor):
        one, two = (
            make(skin, H1_2.chain, BALLS, reach, compile=compiled)
            for skin, reach in ((SKIN, 5.0), (other, 4.0))
        )
        state = random_state(16)
        expected = measure(two, state)
        two.load_state_dict(one.state_dict())
        assert_same_bits(measure(two, state), expected)
        assert two.ranges.tolist() == [4.0] * 24


def test_a_mask_may_be_a_tensor_or_flags(random_state):
    sensor = FieldSensor(SKIN, H1_2.chain, BALLS, 5.0)
    sensor.mask([0, 2])
    state = random_state(16)
    expected = measure(sensor, state)
    flags = torch.zeros(24, dtype=torch.bool)
    flags[[0, 2]] = True
    for mask in (torch.tensor([0, 2]), flags, flags.tolist(), flags.numpy()):
        sensor.mask([])
        sensor.mask(mask)
        assert_same_bits(measure(sensor, state), expected)
    with pytest.raises(ValueError, match=r"must be \(24,\), one for each, got \(2,\)"):
        sensor.mask([True, False])


def test_a_mask_does_not_change_the_ranges():
    sensor = FieldSensor(SKIN, H1_2.chain, BALLS, 5.0)
    sensor.mask([0])
    assert sensor.ranges.tolist() == [5.0] * 24


@pytest.mark.parametrize("form", [{"reduce": "min"}, {"per_object": True}])
def test_only_full_grids_have_hits(form, random_state):
    sensor = RaySensor(SKIN, H1_2.chain, BALLS, 3.0, Ray(grid=(4, 4)), **form)
    state = random_state(2)
    with pytest.raises(ValueError, match="without reduce and per_object"):
        sensor.hits(*(state[str(key)] for key in sensor.in_keys))


# --- environments ---------------------------------------------------------------


@pytest.mark.parametrize("sensor", SENSORS.values(), ids=SENSORS)
def test_a_masked_link_is_one_without_sensors(sensor):
    mask = ("torso_link", "left_elbow_link")
    masked = SENSING.masked(mask)
    assert 0 < len(masked) < len(SKIN)
    assert {SKIN.links[i] for i in masked} == set(mask)
    fewer, kept = without(SKIN, masked)
    got, expected, plain = (
        flown(sensor, SKIN, mask),
        flown(sensor, fewer),
        flown(sensor, SKIN),
    )
    assert torch.equal(got["object_detected"], expected["object_detected"])
    critic = "privileged_observation"
    assert torch.equal(got[critic], plain[critic])
    if sensor.signal == "localization":
        assert torch.equal(got["signal"], expected["signal"])
        assert got["signal"].any()
    else:
        each = (*got.batch_size, len(SKIN), -1)
        signal, full = got["signal"].reshape(each), plain["signal"].reshape(each)
        nothing = {"proximity": 1.0}.get(sensor.signal, 0.0)
        assert (signal[..., masked, :] == nothing).all()
        assert (full[..., masked, :] != nothing).any()
        other = expected["signal"].reshape(*got.batch_size, len(kept), -1)
        if sensor.corruption != "none":
            # The errors of a sensor depend on its index.
            other = full[..., kept, :]
        assert torch.equal(signal[..., kept, :], other)
        assert (other != nothing).any()


def test_sensors_of_every_kind_of_a_mixed_skin_are_masked():
    kinds = (Ray(grid=(4, 4)), Field(), Ray(grid=(2, 3)))
    mixed = replace(SKIN, coverage=tuple(kinds[i % 3] for i in range(len(SKIN))))
    sensor = SensorConfig(**FAR)
    got, plain = flown(sensor, mixed, ("torso_link",)), flown(sensor, mixed)
    masked = [i for i, name in enumerate(mixed.links) if name == "torso_link"]
    assert {i % 3 for i in masked} == {0, 1, 2}
    size = [1 if i % 3 == 1 else (16, 0, 6)[i % 3] for i in range(len(SKIN))]
    signals = got["signal"].split(size, -1), plain["signal"].split(size, -1)
    for i, (signal, full) in enumerate(zip(*signals, strict=True)):
        if i in masked:
            assert (signal == 1).all()
        else:
            assert torch.equal(signal, full)
    assert (plain["signal"] < 1).any()


def test_all_sensors_masked_by_name_are_all_sensors_masked():
    sensor = SensorConfig(**FAR)
    by_name = flown(sensor, SKIN, tuple(set(SKIN.links)))
    all_of_them = flown(sensor, SKIN, MASK_ALL)
    assert torch.equal(by_name["signal"], all_of_them["signal"])
    assert (by_name["signal"] == 1).all()
    # The order of the names does not matter.
    assert SENSING.masked(["all"]) == SENSING.masked(MASK_ALL)
    assert SENSING.masked(MASK_ALL) == list(range(len(SKIN)))


def test_a_masked_skin_of_real_sensors_signals_nothing():
    sensor = SensorConfig(**FAR, corruption="acoustic")
    assert (flown(sensor, SKIN, MASK_ALL)["signal"] == 1).all()


def test_an_oracle_is_masked_as_a_whole():
    config = EnvConfig(task=TASK, sensor=SensorConfig(coverage="oracle"))
    sees, masked = (
        make_worker_env(config, SKIN, num_envs=4, seed=0, mask=mask).rollout(20)
        for mask in ((), MASK_ALL)
    )
    assert sees["signal"].any()
    assert not masked["signal"].any()


@pytest.mark.slow
def test_workers_mask_as_one_process_does():
    config = EnvConfig(task=TASK, sensor=SensorConfig(**FAR))
    mask, seen = ("torso_link",), []
    for workers in (1, 2):
        pool = make_env(
            config, SKIN, num_envs=8, seed=0, num_workers=workers, mask=mask
        )
        try:
            root = pool.reset()
            for _ in range(20):
                root["action"] = torch.zeros(*root.batch_size, len(H1_2.joints))
                root = pool.step_and_maybe_reset(root)[1]
            seen.append(root["signal"].reshape(8, -1).clone())
        finally:
            pool.close()
    assert torch.equal(*seen)
    masked = SENSING.masked(mask)
    assert (seen[0][:, masked] == 1).all()
    assert (seen[0] < 1).any()


# --- evaluation -----------------------------------------------------------------


class Ducks(torch.nn.Module):
    """Folds as soon as any sensor detects anything."""

    def forward(self, td):
        detected = (td["signal"] < 1).any(-1, keepdim=True)
        action = torch.zeros(len(td), len(H1_2.joints))
        action[:, [i for i, n in enumerate(H1_2.joints) if "hip_pitch" in n]] = -2.0
        return td.set("action", detected * action)


def test_a_policy_whose_sensors_are_masked_does_what_one_does_without_sensors():
    config = EnvConfig(task=TASK)
    which = {"throw_set": 0, "episodes": 16}
    senses = play_throws(Ducks(), config, SKIN, **which)
    masked = play_throws(Ducks(), config, SKIN, **which, mask=MASK_ALL)
    still = play_throws(None, config, SKIN, **which)
    assert torch.equal(masked.steps, still.steps)
    assert not torch.equal(senses.steps, still.steps)


@pytest.mark.parametrize(
    ("sensor", "mask", "message"),
    [
        ({}, ("torso_lnk",), r"no sensor on 'torso_lnk'.*: .*torso_link"),
        ({}, ("torso_link", "pelvis"), "no sensor on 'pelvis'"),
        ({}, ("all", "torso_link"), "no sensor on 'all'"),
        ({}, "all", "expected a sequence of links with sensors, got 'all'"),
        ({"coverage": "none"}, MASK_ALL, "a blind robot has no sensors to mask"),
        ({"coverage": "none"}, ("torso_link",), "a blind robot has no sensors"),
        (
            {"coverage": "oracle"},
            ("torso_link",),
            "an oracle has no sensors on links: its mask",
        ),
    ],
)
def test_a_mask_that_masks_nothing_is_refused(sensor, mask, message):
    config = EnvConfig(sensor=SensorConfig(**sensor))
    with pytest.raises(ValueError, match=message):
        config.pipeline(SKIN).check_mask(mask)
    with pytest.raises(ValueError, match=message):
        play_throws(None, config, SKIN, throw_set=0, episodes=2, mask=mask)
    for make in (make_env, make_worker_env):
        with pytest.raises(ValueError, match=message):
            make(config, SKIN, num_envs=2, seed=0, mask=mask)


@pytest.mark.parametrize("mask", [(), MASK_ALL, ["all"], ("torso_link",)])
def test_a_mask_of_links_with_sensors_is_taken(mask):
    SENSING.check_mask(mask)


def test_links_are_masked_by_pattern():
    left = SENSING.masked(["left_*"])
    assert {SKIN.links[i] for i in left} == {n for n in SKIN.links if n[:4] == "left"}
    assert 0 < len(left) < len(SKIN)


def test_a_link_without_sensors_in_this_skin_is_refused():
    skin, _ = without(SKIN, SENSING.masked(("torso_link",)))
    with pytest.raises(ValueError, match="no sensor on 'torso_link'"):
        EnvConfig().pipeline(skin).check_mask(("torso_link",))


@pytest.mark.parametrize(
    ("mask", "message"),
    [
        ([3, 99], "no sensor 99: there are 24"),
        ([True, False], "flags of sensors"),
        (["torso_link"], r"sensors must be indices or flags, got \['torso_link'\]"),
        ([0.5], r"sensors must be indices or flags, got \[0.5\]"),
    ],
)
def test_a_mask_that_does_not_fit_is_refused_and_changes_nothing(mask, message):
    sensor = FieldSensor(SKIN, H1_2.chain, Sphere(radius=0.15), 2.0)
    sensor.mask([1])
    before = sensor._range.clone()
    with pytest.raises(ValueError, match=message):
        sensor.mask(mask)
    assert torch.equal(sensor._range, before)
    corruption = Corruption([Noise(constant=0.1)], dt=0.02, seed=0)
    stored = TensorDict(
        distance=torch.ones(2, 3, 24),
        is_init=torch.zeros(2, 3, 1, dtype=torch.bool),
        batch_size=[2, 3],
    )

    # It learns the number of sensors from the measurements only.
    def use() -> None:
        corruption.mask(mask)
        corruption(stored)

    with pytest.raises(ValueError, match=message):
        use()
