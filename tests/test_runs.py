"""A run as a library user starts it: threads, kept policies, the recorded commit."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import threading
from dataclasses import replace
from pathlib import Path

import pytest
import torch

import egoskin
from egoskin.checkpoint import load_tensors, save_tensors
from egoskin.formats import read_sealed, sealed_json
from egoskin.make import EnvConfig
from egoskin.runs import Run, TrainConfig, parse_config
from egoskin.sensors.config import SensorConfig
from egoskin.training import open_trainer, train


@pytest.fixture
def config(tmp_path: Path) -> TrainConfig:
    """Three rollouts of 64 frames."""
    return TrainConfig(
        env=EnvConfig(sensor=SensorConfig(coverage="none")),
        run_dir=tmp_path / "run",
        num_envs=4,
        num_workers=1,
        total_frames=192,
    )


def test_a_run_learns_with_its_own_number_of_threads(config: TrainConfig):
    before = torch.get_num_threads()
    run = Run.create(replace(config, learner_threads=3))
    try:
        with open_trainer(run) as trainer:
            trainer.iterate()
            learners = [t for t in threading.enumerate() if "learner" in t.name]
            assert len(learners) == 3
            assert torch.get_num_threads() == 1
    finally:
        torch.set_num_threads(before)


def test_one_process_trains_a_run_at_a_time(config: TrainConfig):
    run = Run.create(config)
    with open_trainer(run):
        again = Run.open(run.path)
        with (
            pytest.raises(ValueError, match="is being trained by another process"),
            open_trainer(again),
        ):
            pass
    with again.locked():
        pass


def test_a_damaged_checkpoint_is_told_of(config: TrainConfig):
    run = Run.create(config)
    with open_trainer(run):
        pass
    tensors, header = load_tensors(run.checkpoint_path)
    tensors["agent/head.log_std"][3] = torch.nan
    save_tensors(run.checkpoint_path, tensors, header)
    message = "damaged: tensor 'head.log_std' is not finite"
    with pytest.raises(ValueError, match=message), open_trainer(Run.open(run.path)):
        pass
    with pytest.raises(ValueError, match=message):
        egoskin.load_policy(run.path)


def test_a_run_of_another_version_is_not_gone_on_with(config: TrainConfig):
    run = Run.create(config)
    args = ["--resume", str(run.path)]
    assert parse_config(args) == replace(run.config, run_dir=None, resume=run.path)
    file = run.path / "config.json"
    content, _ = read_sealed(file)
    del content["env"]["task"]["throws"]["lead"]
    file.write_bytes(sealed_json(content))
    message = r"config\.json lacks env\.task\.throws\.lead: another version made it"
    with pytest.raises(ValueError, match=message):
        parse_config(args)


def test_policies_are_kept_at_the_start_in_between_and_at_the_end(config: TrainConfig):
    # Of 64, 128 and 192 frames the second is the first past 65.
    run = Run.create(replace(config, snapshot_frames=65))
    with open_trainer(run) as trainer:
        train(trainer)
    found = sorted((run.path / "policies").iterdir())
    assert [int(path.stem) for path in found] == [0, 128, 192]
    assert egoskin.load_policy(found[-1]).spec.frames == 192


def test_a_commit_is_recorded_only_of_a_repository_that_holds_the_source(tmp_path):
    # An installed copy in an ignored folder of somebody's own repository.
    copy = tmp_path / "site" / "egoskin"
    source = Path(egoskin.__file__).parent
    shutil.copytree(source, copy, ignore=shutil.ignore_patterns("__pycache__"))
    git = ["git", "-c", "user.name=a", "-c", "user.email=a@b", "-C", str(tmp_path)]
    code = "import json; from egoskin.runs import _git_state as state; "
    code += "print(json.dumps(state()))"

    def state() -> dict | None:
        ran = subprocess.run(
            [sys.executable, "-c", code],
            cwd=copy.parent,
            capture_output=True,
            text=True,
            check=True,
        )
        return json.loads(ran.stdout)

    (tmp_path / ".gitignore").write_text("site\n")
    for command in (["init", "-q"], ["add", "."], ["commit", "-q", "-m", "mine"]):
        subprocess.run([*git, *command], check=True)
    assert state() is None
    for command in (["add", "-f", "site"], ["commit", "-q", "-m", "with it"]):
        subprocess.run([*git, *command], check=True)
    assert not state()["changed"]
    (copy / "py.typed").write_text("changed")
    assert state()["changed"]
