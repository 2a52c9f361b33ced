"""C++ kernels: bit-identical to the PyTorch code, which is tested against MuJoCo."""

from __future__ import annotations

import contextlib
import copy
import ctypes
import io
import math
import multiprocessing
import os
import pickle
import resource
import signal
import stat
import subprocess
import sys
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from egoskin.parallel import start_server
from egoskin.robots.builtin import H1_2
from egoskin.robots.chains import build_chain
from egoskin.sensors import Field, FieldSensor, RaySensor, Skin
from egoskin.sensors.kernels import compilation
from egoskin.sensors.kernels.compilation import can_compile, load_library
from egoskin.shapes import Box, Sphere
from sensing import (
    BALLS,
    KEYS,
    SEED,
    assert_same_bits,
    check_fields,
    check_rays,
    measure,
    sliced_inputs,
)

needs_compiler = pytest.mark.skipif(not can_compile(), reason="needs a C++ compiler")


@pytest.fixture(autouse=True)
def compiling(monkeypatch) -> Iterator[None]:
    """Enable compilation, as for users; other tests disable it."""
    monkeypatch.delenv(compilation.SETTING)
    yield
    compilation._loaded.cache_clear()


def pair(kind, *args, **options):
    """The same sensor in PyTorch and in C++."""
    plain, fast = (kind(*args, **options, compile=c) for c in (False, True))
    assert plain._kernels is None
    assert fast._kernels._library is not None
    return plain, fast


@needs_compiler
@given(SEED, st.booleans())
def test_fields_have_the_same_bits(skin, random_state, seed, per_object):
    plain, fast, state = check_fields(pair, skin, random_state, seed, per_object)
    joints = state["joint_pos"]
    assert_same_bits(fast.poses_b(joints), plain.poses_b(joints))


@needs_compiler
def test_a_full_sphere_beside_a_cone_sees_what_is_straight_behind():
    normal = np.random.default_rng(0).normal(size=(64, 3))
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    skin = Skin(
        robot="h1_2",
        links=("pelvis",) * 64,
        position=np.zeros((64, 3)),
        normal=normal,
        coverage=(Field(half_angle_deg=60.0), *[Field()] * 63),
    )
    # In row i the ball is behind sensor i.
    pose = torch.zeros(64, 1, 7)
    pose[:, 0, :3] = -0.7 * torch.from_numpy(normal)
    base = torch.zeros(64, 7)
    pose[..., 3] = base[:, 3] = 1.0
    joints = torch.zeros(64, len(H1_2.joints))
    inputs = (base, joints, pose, torch.ones(64, 1, dtype=torch.bool))
    for sensor in pair(FieldSensor, skin, H1_2.chain, BALLS[:1], 1.0):
        behind = sensor.compute(*inputs)[0].diagonal()
        assert behind[0].isinf()
        assert behind[1:].isfinite().all()
    # Gradients are finite, too; they are those of a skin without a cone.
    plain = FieldSensor(skin, H1_2.chain, BALLS[:1], 1.0)
    place = pose.clone().requires_grad_()
    reading = plain.compute(base, joints, place, inputs[3])[0].diagonal()
    (gradient,) = torch.autograd.grad(reading[1:].sum(), place)
    expected = -torch.from_numpy(normal).float()
    torch.testing.assert_close(gradient[1:, 0, :3], expected[1:])


@needs_compiler
def test_float64_is_computed_by_pytorch(skin, random_state):
    plain, fast = pair(FieldSensor, skin, H1_2.chain, BALLS[:1], 1.0)
    state = random_state(20, dtype=torch.float64, objects=1)
    assert not fast._kernels.can(state["joint_pos"])
    assert_same_bits(measure(fast, state), measure(plain, state))


@needs_compiler
def test_hits_of_wrong_inputs_are_refused(skin, random_state):
    _, fast = pair(RaySensor, skin, H1_2.chain, BALLS[:2], 1.0)
    inputs = [random_state(4)[key] for key in KEYS]
    for i, wrong in enumerate((inputs[0][:, :6], inputs[1][:, :3], inputs[2][:2])):
        with pytest.raises(ValueError, match=r"must|rows"):
            fast.hits(*inputs[:i], wrong, *inputs[i + 1 :])
    with pytest.raises(ValueError, match="must all be float32 or all float64"):
        fast.hits(inputs[0].double(), *inputs[1:])


@needs_compiler
@given(SEED, st.sampled_from(["none", "min"]), st.booleans())
def test_rays_have_the_same_bits(skin, random_state, seed, reduce, per_object):
    check_rays(pair, skin, random_state, seed, reduce, per_object)


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
    inputs = sliced_inputs(random_state)
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


# --- the library ------------------------------------------------------------------


@pytest.fixture
def cache(tmp_path: Path, monkeypatch) -> Path:
    """Folder of the compiled libraries, which does not exist yet."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "cache" / "egoskin"


@pytest.fixture
def source(tmp_path: Path) -> Path:
    path = tmp_path / "one.cpp"
    path.write_text('extern "C" int one() { return 1; }')
    return path


def load_anew(source: Path) -> ctypes.CDLL | None:
    """Load the library as in another process."""
    compilation._loaded.cache_clear()
    return load_library(source)


def is_one(library: ctypes.CDLL | None) -> bool:
    return library is not None and library.one() == 1


def logged(caplog) -> list[str]:
    """Return the messages logged since the last call."""
    messages = [record.getMessage() for record in caplog.records]
    caplog.clear()
    return messages


def check_stays_plain(source: Path, caplog, *expected: str) -> None:
    """Assert that loading returns None and logs the reason once, in one line."""
    assert load_anew(source) is None
    assert load_library(source) is None
    lines = [line for line in logged(caplog) if not line.startswith("compiling")]
    assert len(lines) == 1
    for text in ("one.cpp is not compiled", *expected):
        assert text in lines[0]
    assert "\n" not in lines[0]


@needs_compiler
def test_a_child_compiles_only_if_its_parent_has_not_tried(source, cache, monkeypatch):
    monkeypatch.setattr(compilation, "parent_process", lambda: "a parent")
    monkeypatch.setenv(compilation.TRIED, "1")
    assert load_anew(source) is None
    # As in a child whose parent has no sensors.
    monkeypatch.delenv(compilation.TRIED)
    assert is_one(load_anew(source))


@needs_compiler
def test_a_library_is_compiled_once_for_this_user_alone(source, cache, caplog):
    assert is_one(load_anew(source))
    assert logged(caplog) == ["compiling one.cpp: some seconds, once per machine"]
    (file,) = cache.iterdir()
    assert stat.S_IMODE(cache.stat().st_mode) == 0o700

    def identity() -> tuple[int, int, int]:
        about = file.stat()
        return about.st_ino, about.st_mtime_ns, about.st_size

    before = identity()
    assert is_one(load_anew(source))
    assert logged(caplog) == []
    assert identity() == before
    # A folder writable by others is closed before anything is loaded from it.
    cache.chmod(0o777)
    assert is_one(load_anew(source))
    assert stat.S_IMODE(cache.stat().st_mode) == 0o700


@needs_compiler
@pytest.mark.parametrize("damage", ["cut", "empty", "bit", "folder"])
def test_a_damaged_library_is_compiled_again(source, cache, caplog, damage):
    load_anew(source)
    (file,) = cache.iterdir()
    content = file.read_bytes()
    # Not in place: this process has it mapped.
    file.unlink()
    if damage == "folder":
        file.mkdir()
        # The name is taken: the library cannot be saved.
        check_stays_plain(source, caplog, "Is a directory", str(file))
        return
    flipped = bytes([content[-1] ^ 1])
    changed = {"cut": content[:4096], "empty": b"", "bit": content[:-1] + flipped}
    file.write_bytes(changed[damage])
    caplog.clear()
    assert is_one(load_anew(source))
    assert logged(caplog) == ["compiling one.cpp: some seconds, once per machine"]
    assert [path.read_bytes() for path in cache.iterdir()] == [content]


@needs_compiler
@pytest.mark.skipif(os.geteuid() != 0, reason="only root can give a file away")
def test_what_belongs_to_another_user_is_not_loaded(source, cache, caplog):
    load_anew(source)
    (file,) = cache.iterdir()
    os.chown(file, 12345, -1)
    assert is_one(load_anew(source))
    assert file.stat().st_uid == 0
    os.chown(cache, 12345, -1)
    caplog.clear()
    check_stays_plain(source, caplog, f"{cache} is not a folder of this user")


@needs_compiler
def test_a_link_to_a_folder_is_no_cache(source, cache, caplog, tmp_path):
    cache.parent.mkdir()
    (tmp_path / "other").mkdir()
    cache.symlink_to(tmp_path / "other")
    check_stays_plain(source, caplog, f"{cache} is not a folder of this user")
    assert not list((tmp_path / "other").iterdir())


@needs_compiler
def test_a_cache_that_cannot_be_made_leaves_sensors_plain(source, cache, caplog):
    cache.parent.write_text("")
    check_stays_plain(source, caplog, f"Not a directory: '{cache}'")
    cache.parent.unlink()
    cache.parent.mkdir()
    cache.write_text("")
    check_stays_plain(source, caplog, f"File exists: '{cache}'")


@needs_compiler
def test_a_full_disk_leaves_sensors_plain(source, cache, caplog, monkeypatch):
    compiled = compilation._compile

    def fill_disk(*args) -> bytes:
        content = compiled(*args)
        resource.setrlimit(resource.RLIMIT_FSIZE, (len(content) // 2, hard))
        return content

    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    monkeypatch.setattr(compilation, "_compile", fill_disk)
    try:
        check_stays_plain(source, caplog, "File too large", str(cache))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert not list(cache.iterdir())


BROKEN = {
    "fails": ("echo one; echo 'no error: but this' >&2; exit 1", "no error: but this"),
    "says nothing": ("exit 3", "exit status 3"),
    "is killed": ("kill -9 $$", "exit status -9"),
    "writes nothing": ("exit 0", "No such file"),
    "writes nonsense": ('for to; do :; done; echo nonsense > "$to"', "too short"),
}


@pytest.mark.parametrize("how", BROKEN)
def test_a_broken_compiler_leaves_sensors_plain(
    source, cache, caplog, tmp_path, monkeypatch, how
):
    script, expected = BROKEN[how]
    compiler = tmp_path / "broken"
    compiler.write_text(f"#!/bin/sh\n{script}\n")
    compiler.chmod(0o755)
    monkeypatch.setenv("CXX", str(compiler))
    check_stays_plain(source, caplog, expected)
    assert not list(cache.iterdir())


def test_without_a_compiler_sensors_measure_the_same(
    skin, random_state, monkeypatch, caplog
):
    monkeypatch.setenv("PATH", "")
    monkeypatch.delenv("CXX", raising=False)
    compilation._loaded.cache_clear()
    args, state = (skin, H1_2.chain, BALLS[:1], 1.0), random_state(20, objects=1)
    plain, asked = (FieldSensor(*args, compile=c) for c in (False, True))
    (line,) = logged(caplog)
    assert "no C++ compiler found: install g++" in line
    copied = copy.deepcopy(asked)
    compilation._loaded.cache_clear()
    for sensor in (asked, copied):
        assert_same_bits(measure(sensor, state), measure(plain, state))


@needs_compiler
def test_a_worker_neither_compiles_nor_says_so(source, cache):
    start_server()
    forkserver = multiprocessing.get_context("forkserver")
    with forkserver.Pool(1) as pool:
        work = partial(pool.apply, in_worker, (source, str(cache.parent)))
        assert work() == (False, "")
        assert not list(cache.iterdir())
        assert is_one(load_anew(source))
        assert work() == (True, "")
        # Leaving would send a SIGTERM, which what our server forks does not see.
        pool.close()
        pool.join()


def in_worker(source: Path, cache: str) -> tuple[bool, str]:
    """Load in a process whose environment is that of its server."""
    os.environ["XDG_CACHE_HOME"] = cache
    os.environ.pop(compilation.SETTING, None)
    with contextlib.redirect_stderr(io.StringIO()) as said:
        return is_one(load_anew(source)), said.getvalue()


@pytest.mark.slow
@needs_compiler
def test_a_killed_compilation_leaves_nothing_in_the_cache(source, cache, tmp_path):
    compiler = tmp_path / "slow"
    compiler.write_text(f"#!/bin/sh\ntouch {tmp_path}/begun\nexec sleep 100\n")
    compiler.chmod(0o755)
    code = (
        "import pathlib, sys\n"
        "from egoskin.sensors.kernels.compilation import load_library\n"
        "load_library(pathlib.Path(sys.argv[1]))"
    )
    with subprocess.Popen(
        [sys.executable, "-c", code, str(source)],
        env={**os.environ, "CXX": str(compiler), "TMPDIR": str(tmp_path)},
        start_new_session=True,
        stderr=subprocess.DEVNULL,
    ) as compiling:
        while not (tmp_path / "begun").exists():
            assert compiling.poll() is None
            time.sleep(0.02)
        os.killpg(compiling.pid, signal.SIGKILL)
    assert not list(cache.iterdir())


@needs_compiler
@pytest.mark.slow
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
