"""Fields and rays: bad input gives marked readings, inactive objects none."""

from __future__ import annotations

import math
from functools import partial

import pytest
import torch

from egoskin.robots.builtin import H1_2
from egoskin.sensors import FieldSensor, Ray, RaySensor
from egoskin.shapes import Sphere
from sensing import KEYS, SHAPES, DenseRaySensor, measure, turned

RANGE = 1.5
SMALL = partial(RaySensor, coverage=Ray(grid=(4, 4)))
every_kind = pytest.mark.parametrize(
    "kind",
    [FieldSensor, SMALL, partial(DenseRaySensor, coverage=Ray(grid=(4, 4)))],
    ids=["field", "ray", "dense ray"],
)


@pytest.mark.parametrize("key", KEYS[:3])
@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("body", [(), H1_2.primitives], ids=["transparent", "solid"])
@every_kind
def test_nan_anywhere_reads_nan(skin, random_state, kind, body, shape, key):
    state = random_state(8, seed=3, objects=2)
    state["object_active"][:] = True
    state["object_active"][6:, 1] = False
    few = skin.select(range(8))
    sensor = kind(few, H1_2.chain, (shape, shape), RANGE, body=body)
    clean, clean_detected = measure(sensor, state)
    number = state[key][0].numel()
    for i in range(0, number, 1 if number < 15 else 4):
        bad = state.clone()
        bad[key][1::2].view(4, -1)[:, i] = math.nan
        distance, detected = measure(sensor, bad)
        assert torch.equal(distance[::2], clean[::2])
        assert torch.equal(detected[::2], clean_detected[::2])
        # A bad pose is one object's; that of the second in row 7 is not in play.
        own = key == "object_pose"
        marked = [1, 3, 5] if own and i >= number // 2 else [1, 3, 5, 7]
        assert distance[marked].isnan().all()
        assert (detected[marked].sum(-1) >= 1).all()


@pytest.mark.parametrize("key", ["base_pose", "object_pose"])
@pytest.mark.parametrize("shape", SHAPES)
@every_kind
def test_a_quaternion_is_a_turn_whatever_its_length(
    skin, random_state, kind, shape, key
):
    state = random_state(8, seed=5, objects=2)
    state["object_active"][:] = True
    sensor = kind(skin.select(range(8)), H1_2.chain, (shape, shape), RANGE)
    exact, _ = measure(sensor, state)
    for length in (0.5, 1.008, 3.0):
        other = state.clone()
        other[key][..., 3:] *= length
        distance, _ = measure(sensor, other)
        assert torch.equal(distance.isinf(), exact.isinf())
        torch.testing.assert_close(distance, exact, atol=1e-5, rtol=0.0)
    # None at all is no turn, near or far; but a sphere needs none.
    state[key][1::2, ..., 3:] = 0.0
    state["object_pose"][5:, :, :2] += 50.0
    distance, _ = measure(sensor, state)
    needs_none = key == "object_pose" and isinstance(shape, Sphere)
    assert distance[1::2].isnan().all() != needs_none
    assert not distance[::2].isnan().any()


@every_kind
def test_poses_of_inactive_objects_are_not_looked_at(skin, random_state, kind):
    state = random_state(32, seed=4)
    parked = state.clone()
    parked["object_pose"][~state["object_active"]] = math.nan
    assert not state["object_active"].all()
    sensor = kind(skin, H1_2.chain, SHAPES[:2], RANGE)
    for a, b in zip(measure(sensor, parked), measure(sensor, state), strict=True):
        assert torch.equal(a, b)


@pytest.mark.parametrize("shape", SHAPES)
@every_kind
def test_gradients_are_those_of_finite_differences(skin, random_state, kind, shape):
    state = random_state(6, seed=1, dtype=torch.float64, objects=1)
    state["object_active"][:] = True
    sensor = kind(skin.select(range(0, 64, 4)), H1_2.chain, shape, 0.6)

    def read(*poses):
        distance, _ = sensor.compute(*poses, state["object_active"])
        return torch.where(distance.isinf(), 0.0, distance)

    poses = [turned(state, seed=2)[key].requires_grad_() for key in KEYS[:3]]
    assert 0 < (read(*poses) > 0).sum() < read(*poses).numel()
    assert torch.autograd.gradcheck(read, poses, fast_mode=True)
    # Readings that are kept have gradients, whatever else detects nothing.
    read(*poses).sum().backward()
    assert all(x.grad is not None and x.grad.isfinite().all() for x in poses)


@pytest.mark.parametrize(
    ("key", "change", "message"),
    [
        ("joint_pos", torch.Tensor.double, "floating-point type, got torch.float32, t"),
        ("joint_pos", torch.Tensor.int, "the same floating-point type"),
        ("object_active", torch.Tensor.float, "'object_active' must be bool"),
        ("object_active", lambda x: x[:, :1], "2 objects, but 'object_active' holds 1"),
        ("object_pose", lambda x: x[:, :1], "2 objects, but 'object_pose' holds 1"),
        ("object_pose", lambda x: x[..., :3], "'object_pose' must hold 7 num.*got 3"),
        ("base_pose", lambda x: x[:, :6], "'base_pose' must hold 7 numbers.*got 6"),
        ("base_pose", lambda x: x[:, None], r"must be \[\*B, 7\], got \[1, 7\] after"),
    ],
)
@every_kind
def test_inputs_of_a_wrong_form_are_refused(
    skin, random_state, kind, key, change, message
):
    state = random_state(4, seed=0, objects=2)
    state[key] = change(state[key])
    sensor = kind(skin, H1_2.chain, SHAPES[:2], RANGE)
    with pytest.raises(ValueError, match=message):
        measure(sensor, state)
    if isinstance(sensor, RaySensor):
        with pytest.raises(ValueError, match=message):
            sensor.hits(*(state[key] for key in KEYS))
