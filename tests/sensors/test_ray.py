"""Ray sensors compared with MuJoCo's rays; culling must not change results."""

from __future__ import annotations

import math
from dataclasses import replace

import mujoco
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from egoskin.robots.builtin import H1_2
from egoskin.robots.chains import build_chain
from egoskin.robots.kinematics import rotate
from egoskin.sensors import BeamMinimum, Field, FieldSensor, Ray, RaySensor, Skin
from egoskin.shapes import Box, Sphere, shape_of
from sensing import (
    KEYS,
    KINDS,
    SEED,
    SHAPES,
    DenseRaySensor,
    along_axes,
    assert_same_bits,
    assert_same_bits_in_any_batch,
    look,
    looking_up,
    measure,
    placed_by_mujoco,
    turned,
)

RANGE = 1.5
every_shape = pytest.mark.parametrize("shape", SHAPES, ids=KINDS)
SMALL = Ray(grid=(4, 4))


def draw_skin(skin: Skin, rng) -> Skin:
    """The skin with ranges, rolls, views and measures drawn for each sensor."""
    rays = [
        SMALL,
        Ray(grid=(4, 4), fov_deg=rng.uniform(10, 170), measure="depth"),
        Ray(grid=(2, 8), fov_deg=rng.uniform(10, 120)),
    ]
    return replace(
        skin,
        # A file may round its normals to three digits.
        normal=skin.normal.round(3),
        coverage=tuple(rays[i] for i in rng.integers(len(rays), size=len(skin))),
        range=np.exp(rng.uniform(math.log(0.1), math.log(4), len(skin))),
        roll_deg=rng.uniform(-180, 180, len(skin)),
    )


# --- MuJoCo as the oracle -------------------------------------------------------


def scene(sizes: np.ndarray) -> mujoco.MjModel:
    """The robot in group 0, and one object of each kind in groups 1 to 4."""
    # Recompiled for every size: MuJoCo computes its ray culling bounds there.
    spec = H1_2.spec()
    for group, (kind, size) in enumerate(zip(KINDS, sizes, strict=True), 1):
        body = spec.worldbody.add_body(name=kind, mocap=True)
        shape_of(kind, size).add_geom(body, group=group)
    return spec.compile()


def mujoco_rays(model, skin, state) -> np.ndarray:
    """First surface along each beam [m], inf for none, ``[n, S, K, O]``."""
    data = mujoco.MjData(model)
    frames = skin.rotation()
    result = np.full((len(state), len(skin), 16, len(KINDS)), np.inf)
    hit, geom = np.zeros(16), np.zeros(16, np.int32)
    for row, s, turn, place in placed_by_mujoco(model, data, skin, state):
        beams = skin.coverage[s].directions()
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
    # Checked against MuJoCo in the field tests: a sensor inside reads 0.
    shapes = [shape_of(kind, size) for kind, size in zip(KINDS, sizes, strict=True)]
    plain = replace(skin, coverage=(), range=np.empty(0))
    state = state.clone()
    state["object_active"][:] = True
    sensor = FieldSensor(plain, H1_2.chain, shapes, math.inf, per_object=True)
    return measure(sensor, state)[0].numpy()


@given(SEED, st.sampled_from([torch.float32, torch.float64]))
def test_hits_are_those_of_mujoco(skin, random_state, seed, dtype):
    rng = np.random.default_rng(seed)
    mixed = draw_skin(skin.select(rng.permutation(len(skin))[:16]), rng)
    sizes = np.exp(rng.uniform(math.log(0.03), 0, (len(KINDS), 3)))
    objects = [shape_of(k, s) for k, s in zip(KINDS, sizes, strict=True)]
    state = turned(random_state(6, seed, dtype, objects=4), seed)
    hits = {}
    # .2 mm is what a grazing beam may miss by, 1e-5 m what rounding may decide.
    for by in (-2e-4, -1e-5, 1e-5, 2e-4, 0.0):
        hits[by] = mujoco_rays(scene(sizes + by), mixed, state)
    truth = hits[0.0]
    away = inside(sizes, mixed, state)[:, :, None]
    truth = np.where(away == 0, 0, truth)
    slant = np.stack([r.directions()[:, 2] for r in mixed.coverage])
    depth = np.array([r.measure == "depth" for r in mixed.coverage])[:, None]
    slant = np.where(depth, slant, 1.0)[..., None]
    truth = truth * slant
    limit = mixed.range[:, None, None]
    active = state["object_active"][:, None, None].numpy()
    expected = np.where((truth > limit) | ~active, np.inf, truth)

    # Constants as precise as the inputs.
    chain = build_chain(H1_2.model, H1_2.base, dtype)
    sensor = RaySensor(mixed, chain, objects, 9, per_object=True)
    distance, detected = measure(sensor, state)
    assert distance.dtype == dtype
    assert distance.shape == (6, 16, 16, 4)
    distance = distance.numpy()
    # On the surface, MuJoCo may start inside or outside.
    surface = np.broadcast_to((away > 0) & (away < 1e-5), truth.shape)
    decided = (np.isfinite(hits[-1e-5]) == np.isfinite(hits[1e-5])) | (away == 0)
    decided = decided & ~surface & ~(np.abs(truth - limit) < 1e-5)
    np.testing.assert_array_equal(
        np.isfinite(distance)[decided], np.isfinite(expected)[decided]
    )
    grazing = np.isfinite(hits[2e-4]) & ~np.isfinite(hits[-2e-4]) & (away > 0)
    both = np.isfinite(distance) & np.isfinite(expected) & ~surface
    error = np.abs(np.where(both, distance, 0) - np.where(both, expected, 0))
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


def test_grazing_beams_are_right_to_a_millimetre(skin, random_state):
    # A ball for each row, .2 mm at most from touching one beam of one sensor.
    rng, n, radius = np.random.default_rng(1), 2000, 0.3
    state = random_state(n, seed=1, objects=1)
    state["object_active"][:] = True
    chain = build_chain(H1_2.model, H1_2.base, torch.float64)
    sensor = RaySensor(skin, chain, [Sphere(radius=radius)], 9, SMALL)
    position, rotation = sensor.poses_b(state["joint_pos"].double())
    rows, s, k = np.arange(n), rng.integers(64, size=n), rng.integers(16, size=n)
    beam = torch.from_numpy(SMALL.directions()[k])
    base, quat = state["base_pose"].double().split((3, 4), -1)
    place = base + rotate(quat, position[rows, s])
    way = rotate(quat, (rotation[rows, s] @ beam[..., None])[..., 0])
    across = torch.linalg.cross(way, torch.from_numpy(rng.normal(size=(n, 3))))
    across /= across.norm(dim=-1, keepdim=True)
    depth = torch.from_numpy(rng.uniform(-2e-4, 2e-4, (n, 1)))
    along = torch.from_numpy(rng.uniform(0.5, 3, (n, 1)))
    centre = place + along * way + (radius - depth) * across
    state["object_pose"][:, 0, :3] = centre.float()

    def mujoco_hit(row: int, by: float) -> float:
        hit = mujoco.mju_rayGeom(
            state["object_pose"][row, 0, :3].double().numpy(),
            np.eye(3).ravel(),
            np.full(3, radius + by),
            place[row].numpy(),
            way[row].numpy(),
            mujoco.mjtGeom.mjGEOM_SPHERE,
            None,
        )
        return hit if hit >= 0 else math.inf

    smaller, truth, larger = (
        np.array([mujoco_hit(row, by) for row in rows]) for by in (-1e-5, 0, 1e-5)
    )
    distance = measure(sensor, state)[0][rows, s, k].numpy()
    decided = np.isfinite(smaller) == np.isfinite(larger)
    np.testing.assert_array_equal(
        np.isfinite(distance)[decided], np.isfinite(truth)[decided]
    )
    both = np.isfinite(distance) & np.isfinite(truth)
    assert 0.3 < both.mean() < 0.7
    np.testing.assert_allclose(distance[both], truth[both], 0, 1e-3)


# --- one sensor, by hand --------------------------------------------------------


def one_sensor(max_range, objects, coverage=None, roll_deg=0.0, **options) -> RaySensor:
    """A sensor at the origin of the base, looking up."""
    skin = looking_up(roll_deg)
    return RaySensor(skin, H1_2.chain, objects, max_range, coverage, **options)


ONE = Ray(grid=(1, 1))
BALL = (Sphere(radius=0.25),)
WALL = (Box(half_extents=(9, 9, 0.25)),)
INF = math.inf


def test_a_beam_reads_the_distance_along_itself():
    # Straight ahead: 1.75 - .25. Beside the centre by .15: the ball is met at
    # sqrt(.25^2 - .15^2) = .2 below its centre.
    assert look(one_sensor(9, BALL, ONE), (0, 0, 1.75)) == ([1.5], [True])
    found, _ = look(one_sensor(9, BALL, ONE), (0.15, 0, 1.75))
    assert found == pytest.approx([1.55])
    assert look(one_sensor(9, BALL, ONE), (0.26, 0, 1.75)) == ([INF], [False])


def test_depth_is_the_component_along_the_normal():
    # A level wall at 1 m: every depth is 1, the corner beam 1 / cos(28.2 deg) long.
    # tan^2 = 2 * .37916^2 = .28752, sqrt(1 + .28752) = 1.13469
    beam, _ = look(one_sensor(9, WALL), (0, 0, 1.25))
    assert beam[0] == beam[63] == pytest.approx(1.13469, abs=1e-5)
    assert min(beam) > 1
    depth, _ = look(one_sensor(9, WALL, Ray(measure="depth")), (0, 0, 1.25))
    assert depth == pytest.approx([1] * 64)
    # It is the depth that must be in range, however long the beam.
    limited = one_sensor(1.0625, WALL, Ray(measure="depth"))
    assert look(limited, (0, 0, 1.25))[0] == pytest.approx([1] * 64)
    assert look(one_sensor(1.0625, WALL), (0, 0, 1.25))[0][0] == INF
    # A ball at the end of the longest beam is not culled: its depth is in range.
    wide = Ray(grid=(1, 2), fov_deg=along_axes(170), measure="depth")
    # tan(85 deg) / 2 = 5.715: at depth 1 the beam is 5.802 m long.
    ball = (Sphere(radius=0.01),)
    found, _ = look(one_sensor(1, ball, wide), (0.99 * 5.71503, 0, 0.99))
    assert found == [INF, pytest.approx(0.99, abs=0.01)]


def test_the_range_itself_counts_as_hit():
    for found, limit in (([1.5], 1.5), ([INF], 1.5 - 2**-20)):
        sensor = one_sensor(limit, BALL, ONE)
        assert look(sensor, (0, 0, 1.75)) == (found, [found != [INF]])


def test_rows_look_along_y_and_columns_along_x():
    # Sensor frame of an upward normal: x and y of the base. 90 deg along each axis,
    # 2 x 4 beams: tangents -.75 -.25 .25 .75 in x and -.5 .5 in y.
    view = Ray(grid=(2, 4), fov_deg=along_axes(90))
    ball = (Sphere(radius=0.1),)
    place = (0.75, -0.5, 1)
    hit = math.hypot(*place) - 0.1
    found, _ = look(one_sensor(9, ball, view), place)
    assert found == [INF, INF, INF, pytest.approx(hit), INF, INF, INF, INF]
    # Rolled by +90 deg about z, x looks along the base's y and y along its -x.
    found, _ = look(one_sensor(9, ball, view, 90), (0.5, 0.75, 1))
    assert found == [INF, INF, INF, pytest.approx(hit), INF, INF, INF, INF]


@every_shape
def test_inside_an_object_every_beam_reads_zero(shape):
    found, detected = look(one_sensor(1, (shape,)), (0.01, -0.02, 0.05))
    assert (found, detected) == ([0] * 64, [True])


@every_shape
def test_an_object_behind_the_sensor_is_not_seen(shape):
    for place in ((0, 0, -0.5), (0, 0, -3), (0.3, 0, -0.45)):
        assert look(one_sensor(9, (shape,)), place) == ([INF] * 64, [False])


def test_beams_along_the_faces_of_a_box():
    # Straight up beside a box, on its face, and in it; the face belongs to the box.
    box = (Box(half_extents=(0.25, 0.5, 0.125)),)
    for x, found in ((0.25 - 2**-20, 0.875), (0.25, 0.875), (0.25 + 2**-20, INF)):
        for place in ((x, 0, 1), (-x, 0.5, 1)):
            assert look(one_sensor(9, box, ONE), place)[0] == [found]


def test_the_nearest_of_several_objects_is_measured():
    objects = (*BALL, Box(half_extents=(0.1, 0.1, 0.5)))
    places = ((0, 0, 1.75), (0, 0, 2.25))
    assert look(one_sensor(9, objects, ONE), *places) == ([1.5], [True, True])
    places = ((0, 0, 1.75), (0, 0, 1.25))
    assert look(one_sensor(9, objects, ONE), *places) == ([0.75], [True, True])
    apart = one_sensor(1, objects, ONE, per_object=True)
    assert look(apart, *places) == ([[INF, 0.75]], [False, True])


# --- bit-identical results ------------------------------------------------------


@pytest.fixture(scope="module")
def crowd(skin, random_state):
    """(sensors of all sorts, states with objects near and far, some NaN)."""
    mixed = draw_skin(skin, np.random.default_rng(2))
    state = turned(random_state(101, seed=2, objects=4), 2)
    state["object_pose"][::3, :, :3] *= 3
    state["joint_pos"][7, 3] = state["object_pose"][8, 1, 5] = math.nan
    return mixed, state


@pytest.mark.parametrize("reduce", ["none", "min"])
@pytest.mark.parametrize("per_object", [False, True])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_culled_is_dense(crowd, reduce, per_object, dtype):
    mixed, state = crowd
    state = state.apply(lambda x: x.to(dtype) if x.is_floating_point() else x)
    options = {"reduce": reduce, "per_object": per_object}
    culled, dense = (
        kind(mixed, H1_2.chain, SHAPES, RANGE, **options)
        for kind in (RaySensor, DenseRaySensor)
    )
    result = measure(culled, state)
    assert_same_bits(result, measure(dense, state))
    assert 0.001 < result[0].isfinite().float().mean() < 0.5


@given(SEED)
def test_culled_is_dense_wherever_objects_are(skin, random_state, seed):
    rng = np.random.default_rng(seed)
    mixed = draw_skin(skin.select(rng.permutation(len(skin))[:16]), rng)
    sizes = np.exp(rng.uniform(math.log(0.03), 0, (len(KINDS), 3)))
    objects = [shape_of(k, s) for k, s in zip(KINDS, sizes, strict=True)]
    state = turned(random_state(8, seed, objects=4), seed)
    culled, dense = (
        measure(kind(mixed, H1_2.chain, objects, RANGE), state)
        for kind in (RaySensor, DenseRaySensor)
    )
    assert_same_bits(culled, dense)


@given(SEED, st.floats(0.05, 3))
def test_a_range_only_cuts_off(skin, random_state, seed, max_range):
    # Without a range no row is left out: everything is computed.
    state = turned(random_state(8, seed, objects=4), seed)
    state["object_pose"][..., :3] *= 3
    few, rays = skin.select(range(0, 64, 5)), Ray(grid=(4, 4), measure="depth")
    full, short = (
        measure(kind(few, H1_2.chain, SHAPES, r, rays), state)[0]
        for kind, r in ((DenseRaySensor, INF), (RaySensor, max_range))
    )
    limit = torch.tensor(max_range, dtype=torch.float32)
    assert torch.equal(short, full.masked_fill(full > limit, INF))


def test_reduced_is_the_minimum_of_the_grid(crowd):
    mixed, state = crowd
    grid, detected = measure(RaySensor(mixed, H1_2.chain, SHAPES, RANGE), state)
    least = measure(RaySensor(mixed, H1_2.chain, SHAPES, RANGE, reduce="min"), state)
    assert_same_bits(least, (grid.amin(-1), detected))
    assert_same_bits(least[:1], BeamMinimum().compute(grid))


def test_a_row_has_the_same_bits_in_any_batch(crowd):
    mixed, state = crowd
    sensor = RaySensor(mixed, H1_2.chain, SHAPES, RANGE)
    assert_same_bits_in_any_batch(sensor, state)


def test_readings_go_into_a_tensor_that_exists(crowd):
    mixed, state = crowd
    for per_object in (False, True):
        sensor = RaySensor(mixed, H1_2.chain, SHAPES, RANGE, per_object=per_object)
        expected = measure(sensor, state)
        out = torch.full((*[4] * per_object, 101, 64, 16), math.nan)
        result = sensor.compute(*(state[key] for key in KEYS), out=out)
        assert_same_bits(result, expected)
        assert result[0].data_ptr() == out.data_ptr()
    scattered = torch.empty(64, 101, 16).transpose(0, 1)
    sensor = RaySensor(mixed, H1_2.chain, SHAPES, RANGE)
    with pytest.raises(ValueError, match=r"out must be .*, contiguous"):
        sensor.compute(*(state[key] for key in KEYS), out=scattered)


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
@pytest.mark.parametrize("body", [(), H1_2.primitives], ids=["transparent", "solid"])
def test_a_gpu_measures_the_same(crowd, body):
    mixed, state = crowd
    state = state.apply(lambda x: x.double() if x.is_floating_point() else x)
    sensor = RaySensor(mixed, H1_2.chain, SHAPES, RANGE, body=body)
    distance, detected = measure(sensor, state)
    other, other_detected = measure(sensor.to("cuda"), state.to("cuda"))
    torch.testing.assert_close(other.cpu(), distance, rtol=0, atol=1e-9, equal_nan=True)
    assert torch.equal(other_detected.cpu(), detected)


# --- errors ---------------------------------------------------------------------


def test_sensors_of_different_numbers_of_beams_are_refused(skin):
    mixed = replace(skin, coverage=(Ray(),) * 63 + (SMALL,))
    with pytest.raises(ValueError, match=r"same number of beams; got grids \(8, 8\), "):
        RaySensor(mixed, H1_2.chain, SHAPES, RANGE)


def test_a_field_is_refused(skin):
    mixed = replace(skin, coverage=(None, Field()) + (None,) * 62)
    with pytest.raises(ValueError, match=r"sensor 1 is a Field, not a Ray; .*select"):
        RaySensor(mixed, H1_2.chain, SHAPES, RANGE)


def test_an_unknown_reduction_is_refused(skin):
    with pytest.raises(ValueError, match="reduce must be 'none' or 'min', got 'max'"):
        RaySensor(skin, H1_2.chain, SHAPES, RANGE, reduce="max")


@pytest.mark.parametrize("max_range", [0.0, -1.0, math.nan])
def test_a_range_that_is_not_positive_is_refused(skin, max_range):
    with pytest.raises(ValueError, match="max_range must be positive, got"):
        RaySensor(skin, H1_2.chain, SHAPES, max_range)
