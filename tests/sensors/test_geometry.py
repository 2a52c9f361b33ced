"""Fields and rays: bad input gives marked readings, inactive objects none."""

from __future__ import annotations

import math
from functools import partial

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torch.autograd import forward_ad

from egoskin.robots.builtin import H1_2
from egoskin.robots.kinematics import rotate
from egoskin.sensors import FieldSensor, Ray, RaySensor, Skin
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


# Of PyTorch, at the first dual tensor.
@pytest.mark.filterwarnings("ignore:.*torch.jit.script")
@pytest.mark.parametrize("compile", [False, True])
@pytest.mark.parametrize("shape", SHAPES)
@every_kind
def test_forward_derivatives_are_those_of_finite_differences(
    skin, random_state, kind, shape, compile
):
    state = random_state(6, seed=1, dtype=torch.float64, objects=1)
    state["object_active"][:] = True
    sensor = kind(skin.select(range(0, 64, 4)), H1_2.chain, shape, 0.9, compile=compile)
    inputs = [state[key] for key in KEYS]
    change = torch.randn_like(inputs[1])

    def at(joint_pos):
        return sensor.compute(inputs[0], joint_pos, *inputs[2:])[0]

    with forward_ad.dual_level():
        dual = forward_ad.make_dual(inputs[1], change)
        primal, tangent = forward_ad.unpack_dual(at(dual))
    ends = [at(inputs[1] + sign * 1e-6 * change) for sign in (1, -1)]
    smooth = (ends[0] > 0) & (ends[1] > 0) & ends[0].isfinite() & ends[1].isfinite()
    assert smooth.sum() > 10
    assert torch.equal(primal, at(inputs[1]))
    expected = (ends[0] - ends[1])[smooth] / 2e-6
    # A few readings may change the face that they see.
    error = (tangent[smooth] - expected).abs()
    assert error.quantile(0.99) < 1e-5
    assert expected.abs().quantile(0.5) > 0.01


@pytest.mark.parametrize("body", [(), H1_2.primitives], ids=["free", "occluded"])
@pytest.mark.parametrize("shape", SHAPES)
@every_kind
def test_inactive_objects_do_not_change_gradients(
    skin, random_state, kind, shape, body
):
    state = random_state(16, seed=1, dtype=torch.float64)
    state["object_active"][:, 0], state["object_active"][:, 1] = True, False
    objects = (Sphere(radius=0.2), shape)
    sensor = kind(skin, H1_2.chain, objects, 2.0, body=body)

    def gradients(number: float | None) -> list[torch.Tensor]:
        poses = [state[key].clone() for key in KEYS[:3]]
        if number is not None:
            poses[2][:, 1] = number
        poses = [x.requires_grad_() for x in poses]
        distance, _ = sensor.compute(*poses, state["object_active"])
        distance[distance.isfinite()].sum().backward()
        return [x.grad for x in poses]

    expected = gradients(None)
    assert expected[1].abs().max() > 0.01
    for number in (0.0, 1.0, math.nan, math.inf):
        for a, b in zip(gradients(number), expected, strict=True):
            assert torch.equal(a, b), number


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
@pytest.mark.parametrize("shape", SHAPES)
@every_kind
def test_gradients_are_finite_where_the_distance_has_none(kind, shape, dtype):
    """Sensors at the centre of an object and on its surface, besides one far away."""
    position = np.array([[0.0, 0, 0], [shape.half_height, 0, 0], [0.3, 0, 0.6]])
    chain, links = H1_2.chain, ("pelvis",) * 3
    skin = Skin(robot="h1_2", links=links, position=position, normal=np.eye(3)[[0] * 3])
    sensor = kind(skin, chain, shape, 2.0)
    # The object's z axis points along the base's x axis.
    half = math.sqrt(0.5)
    inputs = [
        torch.tensor([[0.0, 0, 1, 1, 0, 0, 0]], dtype=dtype),
        torch.zeros(1, len(H1_2.joints), dtype=dtype),
        torch.tensor([[[0.0, 0, 1, half, 0, half, 0]]], dtype=dtype),
    ]
    poses = [x.requires_grad_() for x in inputs]
    distance, _ = sensor.compute(*poses, torch.ones(1, 1, dtype=torch.bool))
    assert distance[0, 0].max() == 0.0
    distance[distance.isfinite()].sum().backward()
    assert all(x.grad is not None and x.grad.isfinite().all() for x in poses)


@every_kind
def test_a_sensor_used_in_inference_mode_has_gradients_later(skin, random_state, kind):
    sensor = kind(skin, H1_2.chain, Sphere(radius=0.15), 5.0, compile=False)
    state = random_state(8, objects=1)
    with torch.inference_mode():
        sensor.compute(*(state[key] for key in KEYS))
    inputs = [state[key].clone() for key in KEYS]
    inputs[1].requires_grad_()
    distance = sensor.compute(*inputs)[0]
    distance[distance.isfinite()].sum().backward()
    assert inputs[1].grad is not None
    assert inputs[1].grad.any()


@pytest.mark.parametrize(
    ("key", "change", "message"),
    [
        ("joint_pos", torch.Tensor.double, "float64, got torch.float32, t"),
        ("joint_pos", torch.Tensor.half, "must all be float32 or all float64"),
        ("joint_pos", torch.Tensor.int, "must all be float32 or all float64"),
        ("object_active", torch.Tensor.float, "'object_active' must be bool"),
        ("object_active", lambda x: x[:, :1], "2 objects, but 'object_active' holds 1"),
        ("object_pose", lambda x: x[:, :1], "2 objects, but 'object_pose' holds 1"),
        ("object_pose", lambda x: x[..., :3], "'object_pose' must hold 7 num.*got 3"),
        ("base_pose", lambda x: x[:, :6], "'base_pose' must hold 7 numbers.*got 6"),
        ("base_pose", lambda x: x[:, None], r"must be \[\*B, 7\], got \[1, 7\] after"),
        ("joint_pos", lambda x: x[:, :3], r"'joint_pos' must hold 21 .*\(left_.*got 3"),
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


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            {"skin": "skin.json"},
            r"skin must be a Skin \(Skin.load for a file\), got str",
        ),
        ({"chain": H1_2}, r"chain must be .*Chain \(RobotConfig.chain\), got RobotCon"),
        ({"objects": Sphere}, "objects must be shapes"),
        ({"max_range": [1.0] * 64}, "one number, got .* belongs in Skin.range"),
        ({"max_range": "2"}, "max_range must be one number, got '2'"),
        ({"body": H1_2}, r"body must hold primitives \(RobotConfig.prim.*got RobotCon"),
        ({"in_keys": KEYS[:3]}, "in_keys must be a list of 4, got"),
        ({"out_keys": ["distance"]}, "out_keys must be a list of 2, got"),
        ({"out_keys": "ab"}, "out_keys must be a list of keys, got 'ab'"),
    ],
)
@pytest.mark.parametrize("kind", [FieldSensor, RaySensor])
def test_arguments_of_a_wrong_kind_are_refused(skin, kind, arguments, message):
    valid = {"skin": skin, "chain": H1_2.chain, "objects": SHAPES, "max_range": RANGE}
    with pytest.raises(ValueError, match=message):
        kind(**{**valid, **arguments})


class Pair:
    """Two balls of one radius, as an object of a class of one's own."""

    bounding_radius = 0.35

    def __init__(self):
        self._ball = Sphere(radius=0.15)

    def _least(self, method, x, *rest):
        return torch.minimum(*(method(x + shift, *rest) for shift in (-0.2, 0.2)))

    def signed_distance(self, x, y, z):
        return self._least(self._ball.signed_distance, x, y, z)

    def closest_point(self, x, y, z):
        a, b, c = self._ball.closest_point(x.abs() - 0.2, y, z)
        return torch.where(x < 0, -1.0, 1.0) * (a + 0.2), b, c

    def ray_interval(self, *line):
        enter, leave = (
            torch.stack(ends)
            for ends in zip(
                *(
                    self._ball.ray_interval(line[0] + shift, *line[1:])
                    for shift in (-0.2, 0.2)
                ),
                strict=True,
            )
        )
        # Of the two, the first that is not behind.
        first = torch.where(leave < 0, torch.inf, enter).argmin(0, keepdim=True)
        return enter.gather(0, first)[0], leave.gather(0, first)[0]


@pytest.mark.parametrize("kind", [FieldSensor, SMALL])
def test_an_object_may_be_of_a_class_of_ones_own(skin, random_state, kind):
    state = turned(random_state(32, seed=6, dtype=torch.float64, objects=1), seed=7)
    pose = state["object_pose"]
    shift = rotate(pose[..., 3:], pose.new_tensor([0.2, 0, 0]).expand(32, 1, 3))
    places = [pose[..., :3] + shift, pose[..., :3] - shift]
    both = torch.cat([torch.cat((p, pose[..., 3:]), -1) for p in places], 1)
    apart = state.clone().set("object_pose", both)
    apart["object_active"] = state["object_active"].expand(32, 2)
    distance, _ = measure(kind(skin, H1_2.chain, Pair(), RANGE), state)
    expected, _ = measure(
        kind(skin, H1_2.chain, [Sphere(radius=0.15)] * 2, RANGE), apart
    )
    assert 0 < expected.isfinite().sum() < expected.numel()
    torch.testing.assert_close(distance, expected, rtol=0, atol=1e-7)


@pytest.mark.parametrize("batch", [(), (3,), (2, 3)])
@pytest.mark.parametrize("kind", [FieldSensor, SMALL])
def test_a_robot_without_joints_has_any_batch(small_robot, kind, batch):
    sensor = kind(
        Skin(
            robot="small", links=("base",), position=[[0, 0, 0.1]], normal=[[0, 0, 1]]
        ),
        small_robot("<geom size='.1'/>").chain,
        Sphere(radius=0.2),
        RANGE,
    )
    pose = torch.tensor([0.0, 0, 0, 1, 0, 0, 0])
    state = TensorDict(
        base_pose=pose.expand(*batch, 7),
        joint_pos=torch.zeros(*batch, 0),
        object_pose=(pose + torch.eye(7)[2]).expand(*batch, 1, 7),
        object_active=torch.ones(*batch, 1, dtype=torch.bool),
        batch_size=batch,
    )
    least = sensor(state)["distance"].reshape(*batch, -1).amin(-1)
    torch.testing.assert_close(least, torch.full(batch, 0.7), rtol=0, atol=0.05)
