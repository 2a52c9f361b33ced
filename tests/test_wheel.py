"""The installed wheel, in a folder without the source.

Dependencies are those of this interpreter; the package is the wheel alone.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import sysconfig
import urllib.request
import venv
from email.message import Message
from email.parser import Parser
from pathlib import Path
from zipfile import ZipFile

import numpy as np
import pytest
from PIL import Image

from egoskin.commands import COMMANDS
from egoskin.commands.verify import run_hash
from egoskin.runs.run import Run
from egoskin.sensors.kernels.compilation import SETTING, can_compile
from owning import write_robot

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[1]
SMALL = ("--num-envs", "16", "--num-workers", "2", "--ppo.num-mini-batches", "2")
BATCH = 256
"""Environment steps of one rollout: 16 agents x 16 steps."""


@pytest.fixture(scope="module")
def wheel(tmp_path_factory) -> Path:
    """The wheel, built from a copy: setuptools writes into the source folder."""
    folder = tmp_path_factory.mktemp("wheel")
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, folder)
    skipped = shutil.ignore_patterns("__pycache__")
    shutil.copytree(ROOT / "egoskin", folder / "egoskin", ignore=skipped)
    offline = ("--no-deps", "--no-index", "--no-build-isolation")
    pip("wheel", *offline, "--wheel-dir", folder, folder)
    (built,) = folder.glob("*.whl")
    return built


def pip(*args: object) -> None:
    command = [sys.executable, "-m", "pip", "--quiet", *map(str, args)]
    subprocess.run(command, check=True, env=surroundings())


def surroundings(**more: str) -> dict[str, str]:
    """Return the environment of a user, without paths to the source or the tests."""
    unset = ("PYTHONPATH", "MUJOCO_GL", "PYOPENGL_PLATFORM", SETTING)
    return {k: v for k, v in os.environ.items() if k not in unset} | more


class Installed:
    """The wheel in its own environment, called from a folder.

    Args:
        python: Its interpreter.
        folder: The folder.
    """

    def __init__(self, python: Path, folder: Path) -> None:
        self.python, self.folder = python, folder
        cache = python.parents[2] / "cache"
        cache.mkdir(exist_ok=True)
        self.env = surroundings(XDG_CACHE_HOME=str(cache))

    def run(self, *command: object, status: int = 0) -> str:
        """Return the output of a command of the environment; on failure, its errors."""
        name, *args = map(str, command)
        done = subprocess.run(
            [self.python.with_name(name), *args],
            cwd=self.folder,
            env=self.env,
            capture_output=True,
            text=True,
        )
        assert done.returncode == status, done.stderr
        assert "Traceback" not in done.stderr
        return done.stderr if status else done.stdout

    def __call__(self, *args: object) -> str:
        """Return the output of `egoskin`."""
        return self.run("egoskin", *args)

    def read(self, name: str) -> dict:
        return json.loads((self.folder / name).read_text())


@pytest.fixture(scope="module")
def python(wheel: Path, tmp_path_factory) -> Path:
    """The interpreter of a new environment with the wheel in it."""
    folder = tmp_path_factory.mktemp("installed") / "venv"
    venv.create(folder, symlinks=True)
    python = folder / "bin" / "python"
    pip("--python", python, "install", "--no-deps", "--no-index", wheel)
    # What it depends on, but no other egoskin: a path in a .pth is no site-packages,
    # so what makes an editable install importable there is not read.
    others = [
        path
        for path in dict.fromkeys((*sys.path, *sysconfig.get_paths().values()))
        if Path(path).name in ("site-packages", "dist-packages")
        or (Path(path).is_dir() and any(Path(path).glob("*.dist-info")))
    ]
    paths = {"base": str(folder), "platbase": str(folder)}
    library = Path(sysconfig.get_path("purelib", vars=paths))
    (library / "dependencies.pth").write_text("\n".join(others))
    return python


@pytest.fixture(scope="module")
def egoskin(python: Path, tmp_path_factory) -> Installed:
    """The command, called from a folder that was empty before these tests."""
    folder = tmp_path_factory.mktemp("empty")
    installed = Installed(python, folder)
    place = installed.run("python", "-c", "import egoskin; print(egoskin.__file__)")
    assert Path(place.strip()).is_relative_to(python.parents[1])
    return installed


@pytest.fixture(scope="module")
def run(egoskin: Installed) -> str:
    """A run of two rollouts."""
    said = egoskin(
        *("train", *SMALL, "--total-frames", 2 * BATCH, "--run-dir", "runs/first"),
        *("--sensor.signal", "binary", "--seed", "3"),
    )
    assert f"done: {2 * BATCH} frames" in said
    assert "egoskin evaluate runs/first" in said
    return "runs/first"


# --- what is in it ------------------------------------------------------------------


def metadata(wheel: Path) -> Message:
    with ZipFile(wheel) as file:
        (name,) = (n for n in file.namelist() if n.endswith(".dist-info/METADATA"))
        return Parser().parsestr(file.read(name).decode())


def test_the_wheel_says_who_made_it_for_what_and_what_it_needs(wheel: Path):
    told = metadata(wheel)
    assert told["Author"]
    assert told["License-Expression"] == "MIT"
    assert "which skin makes avoidance easy" in told["Summary"]
    classifiers = told.get_all("Classifier") or []
    minor = [c.split("3.")[1] for c in classifiers if "Python :: 3." in c]
    assert minor == ["10", "11", "12", "13"]
    assert told["Requires-Python"] == ">=3.10"
    # Every extra that an error or a page names.
    sources = [*(ROOT / "egoskin").rglob("*.py"), *ROOT.glob("docs/*.md")]
    sources.append(ROOT / "README.md")
    named = re.findall(r"egoskin\[(\w+)\]", "\n".join(p.read_text() for p in sources))
    assert {"view", "export", "study"} <= set(named)
    assert set(named) <= set(told.get_all("Provides-Extra"))


def test_the_wheel_has_the_package_and_its_data_alone(wheel: Path):
    with ZipFile(wheel) as file:
        names = file.namelist()
    assert {n.split("/")[0].split("-")[0] for n in names} == {"egoskin"}
    tracked = {
        str(path.relative_to(ROOT))
        for path in (ROOT / "egoskin").rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }
    assert {n for n in names if n.startswith("egoskin/")} == tracked


# --- how it is called ---------------------------------------------------------------


def test_it_is_called_by_its_name_or_as_a_module(egoskin: Installed):
    said = egoskin("--help")
    assert egoskin.run("python", "-m", "egoskin", "--help") == said
    for name in COMMANDS:
        assert f"\n  {name} " in said
        assert egoskin(name, "--help").startswith(f"usage: egoskin {name} ")


# --- every command ------------------------------------------------------------------


def test_a_run_is_repeated_from_its_configuration(egoskin: Installed, run: str):
    config = f"{run}/config.json"
    egoskin("train", "--config", config, "--run-dir", "runs/again")
    one, again = (Run.open(egoskin.folder / path) for path in (run, "runs/again"))
    assert run_hash(again) == run_hash(one)


def test_it_evaluates(egoskin: Installed, run: str):
    args = ("--episodes", "8", "--json", "figures.json")
    said = egoskin("evaluate", run, *args, "--behaviour")
    assert "success (no contact for 3 s)" in said
    figures = egoskin.read("figures.json")
    assert figures["frames"] == 2 * BATCH
    assert 0 <= figures["success"]["mean"] <= 1
    assert "sensors masked: all" in egoskin(
        "evaluate", "field_proximity", "--mask", *args
    )


def test_it_films(egoskin: Installed):
    size = ("--size", "64", "48", "--seconds", "0.5")
    egoskin("film", "blind", "--out", "blind.mp4", *size)
    assert (egoskin.folder / "blind.mp4").stat().st_size > 1000
    assert np.ptp(np.asarray(Image.open(egoskin.folder / "blind.png"))) > 100


def test_it_places_shows_and_exchanges_skins(egoskin: Installed):
    egoskin("skin", "place", "--num-sensors", "5", "--out", "skin.json")
    assert len(egoskin.read("skin.json")["sensors"]) == 5
    egoskin("skin", "export", "skin.json", "--out", "skin.csv")
    egoskin("skin", "import", "skin.csv", "--out", "back.json")
    places = [
        [s["position"] for s in egoskin.read(name)["sensors"]]
        for name in ("skin.json", "back.json")
    ]
    np.testing.assert_allclose(*places, atol=1e-5)
    egoskin("skin", "show", "skin.json", "--picture", "skin.png")
    assert np.ptp(np.asarray(Image.open(egoskin.folder / "skin.png"))) > 100


def test_it_tells_what_a_skin_sees(egoskin: Installed):
    egoskin("skin", "place", "--num-sensors", "3", "--out", "three.json")
    egoskin(
        *("visibility", "--skin.path", "three.json", "--ranges", "0.2", "2.0"),
        *("--coverages", "field", "--num-throws", "20", "--out", "seen.png"),
        *("--json", "seen.json"),
    )
    assert np.ptp(np.asarray(Image.open(egoskin.folder / "seen.png"))) > 100
    assert egoskin.read("seen.json")


def test_it_searches_what_the_body_could_do(egoskin: Installed):
    said = egoskin(
        *("upper-bound", "field_proximity", "--throws", "2", "--search.samples", "8"),
        *("--search.iterations", "1", "--json", "bound.json"),
    )
    assert "best found" in said
    assert sum(row["throws"] for row in egoskin.read("bound.json")["by_height_m"]) == 2


def test_it_replays_an_update_that_was_not_finite(egoskin: Installed):
    error = egoskin.run(
        *("egoskin", "train", *SMALL, "--run-dir", "runs/wild"),
        *("--ppo.learning-rate", "1e15", "--ppo.desired-kl", "None"),
        status=1,
    )
    command = re.search(r"replay it with: egoskin (replay \S+)", error)[1]
    lines = egoskin(*command.split()).splitlines()
    assert lines[0].removeprefix("recorded: ") == lines[-1].removeprefix("again:    ")


def test_it_runs_a_study(egoskin: Installed, run: str):
    study = {
        "name": "tiny",
        "purpose": "to test",
        "cells": [{}, {"sensor.coverage": "none"}],
        "seeds": [0, 1],
        "frames": 2 * BATCH,
        "base": {"num_envs": 16},
        "evaluation": {"episodes": 8},
    }
    (egoskin.folder / "tiny.json").write_text(json.dumps(study))
    speed = ("--steps-per-s", "1000")
    assert "4 runs" in egoskin("study", "plan", "tiny.json", "--dir", "study", *speed)
    assert "#SBATCH" in egoskin("study", "slurm", "study")
    egoskin("study", "run", "--dir", "study", "--parallel", "2")
    assert "4 done" in egoskin("study", "status", "study")
    egoskin("study", "report", "study")
    report = egoskin.folder / "study" / "report" / "report.md"
    assert "tiny" in report.read_text()
    error = egoskin.run("egoskin", "study", "adopt", "study", run, status=2)
    assert "is not a run of this study" in error


def test_what_it_exports_runs_without_pytorch(egoskin: Installed, run: str):
    egoskin("export", run, "--out", "policy.onnx")
    program = """
import sys
sys.modules |= dict.fromkeys(("torch", "tensordict", "torchrl", "mujoco"))
import numpy as np
from egoskin.deploy import Controller
controller = Controller("policy.onnx")
default = np.array(controller.metadata["default_joint_pos"])
print(controller.metadata["sensor"]["signal"], *controller.step(
    base_quat=np.array([1.0, 0, 0, 0]), base_ang_vel_b=np.zeros(3), joint_pos=default,
    joint_vel=np.zeros(21), body_age=0.0, distance=np.full(64, np.inf), skin_age=0.0,
))
"""
    signal_of, *targets = egoskin.run("python", "-c", program).split()
    assert signal_of == "binary"
    assert np.isfinite(np.array(targets, float)).all()
    assert len(targets) == 21


@pytest.mark.skipif(not can_compile(), reason="there is no C++ compiler here")
def test_it_verifies_that_training_is_exact_with_its_own_kernels(egoskin: Installed):
    said = egoskin("verify", "--num-envs", "16", "--iterations", "2")
    assert "equal: training is reproducible" in said
    assert "compiled kernels" in said
    kept = Path(egoskin.env["XDG_CACHE_HOME"]) / "egoskin"
    assert list(kept.glob("kernels-*.so"))


def test_it_measures(egoskin: Installed):
    egoskin("bench", "accuracy", "--throws", "2", "--json", "rows.json")
    assert egoskin.read("rows.json")["rows"]


def test_it_trains_and_draws_a_robot_of_ones_own(egoskin: Installed):
    write_robot(egoskin.folder / "walker")
    said = egoskin("robot", "check", "walker", "--out", "walker.png")
    assert "stands" in said
    assert np.ptp(np.asarray(Image.open(egoskin.folder / "walker.png"))) > 100
    egoskin(
        *("train", *SMALL, "--robot", "walker", "--skin.num-sensors", "4"),
        *("--total-frames", BATCH, "--run-dir", "runs/walker"),
    )
    # Its policy no longer needs the folder.
    shutil.rmtree(egoskin.folder / "walker")
    assert "runs/walker: trained for 256 frames" in egoskin(
        "evaluate", "runs/walker", "--episodes", "4"
    )


@pytest.mark.parametrize(
    "what", [("blind",), ("field_proximity", "runs/first"), ("--robot", "g1")]
)
def test_it_opens_a_page_that_ctrl_c_ends(egoskin: Installed, run: str, what):
    page = subprocess.Popen(
        [egoskin.python.with_name("egoskin"), "view", *what, "--port", "0"],
        cwd=egoskin.folder,
        env=egoskin.env,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        address = page.stdout.readline().split()[0]
        with urllib.request.urlopen(address) as answer:
            assert "<html" in answer.read().decode()
        page.send_signal(signal.SIGINT)
        _, errors = page.communicate(timeout=5)
        assert "Traceback" not in errors
        assert page.returncode == 128 + signal.SIGINT
    finally:
        page.kill()
        page.wait()


def test_other_libraries_find_its_environment(egoskin: Installed):
    program = """
import egoskin.gym, gymnasium
from gymnasium.utils.env_checker import check_env
env = gymnasium.make("egoskin/Dodgeball-v0")
observation, _ = env.reset(seed=0)
print(env.step(env.action_space.sample())[1] != 0)
"""
    assert egoskin.run("python", "-c", program).split() == ["True"]
