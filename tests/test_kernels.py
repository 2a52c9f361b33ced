"""The C++ kernels: the bits of the PyTorch code, which is tested against MuJoCo."""

from __future__ import annotations

import copy
import math
import pickle
from dataclasses import replace

import mujoco
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from egoskin.chains import build_chain
from egoskin.compilation import can_compile, load_library
from egoskin.robots import H1_2
from egoskin.sensors import Field, FieldSensor, Ray, RaySensor, Skin
from egoskin.shapes import Box, Sphere
from sensing import KEYS, SEED, assert_same_bits, measure

BALLS = (Sphere(radius=0.15), Sphere(radius=0.4), Sphere(radius=0.02))
DTYPES = st.sampled_from([torch.float32, torch.float64])
needs_compiler = pytest.mark.skipif(not can_compile(), reason="needs a C++ compiler")


def pair(kind, *args, **options):
    """The same sensor in PyTorch and in C++."""
    plain, fast = (kind(*args, **options, compile=c) for c in (False, True))
    assert plain._kernels is None
    assert fast._kernels is not None
    return plain, fast


def assert_same(fast, plain) -> None:
    """Equal; in float64 but for the last bit, which PyTorch's root does not round."""
    for a, b in zip(fast, plain, strict=True):
        atol = 1e-14 if a.dtype == torch.float64 else 0
        torch.testing.assert_close(a, b, rtol=0, atol=atol, equal_nan=True)


def draw(skin: Skin, coverages, rng) -> Skin:
    """Some sensors, with ranges, rolls and coverages drawn for each."""
    some = skin.select(rng.permutation(len(skin))[: rng.integers(1, 40)])
    rolls, kinds = rng.uniform(-180, 180, len(some)), len(coverages)
    return replace(
        some,
        coverage=tuple(coverages[i] for i in rng.integers(kinds, size=len(some))),
        range=np.exp(rng.uniform(math.log(0.1), math.log(4), len(some))),
        roll_deg=rolls,
    )


def draw_state(random_state, rng, dtype):
    """(balls, state): one to three balls, near and far, some in play, some NaN."""
    count, rows = rng.integers(1, 4), rng.integers(1, 50)
    state = random_state(rows, int(rng.integers(1000)), dtype, objects=count)
    state["object_pose"][::3, :, :3] *= 3
    for key in ("base_pose", "joint_pos", "object_pose"):
        if rng.random() < 0.3:
            flat = state[key].view(rows, -1)
            flat[rng.integers(rows), rng.integers(flat.shape[1])] = math.nan
    return BALLS[:count], state


@needs_compiler
@given(SEED, DTYPES, st.booleans())
def test_fields_have_the_same_bits(skin, random_state, seed, dtype, per_object):
    rng = np.random.default_rng(seed)
    wide, narrow = Field(), Field(half_angle_deg=rng.uniform(5, 175))
    centre = Field(half_angle_deg=rng.uniform(5, 175), measure="centre")
    coverages = ([wide], [wide, narrow], [wide, narrow, centre])[rng.integers(3)]
    balls, state = draw_state(random_state, rng, dtype)
    some = draw(skin, coverages, rng)
    plain, fast = pair(FieldSensor, some, H1_2.chain, balls, 1.0, per_object=per_object)
    assert_same(measure(fast, state), measure(plain, state))
    joints = state["joint_pos"]
    assert_same_bits(fast.poses_b(joints), plain.poses_b(joints))


@needs_compiler
@given(SEED, DTYPES, st.sampled_from(["none", "min"]), st.booleans(), st.booleans())
def test_rays_have_the_same_bits(
    skin, random_state, seed, dtype, reduce, per_object, cull
):
    rng = np.random.default_rng(seed)
    grid, sub_beams = [((4, 4), 1), ((8, 8), 1), ((3, 5), 1), ((3, 2), 3)][
        rng.integers(4)
    ]
    common = {"grid": grid, "sub_beams": sub_beams}
    coverages = [
        Ray(**common),
        Ray(**common, fov_deg=rng.uniform(10, 170), measure="depth"),
    ][: rng.integers(1, 3)]
    balls, state = draw_state(random_state, rng, dtype)
    plain, fast = pair(
        RaySensor,
        *(draw(skin, coverages, rng), H1_2.chain, balls, 1.0),
        reduce=reduce,
        per_object=per_object,
        cull=cull,
    )
    assert_same(measure(fast, state), measure(plain, state))
    if reduce == "none" and not per_object:
        inputs = [state[key] for key in KEYS]
        assert_same(fast.hits(*inputs), plain.hits(*inputs))


@needs_compiler
@pytest.mark.parametrize("per_object", [False, True])
@pytest.mark.parametrize("shift", [0, 4], ids=["whole lines", "shifted"])
def test_a_grid_larger_than_the_cache_has_the_same_bits(
    skin, random_state, per_object, shift
):
    state = random_state(2200, seed=1, objects=2)
    state["joint_pos"][7, 3] = math.nan
    inputs = [state[key] for key in KEYS]
    args = (skin, H1_2.chain, BALLS[:2], 1.0)
    plain, fast = pair(RaySensor, *args, per_object=per_object)
    expected = plain.compute(*inputs)
    size = expected[0].numel()
    assert 4 * size > 32 * 2**20
    buffer = torch.full((shift + size + 100,), -1.0)
    planes = (2, *expected[0].shape[:3]) if per_object else expected[0].shape
    out = buffer[shift : shift + size].view(planes)
    assert_same_bits(fast.compute(*inputs, out=out), expected)
    # Nothing is written beside it.
    assert (buffer[:shift] == -1).all()
    assert (buffer[shift + size :] == -1).all()


@needs_compiler
def test_many_hits_find_room(skin, random_state):
    # From within a ball every beam hits: more than the first call has room for.
    plain, fast = pair(RaySensor, skin, H1_2.chain, [Sphere(radius=3)], math.inf)
    inputs = [random_state(5, objects=1)[key] for key in KEYS]
    inputs[3] = torch.ones_like(inputs[3])
    assert_same_bits(fast.hits(*inputs), plain.hits(*inputs))
    assert len(fast.hits(*inputs)[0]) > 5 * 64 * 32


@needs_compiler
def test_joints_of_every_kind_have_the_same_bits():
    model = mujoco.MjModel.from_xml_string(
        """<mujoco><worldbody><body name="base"><freejoint/><geom size="0.1"/>
        <body name="rail" pos="0.1 0 0.2" euler="20 30 40">
          <joint name="slide" type="slide" axis="1 2 0"/><geom size="0.1"/>
          <body name="mount" pos="0 0 0.3" euler="0 50 0"><geom size="0.1"/>
            <body name="arm" pos="0 0.2 0"><joint name="turn" axis="1 1 1"/>
              <geom size="0.1"/></body></body></body></body></worldbody></mujoco>"""
    )
    chain, links = build_chain(model, "base"), ("base", "rail", "mount", "arm")
    skin = Skin(
        robot="rail",
        links=links,
        position=np.full((4, 3), 0.05),
        normal=np.array([[0.6, 0, 0.8]] * 4),
    )
    plain, fast = pair(FieldSensor, skin, chain, BALLS[:1], 1.0)
    joints = torch.randn(40, 2, generator=torch.Generator().manual_seed(0))
    assert_same_bits(fast.poses_b(joints), plain.poses_b(joints))
    assert fast.poses_b(joints)[0][:, 3].std() > 0.1


@needs_compiler
def test_inputs_may_be_slices(skin, random_state):
    plain, fast = pair(FieldSensor, skin, H1_2.chain, BALLS[:1], 2.0)
    state = random_state(90, seed=3, objects=2)[::3]
    inputs = [state[key] for key in KEYS]
    inputs[2:] = [x[:, :1] for x in inputs[2:]]
    inputs[1] = inputs[1].t().contiguous().t()
    assert_same_bits(fast.compute(*inputs), plain.compute(*inputs))


@needs_compiler
def test_gradients_flow(skin, random_state):
    _, fast = pair(FieldSensor, skin, H1_2.chain, BALLS[:1], math.inf)
    inputs = [random_state(5, objects=1)[key] for key in KEYS]
    inputs[3] = torch.ones_like(inputs[3])
    inputs[1].requires_grad_()
    fast.compute(*inputs)[0].sum().backward()
    assert inputs[1].grad.abs().sum() > 0


@needs_compiler
@pytest.mark.parametrize(
    "copied", [copy.deepcopy, lambda x: pickle.loads(pickle.dumps(x))]
)
def test_a_copy_measures_the_same(skin, random_state, copied):
    _, fast = pair(RaySensor, skin, H1_2.chain, BALLS[:1], 2.0)
    state = random_state(5, objects=1)
    assert_same_bits(measure(copied(fast), state), measure(fast, state))


def test_what_the_kernels_lack_is_computed_in_pytorch(skin, random_state):
    for objects, body in (([Box(half_extents=(0.1, 0.2, 0.3))], ()),
                          (BALLS[:1], H1_2.primitives)):  # fmt: skip
        args = (skin, H1_2.chain, objects, 1.0)
        plain = FieldSensor(*args, body=body)
        asked = FieldSensor(*args, body=body, compile=True)
        assert asked._kernels is None
        state = random_state(20, objects=1)
        assert_same_bits(measure(asked, state), measure(plain, state))


def test_without_a_compiler_sensors_run_as_they_are_and_say_so(skin, monkeypatch):
    monkeypatch.setenv("PATH", "")
    monkeypatch.delenv("CXX", raising=False)
    with pytest.warns(UserWarning, match=r"install g\+\+.*uncompiled"):
        sensor = FieldSensor(skin, H1_2.chain, BALLS, 1.0, compile=True)
    assert sensor._kernels is None


def test_a_compiler_that_fails_is_quoted(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    source = tmp_path / "broken.cpp"
    source.write_text("int main( {")
    with pytest.raises(RuntimeError, match=r"broken.cpp: .*(error|no C\+\+ compiler)"):
        load_library(source)
    assert not list(tmp_path.glob("egoskin/*"))


@needs_compiler
def test_a_folder_that_cannot_be_written_to_is_not_needed(tmp_path, monkeypatch):
    (tmp_path / "file").touch()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    source = tmp_path / "one.cpp"
    source.write_text('extern "C" int one() { return 1; }')
    assert load_library(source).one() == 1


@needs_compiler
@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:`torch.jit.script_method` is deprecated")
def test_compiled_by_torch_a_sensor_measures_the_same(skin, random_state):
    some = skin.select([i for i, x in enumerate(skin.links) if x == "torso_link"][:9])
    state = random_state(101, seed=5, objects=1)
    state["joint_pos"][7] = math.nan
    sensor = FieldSensor(some, H1_2.chain, BALLS[:1], 2.0, Field(half_angle_deg=70))
    scene = sensor.scene(*(state[key] for key in KEYS))
    compiled = torch.compile(sensor.distances, fullgraph=True)
    assert_same_bits([compiled(scene)], [sensor.distances(scene)])
    # The whole of it breaks into graphs where the number of hits decides a shape.
    inputs = [state[key] for key in KEYS]
    for reduce in ("none", "min"):
        ray = RaySensor(some, H1_2.chain, BALLS[:1], 2.0, reduce=reduce)
        assert_same_bits(torch.compile(ray.compute)(*inputs), ray.compute(*inputs))
