"""Warp's kernels, on Warp's CPU device: the bits of the PyTorch code; `make test-warp`.

The kernels of a GPU are the same code, compiled by another compiler.
"""

from __future__ import annotations

import copy
import math
import pickle
import re
from importlib.util import find_spec
from pathlib import Path

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from egoskin.robots.builtin import H1_2
from egoskin.sensors import FieldSensor, RaySensor
from sensing import (
    BALLS,
    KEYS,
    SEED,
    assert_same_bits,
    check_fields,
    check_rays,
    measure,
    sliced_inputs,
    use_warp_kernels,
)

pytestmark = [pytest.mark.slow, pytest.mark.warp]
if find_spec("mujoco_warp") is None:
    pytest.skip("mujoco-warp is not installed (extra gpu)", allow_module_level=True)

import warp as wp  # noqa: E402 # pyright: ignore[reportMissingImports]

from egoskin.robots import warp_kinematics  # noqa: E402
from egoskin.sensors.kernels import warp as warp_kernels  # noqa: E402


@pytest.fixture(autouse=True)
def kernels(request, monkeypatch) -> None:
    if "gpu" not in request.keywords:
        use_warp_kernels(monkeypatch)


def pair(kind, *args, **options):
    """The same sensor in PyTorch and in Warp."""
    plain, fast = (kind(*args, **options, compile=c) for c in (False, True))
    assert plain._kernels is None
    assert fast._kernels is not None
    return plain, fast


@given(SEED, st.booleans())
def test_fields_have_the_same_bits(skin, random_state, seed, per_object):
    check_fields(pair, skin, random_state, seed, per_object)


@given(SEED, st.sampled_from(["none", "min"]), st.booleans())
def test_rays_have_the_same_bits(skin, random_state, seed, reduce, per_object):
    check_rays(pair, skin, random_state, seed, reduce, per_object)


@pytest.mark.parametrize("kind", [FieldSensor, RaySensor])
def test_no_rows_and_slices_are_fine(skin, random_state, kind):
    plain, fast = pair(kind, skin, H1_2.chain, BALLS[:1], 2.0)
    inputs = sliced_inputs(random_state)
    for rows in (slice(None), slice(0)):
        some = [x[rows] for x in inputs]
        assert_same_bits(fast.compute(*some), plain.compute(*some))


def test_a_zero_quaternion_gives_nan(skin, random_state):
    plain, fast = pair(FieldSensor, skin, H1_2.chain, BALLS[:1], 2.0)
    state = random_state(5, objects=1)
    state["base_pose"][2, 3:] = 0.0
    state["object_active"][:] = True
    distance, detected = measure(fast, state)
    assert_same_bits((distance, detected), measure(plain, state))
    assert distance[2].isnan().all()
    assert detected[2].all()


def test_a_mask_hides_sensors(skin, random_state):
    _, fast = pair(FieldSensor, skin, H1_2.chain, BALLS[:1], math.inf)
    state = random_state(5, objects=1)
    state["object_active"][:] = True
    assert measure(fast, state)[0].isfinite().all()
    fast.mask([3, 7])
    (masked,) = {*map(tuple, measure(fast, state)[0].isinf().tolist())}
    assert [i for i, hidden in enumerate(masked) if hidden] == [3, 7]


@pytest.mark.parametrize(
    "copied", [copy.deepcopy, lambda x: pickle.loads(pickle.dumps(x))]
)
def test_a_copy_measures_the_same(skin, random_state, copied):
    fast = RaySensor(skin, H1_2.chain, BALLS[:1], 2.0, compile=True)
    state = random_state(5, objects=1)
    expected = measure(fast, state)
    assert_same_bits(measure(copied(fast), state), expected)


@pytest.mark.parametrize(
    ("module", "used"),
    [
        (warp_kinematics, {"mul.rn.f32"}),
        (warp_kernels, {"mul.rn.f32", "sqrt.rn.f32", "div.rn.f32"}),
    ],
)
def test_for_a_gpu_nothing_is_fused_and_roots_are_exact(tmp_path: Path, module, used):
    # Warp compiles for a GPU that is not there; this is what the compiler writes.
    wp.compile_aot_module(module, module_dir=tmp_path, arch=90, use_ptx=True)
    (code,) = (path.read_bytes().decode("latin1") for path in tmp_path.glob("*.ptx"))
    numbers = set(re.findall(r"\b(?:fma|mul|sqrt|div|rcp)[.a-z0-9]*\.f(?:32|64)", code))
    assert numbers == used


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
@pytest.mark.parametrize("kind", [FieldSensor, RaySensor])
def test_on_a_gpu_readings_have_the_bits_of_the_cpu(skin, random_state, kind):
    plain, fast = pair(kind, skin, H1_2.chain, BALLS[:2], 2.0)
    state = random_state(300)
    state["joint_pos"][7, 3] = math.nan
    on_gpu = state.to("cuda")
    expected = measure(plain, state)
    assert_same_bits([x.cpu() for x in measure(fast.to("cuda"), on_gpu)], expected)
    assert fast._kernels._warp
    if kind is RaySensor:
        hits = fast.hits(*(on_gpu[key] for key in KEYS))
        assert_same_bits(
            [x.cpu() for x in hits], plain.hits(*(state[key] for key in KEYS))
        )
