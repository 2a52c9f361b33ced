"""Helpers for the sensor tests: shapes, measuring, rotations, bit equality."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import mujoco
import numpy as np
import torch
from hypothesis import strategies as st

from egoskin.robots.builtin import H1_2
from egoskin.sensors import Field, FieldSensor, Ray, RaySensor, Skin
from egoskin.sensors.kernels.binding import Kernels
from egoskin.shapes import Box, Capsule, Ellipsoid, Sphere

KINDS = ("sphere", "box", "capsule", "ellipsoid")
SHAPES = (
    Sphere(radius=0.25),
    Box(half_extents=(0.1, 0.2, 0.3)),
    Capsule(radius=0.1, half_length=0.3),
    Ellipsoid(semi_axes=(0.4, 0.1, 0.25)),
)
"""One of each of `KINDS`."""
KEYS = ("base_pose", "joint_pos", "object_pose", "object_active")
"""What a sensor reads, in the order of its `compute`."""
BALLS = (Sphere(radius=0.15), Sphere(radius=0.4), Sphere(radius=0.02))
SEED = st.integers(0, 2**32 - 1)


class DenseRaySensor(RaySensor):
    """A ray sensor that computes all pairs of sensor and object."""

    def _margin(self, view, shape, skin):
        # 1, or NaN where the object's place is unknown.
        return 1.0 + 0.0 * (view.centre[:, self._link] - skin["offset"]).sum(0)


def along_axes(angle: float) -> float:
    """A square view's angle from corner to corner, from that along an axis [deg]."""
    tangent = math.tan(math.radians(angle) / 2)
    return 2 * math.degrees(math.atan(math.sqrt(2) * tangent))


def looking_up(roll_deg: float = 0.0) -> Skin:
    """One sensor, at the origin of the base."""
    return Skin(
        robot="h1_2",
        links=("pelvis",),
        position=np.zeros((1, 3)),
        normal=np.array([[0.0, 0, 1]]),
        roll_deg=np.array([roll_deg]),
    )


def look(sensor, *centres, active=None, quat=(1, 0, 0, 0)):
    """(distance ``[K]``, detected) for objects at places, base at the origin."""
    pose = torch.zeros(1, len(centres), 7, dtype=torch.float64)
    pose[0, :, :3] = torch.tensor(centres, dtype=torch.float64)
    pose[0, :, 3:] = torch.tensor(quat, dtype=torch.float64)
    distance, detected = sensor.compute(
        torch.tensor([[0, 0, 0, 1, 0, 0, 0]], dtype=torch.float64),
        torch.zeros(1, len(H1_2.joints), dtype=torch.float64),
        pose,
        torch.tensor([active or [True] * len(centres)]),
    )
    return distance[0, 0].tolist(), detected[0].tolist()


def draw_fields(rng) -> list[Field]:
    """One or two kinds of field."""
    wide, narrow = Field(), Field(half_angle_deg=rng.uniform(5, 175))
    return ([wide], [wide, narrow])[rng.integers(2)]


def draw_rays(rng) -> list[Ray]:
    """One or two kinds of grid, with as many beams."""
    grid = [(4, 4), (8, 8), (3, 5)][rng.integers(3)]
    return [
        Ray(grid=grid),
        Ray(grid=grid, fov_deg=rng.uniform(10, 170), measure="depth"),
    ][: rng.integers(1, 3)]


def draw_coverages(skin: Skin, coverages, rng) -> Skin:
    """Some sensors, with ranges, rolls and coverages drawn for each."""
    some = skin.select(rng.permutation(len(skin))[: rng.integers(1, 40)])
    rolls, kinds = rng.uniform(-180, 180, len(some)), len(coverages)
    return replace(
        some,
        coverage=tuple(coverages[i] for i in rng.integers(kinds, size=len(some))),
        range=np.exp(rng.uniform(math.log(0.1), math.log(4), len(some))),
        roll_deg=rolls,
    )


def draw_balls(random_state, rng):
    """(balls, state): one to three balls, near and far, some in play, some NaN."""
    count, rows = rng.integers(1, 4), rng.integers(1, 50)
    state = random_state(rows, int(rng.integers(1000)), objects=count)
    state["object_pose"][::3, :, :3] *= 3
    for key in ("base_pose", "joint_pos", "object_pose"):
        if rng.random() < 0.3:
            flat = state[key].view(rows, -1)
            flat[rng.integers(rows), rng.integers(flat.shape[1])] = math.nan
    return BALLS[:count], state


def check_fields(pair, skin, random_state, seed, per_object):
    """Assert that a pair of field sensors has the same bits; return it, and a state."""
    rng = np.random.default_rng(seed)
    coverages = draw_fields(rng)
    balls, state = draw_balls(random_state, rng)
    some = draw_coverages(skin, coverages, rng)
    plain, fast = pair(FieldSensor, some, H1_2.chain, balls, 1.0, per_object=per_object)
    assert_same_bits(measure(fast, state), measure(plain, state))
    return plain, fast, state


def check_rays(pair, skin, random_state, seed, reduce, per_object) -> None:
    """Assert that a pair of ray sensors has the same bits."""
    rng = np.random.default_rng(seed)
    coverages = draw_rays(rng)
    balls, state = draw_balls(random_state, rng)
    plain, fast = pair(
        RaySensor,
        *(draw_coverages(skin, coverages, rng), H1_2.chain, balls, 1.0),
        reduce=reduce,
        per_object=per_object,
    )
    assert_same_bits(measure(fast, state), measure(plain, state))
    if reduce == "none" and not per_object:
        inputs = [state[key] for key in KEYS]
        assert_same_bits(fast.hits(*inputs), plain.hits(*inputs))


def sliced_inputs(random_state) -> list[torch.Tensor]:
    """Inputs for one object that are slices of larger tensors, with strides."""
    state = random_state(90, seed=3, objects=2)[::3]
    inputs = [state[key] for key in KEYS]
    inputs[2:] = [x[:, :1] for x in inputs[2:]]
    inputs[1] = inputs[1].t().contiguous().t()
    return inputs


def measure(sensor, state):
    """(distance, detected) of a state."""
    return sensor.compute(*(state[key] for key in KEYS))


def placed_by_mujoco(model, data, skin, state):
    """Yield (row, sensor, rotation of its link, place) as MuJoCo places the robot.

    The state's objects are the model's mocap bodies; ``data`` is that of the row.
    """
    for row, values in enumerate(state.unbind(0)):
        data.qpos[:7] = values["base_pose"]
        data.qpos[7:] = values["joint_pos"]
        data.mocap_pos[:] = values["object_pose"][:, :3]
        data.mocap_quat[:] = values["object_pose"][:, 3:]
        mujoco.mj_kinematics(model, data)
        for s, link in enumerate(skin.links):
            turn = data.body(link).xmat.reshape(3, 3)
            yield row, s, turn, data.body(link).xpos + turn @ skin.position[s]


def turned(state, seed: int):
    """The state with its objects at random orientations."""
    rng = np.random.default_rng(seed)
    quat = torch.from_numpy(rng.normal(size=(*state["object_active"].shape, 4)))
    quat = torch.nn.functional.normalize(quat, dim=-1)
    pose = state["object_pose"]
    return state.set("object_pose", torch.cat((pose[..., :3], quat.to(pose)), -1))


def assert_same_bits(one, other) -> None:
    """Equal, NaN with NaN."""
    for a, b in zip(one, other, strict=True):
        torch.testing.assert_close(a, b, rtol=0, atol=0, equal_nan=True)


def assert_same_bits_in_any_batch(sensor, state) -> None:
    """Assert that a row's readings do not depend on the other rows."""
    whole = measure(sensor, state)
    for size in (1, 5, 27, 32):
        for start in (0, 3, 69):
            rows = slice(start, start + size)
            assert_same_bits(measure(sensor, state[rows]), [x[rows] for x in whole])


def use_warp_kernels(monkeypatch) -> None:
    """Let sensors and draws use the kernels of a GPU, on Warp's CPU device."""
    for module in ("egoskin.rng", "egoskin.robots.kinematics"):
        monkeypatch.setattr(f"{module}.uses_warp", lambda *inputs: True)
    here = torch.device("cpu")
    monkeypatch.setattr(Kernels, "can", lambda self, *_: True)
    for name in ("measure", "hits"):

        def call(self: Kernels, *args: Any, name: str = name) -> Any:
            return getattr(self.on(here), name)(*args)

        monkeypatch.setattr(Kernels, name, call)
