"""The package's public names, its help and the examples of the README."""

from __future__ import annotations

import re
import runpy
import shutil
import subprocess
import sys
import textwrap
from pathlib import Path

import gymnasium
import pytest
import torch
from packaging.requirements import Requirement
from setuptools.config.pyprojecttoml import read_configuration
from tensordict import TensorDict

import egoskin
from egoskin.sensors import FieldSensor, RaySensor
from egoskin.shapes import Sphere
from throwing import TASK

README = Path(__file__).parents[1] / "README.md"


def test_the_package_lists_its_names_and_its_version():
    # In a new process: here they have been imported by other tests.
    code = "import egoskin, sys; print(*dir(egoskin)); print('torch' in sys.modules)"
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    names, imported = done.stdout.splitlines()
    assert {"__version__", *egoskin.__all__} <= set(names.split())
    assert imported == "False"
    for name in egoskin.__all__:
        assert getattr(egoskin, name).__module__.startswith("egoskin.")
    # The one that setuptools writes into the package.
    built = read_configuration(README.parent / "pyproject.toml")
    assert built["project"]["version"] == egoskin.__version__


@pytest.mark.parametrize(("machine", "has"), [("x86_64", True), ("aarch64", False)])
def test_embreex_is_required_only_where_it_has_wheels(machine, has):
    project = read_configuration(README.parent / "pyproject.toml")["project"]
    design = map(Requirement, project["optional-dependencies"]["design"])
    here = {"platform_machine": machine}
    names = [r.name for r in design if r.marker is None or r.marker.evaluate(here)]
    assert names == ["trimesh", "rtree"] + ["embreex"] * has


@pytest.mark.skipif(shutil.which("make") is None, reason="has no make")
def test_make_makes_no_folder_with_a_python_that_is_too_old(tmp_path):
    shutil.copy(README.parent / "Makefile", tmp_path)
    (tmp_path / "pyproject.toml").touch()
    old = tmp_path / "old"
    code = "import sys; sys.version_info = (3, 9, 18); exec(sys.argv[1])"
    old.write_text(f"#!/bin/sh\nexec {sys.executable} -c '{code}' \"$2\"\n")
    old.chmod(0o755)
    command = ["make", "-C", tmp_path, f"PYTHON={old}", "train"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 2
    assert done.stderr.startswith("Python 3.10 or newer is needed, not ")
    assert not (tmp_path / ".venv").exists()


def test_an_environment_has_the_skin_of_its_configuration_by_default():
    config = egoskin.EnvConfig(task=TASK)

    def still(td: TensorDict) -> TensorDict:
        return td.set("action", torch.zeros(*td.shape, 21))

    signals = []
    for env in (
        egoskin.make_worker_env(
            config, config.skin.build(config.robot_config), num_envs=2, seed=0
        ),
        egoskin.make_worker_env(config, num_envs=2, seed=0),
        egoskin.make_env(config, num_envs=2, seed=0, num_workers=1),
    ):
        rollout = env.rollout(40, still, break_when_any_done=False)
        signals.append(rollout["signal"].reshape(2, 40, 64))
        env.close()
    given, default, pooled = signals
    assert (given < 1).any()
    assert torch.equal(default, given)
    assert torch.equal(pooled, given)


def test_the_state_for_sparse_sources_has_no_history():
    config = egoskin.EnvConfig(history=2)
    with pytest.raises(ValueError, match="history 2 needs signals: turn sparse off"):
        egoskin.make_worker_env(config, num_envs=1, seed=0, sparse=True)


@pytest.mark.parametrize("kind", [FieldSensor, RaySensor])
def test_one_shape_needs_no_list(kind, robot, skin, random_state):
    ball, state = Sphere(radius=0.3), random_state(50, objects=1)
    one, listed = (
        kind(skin, robot.chain, objects, 2.0)(state.clone())
        for objects in (ball, [ball])
    )
    assert one["object_detected"].any()
    assert torch.equal(one["distance"], listed["distance"])
    with pytest.raises(ValueError, match="at least one object"):
        kind(skin, robot.chain, [], 2.0)
    for wrong in (0.3, [0.3]):
        with pytest.raises(ValueError, match=r"must be shapes .* got 0\.3"):
            kind(skin, robot.chain, wrong, 2.0)


# --- README -----------------------------------------------------------------------


def examples() -> list[str]:
    """The programs in the README: indented blocks that import something."""
    blocks = re.findall(r"(?:^(?: {4}.*)?\n)+", README.read_text(), re.MULTILINE)
    code = [textwrap.dedent(block).strip("\n") for block in blocks]
    return [
        block for block in code if re.search("^(import|from) ", block, re.MULTILINE)
    ]


@pytest.mark.parametrize("number", [0, 1])
def test_the_readmes_examples_run_as_given(number, tmp_path, monkeypatch, capfd):
    # The file that an example loads lies beside it.
    models = Path(gymnasium.__file__).parent / "envs" / "mujoco" / "assets"
    shutil.copy(models / "humanoid.xml", tmp_path)
    assert len(examples()) == 2
    script = tmp_path / "example.py"
    script.write_text(examples()[number])
    monkeypatch.chdir(tmp_path)
    if "__main__" in examples()[number]:
        # Its worker processes read it as well.
        command = [sys.executable, "-W", "error::UserWarning", script]
        subprocess.run(command, check=True)
    else:
        runpy.run_path(str(script), run_name="__main__")
    # The output is that of the comments.
    said = re.findall(r"print\(.*# (.*)", examples()[number])
    assert said
    assert list(dict.fromkeys(capfd.readouterr().out.splitlines())) == said
