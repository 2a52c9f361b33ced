"""Ray sensors against MuJoCo's rays, and what culling and compiling may not change."""

from __future__ import annotations

import math
from dataclasses import replace

import mujoco
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from egoskin.robots import H1_2, build_chain
from egoskin.sensors import FieldSensor, Ray, RaySensor, Skin
from egoskin.shapes import Box, Capsule, Ellipsoid, Sphere, shape_of

RANGE = 1.5
KINDS = ("sphere", "box", "capsule", "ellipsoid")
SHAPES = (
    Sphere(radius=0.25),
    Box(half_extents=(0.1, 0.2, 0.3)),
    Capsule(radius=0.1, half_length=0.3),
    Ellipsoid(semi_axes=(0.4, 0.1, 0.25)),
)
every_shape = pytest.mark.parametrize("shape", SHAPES, ids=KINDS)
KEYS = ("base_pose", "joint_pos", "object_pose", "object_active")
SEED = st.integers(0, 2**32 - 1)
SMALL = Ray(grid=(4, 4))


def measure(sensor, state):
    """(distance, detected) of a state."""
    return sensor.compute(*(state[key] for key in KEYS))


def assert_same_bits(one, other):
    """Equal, NaN with NaN."""
    for a, b in zip(one, other, strict=True):
        torch.testing.assert_close(a, b, rtol=0, atol=0, equal_nan=True)


def turned(state, seed: int):
    """The state with its objects turned anyhow."""
    rng = np.random.default_rng(seed)
    quat = torch.from_numpy(rng.normal(size=(*state["object_active"].shape, 4)))
    quat = torch.nn.functional.normalize(quat, dim=-1)
    pose = state["object_pose"]
    return state.set("object_pose", torch.cat((pose[..., :3], quat.to(pose)), -1))


def draw_skin(skin: Skin, rng) -> Skin:
    """The skin with ranges, rolls, views and measures drawn for each sensor."""
    rays = [
        SMALL,
        Ray(grid=(4, 4), fov_deg=rng.uniform(10, 170), measure="depth"),
        Ray(grid=(2, 8), fov_deg=rng.uniform(10, 120), fov="axis"),
        Ray(grid=(8, 2), beams="edges"),
    ]
    return replace(
        skin,
        coverage=tuple(rays[i] for i in rng.integers(len(rays), size=len(skin))),
        range=np.exp(rng.uniform(math.log(0.1), math.log(4), len(skin))),
        roll_deg=rng.uniform(-180, 180, len(skin)),
    )


# --- MuJoCo as the oracle -------------------------------------------------------


@pytest.fixture(scope="module")
def scene() -> mujoco.MjModel:
    """The robot in group 0, and one object of each kind in groups 1 to 4."""
    spec = H1_2.spec()
    for group, shape in enumerate(SHAPES, 1):
        kind = KINDS[group - 1]
        body = spec.worldbody.add_body(name=kind, mocap=True)
        shape.add_geom(body, name=kind, group=group)
    return spec.compile()


def resize(model: mujoco.MjModel, sizes: np.ndarray, by: float = 0.0) -> None:
    """Set the lengths of the objects, and the bounds MuJoCo's rays are culled by."""
    for kind, size in zip(KINDS, sizes + by, strict=True):
        geom, bound = model.geom(kind).id, shape_of(kind, size).bounding_radius
        model.geom_size[geom] = size
        model.geom_rbound[geom] = bound
        model.geom_aabb[geom, 3:] = bound


def mujoco_rays(model, skin, state) -> np.ndarray:
    """First surface along each beam [m], inf for none, ``[n, S, K, O]``."""
    data = mujoco.MjData(model)
    frames = skin.rotation()
    result = np.full((len(state), len(skin), 16, len(KINDS)), np.inf)
    hit, geom = np.zeros(16), np.zeros(16, np.int32)
    for row, values in enumerate(state.unbind(0)):
        data.qpos[:7] = values["base_pose"]
        data.qpos[7:] = values["joint_pos"]
        data.mocap_pos[:] = values["object_pose"][:, :3]
        data.mocap_quat[:] = values["object_pose"][:, 3:]
        mujoco.mj_kinematics(model, data)
        for s, link in enumerate(skin.links):
            turn = data.body(link).xmat.reshape(3, 3)
            place = data.body(link).xpos + turn @ skin.position[s]
            beams = skin.coverage[s].directions()[:, 0]
            ways = (beams @ (turn @ frames[s]).T).ravel()
            for o in range(len(KINDS)):
                groups = np.arange(6) == o + 1
                mujoco.mj_multiRay(
                    model, data, place, ways, groups, 1, -1, geom, hit, None, 16, 1e9
                )
                result[row, s, :, o] = np.where(hit < 0, np.inf, hit)
    return result


def inside(sizes: np.ndarray, skin, state) -> np.ndarray:
    """Signed distance from each sensor to each object, by `egoskin` ``[n, S, O]``."""
    # Held to MuJoCo's in the tests of fields: a sensor inside reads 0 (row by row).
    shapes = [shape_of(kind, size) for kind, size in zip(KINDS, sizes, strict=True)]
    plain = replace(skin, coverage=(), range=np.empty(0))
    state = state.clone()
    state["object_active"][:] = True
    sensor = FieldSensor(plain, H1_2.chain, shapes, math.inf, per_object=True)
    return measure(sensor, state)[0].numpy()


@given(SEED, st.sampled_from([torch.float32, torch.float64]))
def test_hits_are_those_of_mujoco(skin, scene, random_state, seed, dtype):
    rng = np.random.default_rng(seed)
    mixed = draw_skin(skin.select(rng.permutation(len(skin))[:16]), rng)
    sizes = np.exp(rng.uniform(math.log(0.03), 0, (len(KINDS), 3)))
    objects = [shape_of(k, s) for k, s in zip(KINDS, sizes, strict=True)]
    state = turned(random_state(6, seed, dtype, objects=4), seed)
    hits = {}
    # .2 mm is what a grazing beam may miss by, 1e-5 m what rounding may decide.
    for by in (-2e-4, -1e-5, 1e-5, 2e-4, 0.0):
        resize(scene, sizes, by)
        hits[by] = mujoco_rays(scene, mixed, state)
    truth = hits[0.0]
    away = inside(sizes, mixed, state)[:, :, None]
    truth = np.where(away == 0, 0, truth)
    slant = np.stack([r.directions()[:, 0, 2] for r in mixed.coverage])
    depth = np.array([r.measure == "depth" for r in mixed.coverage])[:, None]
    slant = np.where(depth, slant, 1.0)[..., None]
    with np.errstate(invalid="ignore"):
        truth = truth * slant
    limit = mixed.range[:, None, None]
    active = state["object_active"][:, None, None].numpy()
    expected = np.where((truth > limit) | ~active, np.inf, truth)

    # Constants as exact as the inputs.
    chain = build_chain(H1_2.model, H1_2.base, dtype)
    sensor = RaySensor(mixed, chain, objects, 9, per_object=True)
    distance, detected = measure(sensor, state)
    assert distance.dtype == dtype
    assert distance.shape == (6, 16, 16, 4)
    distance = distance.numpy()
    # On the surface MuJoCo may start in or out.
    surface = np.broadcast_to((away > 0) & (away < 1e-5), truth.shape)
    decided = (np.isfinite(hits[-1e-5]) == np.isfinite(hits[1e-5])) | (away == 0)
    decided = decided & ~surface & ~(np.abs(truth - limit) < 1e-5)
    np.testing.assert_array_equal(
        np.isfinite(distance)[decided], np.isfinite(expected)[decided]
    )
    grazing = np.isfinite(hits[2e-4]) & ~np.isfinite(hits[-2e-4]) & (away > 0)
    both = np.isfinite(distance) & np.isfinite(expected) & ~surface
    error = np.abs(distance - expected, where=both, out=np.zeros_like(expected))
    print(
        dtype,
        error[~grazing].max(),
        error[grazing].max(initial=0),
        grazing.mean(),
        decided.mean(),
        both.mean(),
    )
    tolerance = (1e-5, 1e-3) if dtype == torch.float32 else (1e-8, 1e-6)
    assert error[~grazing].max() < tolerance[0]
    assert error[grazing].max(initial=0) < tolerance[1]
    assert decided.mean() > 0.99
    # An object is detected if any beam hits it.
    assert torch.equal(detected, torch.from_numpy(np.isfinite(distance).any((1, 2))))
