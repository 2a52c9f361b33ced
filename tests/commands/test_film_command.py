"""`egoskin film`: film and contact sheet of the requested episode; bad input."""

from __future__ import annotations

import os
import subprocess
import sys
from contextlib import nullcontext
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from calling import SCRIPTS, call, fail, succeed
from egoskin.envs.throws import Thrower
from egoskin.evaluation.throw_set import play_throws, standard_task, throw_seed
from egoskin.make import EnvConfig
from egoskin.policies.policy import Policy, load_policy
from egoskin.sensors import Skin
from egoskin.viewer.film import Frame
from egoskin.viewer.offscreen import CameraConfig
from egoskin.viewer.recording import Recording


def film(*args: str) -> str:
    """Return what the command prints."""
    done = call("film", *args)
    if "OpenGL" in done.stderr:
        pytest.skip(done.stderr)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_it_writes_a_film_and_a_sheet(tmp_path: Path):
    out = tmp_path / "a.gif"
    args = ("--out", str(out), "--seconds", "0.1", "--size", "160", "90")
    assert "cut" in film(*args)
    with Image.open(out) as made, Image.open(tmp_path / "a.png") as sheet:
        assert made.size == (160, 90)
        assert sheet.width > sheet.height
    assert {p.name for p in tmp_path.iterdir()} == {"a.gif", "a.png"}


def test_the_options_of_a_film_reach_its_parts(tmp_path: Path, monkeypatch):
    given = {}
    frames = [
        Frame(
            image=np.full((90, 160, 3), value, np.uint8),
            time=0.0,
            gap=np.inf,
            num_detecting=0,
            num_sensors=64,
            num_avoided=0,
            ending="cut",
        )
        for value in (50, 150)
    ]

    def paint(config, skin, **options):
        given.update(options)
        return nullcontext()

    def record(config, skin, policy, **options):
        given.update(options, config=config, policy=policy)
        return Recording(row=7, states=[], ending=None)

    def render(painter, config, skin, recording, **options):
        given.update(options)
        return frames

    for name, part in (
        ("painter_of", paint),
        ("record_longest", record),
        ("render_recording", render),
    ):
        monkeypatch.setattr(f"egoskin.commands.film.{name}", part)
    out = tmp_path / "a.gif"
    args = ["field_proximity", "--out", out, "--standard", "1", "--throw-set", "3"]
    args += ["--episode", "2", "--longest-of", "5", "--hold", "--seconds", "0.5"]
    args += ["--fps", "20", "--slowdown", "4", "--size", "160", "90"]
    told = succeed("film", *args, "--camera.azimuth-deg", "120")
    assert told.startswith("episode 7 of throw set 3: 0.00 s, 0 balls avoided, ends ")
    policy = given.pop("policy")
    assert isinstance(policy, Policy)
    expected = standard_task(load_policy("field_proximity").env_config, "1")
    assert given.pop("config") == expected
    del given["on_step"], given["on_picture"]
    assert given == {
        "throw_set": 3,
        "first": 2,
        "episodes": 5,
        "hold": True,
        "max_seconds": 0.5,
        "fps": 20.0,
        "size": (160, 90),
        "camera": CameraConfig(azimuth_deg=120.0),
    }
    with Image.open(out) as made:
        # 20 / 4 pictures a second [ms].
        assert made.info["duration"] == 200


@pytest.mark.slow
def test_a_film_is_of_the_longest_of_the_episodes_that_are_evaluated(
    skin: Skin, tmp_path: Path
):
    which = {"throw_set": 3, "episodes": 6, "hold": True}
    config = EnvConfig()
    thrower = Thrower(config.task.throws, config.robot_config, 1 / 120)
    row = torch.arange(6)
    delay = thrower.first_delay(throw_seed(config, 3), row, row * 0)
    ages = play_throws(None, config, skin, **which).steps + (60 * delay).round().long()
    longest = 2 + int(ages[2:].argmax())
    args = ["--out", str(tmp_path / "a.gif"), "--size", "160", "90", "--fps", "4"]
    args += ["--throw-set", "3", "--episode", "2", "--longest-of", "4", "--hold"]
    length = int(ages[longest]) / 60
    expected = f"episode {longest} of throw set 3: {length:.2f} s, 0 balls avoided, "
    assert expected + "ends with: hit" in film(*args)


@pytest.mark.parametrize(
    ("args", "text"),
    [
        (["--out", "a.avi"], "must end in .mp4 or .gif"),
        (["--out", "nowhere/a.mp4"], "no folder nowhere"),
        (["--sheet", "a.jpg"], "must end in .png"),
        (["--slowdown", "0"], "slowdown must be positive"),
        (["--slowdown", "101"], "slowdown must be at most 100"),
        (["--slowdown", "inf"], "slowdown must be a finite number"),
        (["--throw-set", "-1"], "throw_set must be in"),
        (["--episode", "-1"], "episode must not be negative"),
        (["--longest-of", "0"], "longest_of must be at least 1"),
        (["--fps", "61"], "fps must be in"),
        (["--out", "a.gif", "--fps", "60"], "play a GIF with at most 50 pictures"),
        (["--standard", "3"], "--standard"),
        (["nothing.safetensors"], "nothing.safetensors"),
        (["--standard", "1"], "--standard needs a policy"),
        (["nothing", "--sensor.range", "1"], "a policy brings its own"),
    ],
)
def test_bad_input_is_an_error_and_writes_nothing(
    args: list, text: str, tmp_path: Path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    assert text in fail("film", *args)
    assert not list(tmp_path.iterdir())


def test_a_slow_gif_and_a_fast_mp4_are_no_errors():
    from egoskin.commands.film import RenderConfig

    RenderConfig(out=Path("a.gif"), fps=60, slowdown=1.2)
    RenderConfig(out=Path("a.mp4"), fps=60)


@pytest.mark.parametrize(
    "environment",
    [
        # PyOpenGL bound to another platform, as if EGL were not installed.
        pytest.param(
            {"MUJOCO_GL": "", "PYOPENGL_PLATFORM": "osmesa"}, marks=pytest.mark.slow
        ),
        {"MUJOCO_GL": "no_such_backend"},
    ],
)
def test_without_opengl_it_says_what_to_install(
    tmp_path: Path, environment: dict[str, str]
):
    (tmp_path / "a.mp4").write_text("old")
    # MuJoCo chooses its OpenGL at import, so this needs a separate process.
    done = subprocess.run(
        [sys.executable, SCRIPTS / "render.py", "--out", "a.mp4", "--seconds", "0.1"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=200,
        env={**os.environ, **environment},
    )
    assert done.returncode == 2
    assert len(done.stderr.splitlines()) == 1
    assert "apt-get install libegl1" in done.stderr
    assert (tmp_path / "a.mp4").read_text() == "old"
