"""The three signals, compared with values by hand."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from egoskin.robots.builtin import H1_2
from egoskin.sensors import (
    Binary,
    FieldSensor,
    Localization,
    Proximity,
    RaySensor,
    place_sensors,
)
from egoskin.sensors.signals import SkinOrder
from egoskin.shapes import Sphere

INF = math.inf
HALF = 0.5**0.5


def test_proximity_is_distance_over_range():
    (signal,) = Proximity(2.0).compute(torch.tensor([[0.0, 0.5, 1.0, 2.0, INF]]))
    assert signal.tolist() == [[0, 0.25, 0.5, 1, 1]]


def test_proximity_of_an_infinite_range_is_d_over_d_plus_one():
    (signal,) = Proximity(INF).compute(torch.tensor([[0.0, 1.0, 3.0, INF]]))
    # 0/1, 1/2, 3/4, and nothing at all
    assert signal.tolist() == [[0, 0.5, 0.75, 1]]


@given(st.floats(0, 1e6), st.floats(0, 1e6), st.floats(0.01, 100))
def test_proximity_grows_with_distance_and_stays_in_bounds(a, b, max_range):
    near, far = sorted((a, b))
    for limit in (max_range, INF):
        (signal,) = Proximity(limit).compute(torch.tensor([[near, far]]))
        assert 0 <= signal[0, 0] <= signal[0, 1] <= 1


@pytest.mark.parametrize("max_range", [0.0, -2.0, math.nan, []])
def test_proximity_refuses_a_range_that_is_not_positive(max_range):
    with pytest.raises(ValueError, match="max_range must be positive, got"):
        Proximity(max_range)


@pytest.mark.parametrize("max_range", ["2 m", place_sensors(H1_2, 1), ["2"], None])
def test_proximity_says_what_a_range_may_be(max_range):
    kind = type(max_range).__name__
    with pytest.raises(
        ValueError, match=f"a number or one for each sensor, got {kind}"
    ):
        Proximity(max_range)


def test_proximity_takes_one_range_for_each_sensor_or_for_all():
    distance = torch.tensor([[[1.0, 2.0], [1.0, INF]]])
    (signal,) = Proximity([2.0, 4.0]).compute(distance)
    assert signal.tolist() == [[0.5, 1, 0.25, 1]]
    with pytest.raises(ValueError, match="2 ranges do not fit the 4 sensors of 'dis"):
        Proximity([2.0, 4.0]).compute(torch.ones(1, 4))


@pytest.mark.parametrize("kind", [FieldSensor, RaySensor])
def test_the_range_of_a_signal_is_that_of_its_sensor(kind, robot, skin, random_state):
    own = np.where(np.arange(64) % 2, 0.5, np.nan)
    sensor = kind(replace(skin, range=own), robot.chain, Sphere(radius=0.1), 2.0)
    state = sensor(random_state(500, objects=1))
    distance = state["distance"].flatten(2) if kind is RaySensor else state["distance"]
    distance = distance.reshape(500, 64, -1)
    limit = torch.tensor([2.0, 0.5] * 32)[:, None]
    seen = distance.isfinite()
    assert (distance > 1.0)[seen].any()
    expected = torch.where(seen, distance / limit, 1.0).flatten(1)
    signal = Proximity(sensor)(state)["signal"]
    torch.testing.assert_close(signal, expected)
    # A number limits the range: nothing beyond 1 m, whatever the sensor detects.
    cut = Proximity(1.0)(state)["signal"] < 1.0
    assert torch.equal(cut, (distance < 1.0).flatten(1))
    assert torch.equal(Binary(sensor)(state)["signal"].bool(), seen.flatten(1))


def test_binary_is_one_for_any_distance_in_range():
    (signal,) = Binary().compute(torch.tensor([[0.0, 1.9, INF]]))
    assert signal.tolist() == [[1, 1, 0]]
    assert signal.dtype == torch.float32


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_measurement_beyond_the_range_of_its_sensor_finds_nothing(dtype):
    # Of a false positive, or by noise; the range exactly met is in range.
    distance = torch.tensor([[0.2, 0.21, INF, math.nan], [0.3, 5, 1e9, 0]], dtype=dtype)
    ranges = [0.2, 0.2, INF, INF]
    found = torch.tensor([[1, 0, 0, math.nan], [0, 0, 1, 1]], dtype=dtype)
    (binary,) = Binary(ranges).compute(distance)
    torch.testing.assert_close(binary, found, rtol=0, atol=0, equal_nan=True)
    (signal,) = Proximity(ranges).compute(distance)
    assert signal[:, :2].tolist() == [[1, 1], [1, 1]]


def test_signals_of_groups_come_in_the_order_of_the_skin():
    # Sensors 0 and 3 have one reading, 1 and 2 have two.
    order = SkinOrder([[0, 3], [1, 2]], [1, 2], in_keys=["a", "b"])
    one, two = torch.tensor([[0, 30]]), torch.tensor([[10, 11, 20, 21]])
    (signal,) = order.compute(one, two)
    assert signal.tolist() == [[0, 10, 11, 20, 21, 30]]


def localize(base_pose, centres, detected) -> list[float]:
    pose = torch.zeros(1, len(centres), 7, dtype=torch.float64)
    pose[0, :, :3] = torch.tensor(centres)
    (signal,) = Localization().compute(
        torch.tensor([base_pose], dtype=torch.float64),
        pose,
        torch.zeros(1, 4, dtype=torch.float64),
        torch.tensor([detected]),
    )
    return signal[0].tolist()


UPRIGHT = [0.0, 0, 0, 1, 0, 0, 0]


def test_localization_is_relative_to_the_base():
    base = [1.0, 2, 3, 1, 0, 0, 0]
    assert localize(base, [(2.0, 2, 2.5)], [True]) == [1, 0, -0.5]


def test_localization_turns_with_the_base():
    # Base at (1, 0, 1), turned +90 deg about z: its x axis is the world's y, its y
    # axis the world's -x. A ball 2 m to the world's y is 2 m ahead.
    base = [1.0, 0, 1, HALF, 0, 0, HALF]
    assert localize(base, [(1.0, 2, 1)], [True]) == pytest.approx([2, 0, 0])
    assert localize(base, [(0.0, 0, 1)], [True]) == pytest.approx([0, 1, 0])
    # Pitched +90 deg about y (nose down): its x axis is the world's -z, its z the x.
    base = [0.0, 0, 0, HALF, 0, HALF, 0]
    assert localize(base, [(3.0, 1, -2)], [True]) == pytest.approx([2, 1, 3])


def test_localization_is_zero_if_nothing_is_detected():
    assert localize(UPRIGHT, [(1.0, 0, 0), (2.0, 0, 0)], [False, False]) == [0, 0, 0]


def test_localization_gives_the_detected_ball_nearest_to_the_base():
    balls = [(0.0, 3, 0), (1.0, 0, 0), (0.0, 0, 2)]
    assert localize(UPRIGHT, balls, [True, True, True]) == [1, 0, 0]
    assert localize(UPRIGHT, balls, [True, False, True]) == [0, 0, 2]
    assert localize(UPRIGHT, balls, [True, False, False]) == [0, 3, 0]


def test_localization_ignores_an_undetected_ball_wherever_it_is():
    balls = [(0.0, 3, 0), (0.0, 0, 1000)]
    assert localize(UPRIGHT, balls, [True, False]) == [0, 3, 0]


def test_localization_turns_with_a_base_of_any_length_but_zero():
    for length in (0.5, 3.0):
        base = [1.0, 0, 1, length * HALF, 0, 0, length * HALF]
        assert localize(base, [(1.0, 2, 1)], [True]) == pytest.approx([2, 0, 0])
    signal = localize([0.0] * 7, [(1.0, 2, 1)], [True])
    assert all(map(math.isnan, signal))


def test_localization_of_an_object_turned_by_nan_is_nan():
    pose = torch.tensor([[[5.0, 0, 0, 1, 0, math.nan, 0]]])
    base, joints = torch.tensor([UPRIGHT]), torch.zeros(1, 4)
    (signal,) = Localization().compute(base, pose, joints, torch.tensor([[True]]))
    assert signal.isnan().all()


def test_localization_in_a_row_of_nan_is_nan():
    pose = torch.tensor([[[1.0, 0, 0, 1, 0, 0, 0]]]).expand(3, -1, -1)
    base = torch.tensor([UPRIGHT]).repeat(3, 1)
    joints = torch.zeros(3, 4)
    base[0, 1], joints[1, 2] = math.nan, math.nan
    detected = torch.ones(3, 1, dtype=torch.bool)
    localization = Localization()
    (signal,) = localization.compute(base, pose, joints, detected)
    assert signal[:2].isnan().all()
    assert signal[2].tolist() == [1, 0, 0]
    # The signal does not depend on the position of undetected objects.
    (signal,) = localization.compute(base, pose, joints, ~detected)
    assert signal.tolist() == [[0] * 3] * 3
