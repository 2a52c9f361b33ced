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
from egoskin.envs.dodgeball import DodgeballConfig
from egoskin.envs.standards import training_task
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


STANDARDS = [([], "2"), (["--standard", "2"], "2"), (["--standard", "1"], "1")]
STANDARDS += [(["--standard=paper"], "paper")]


@pytest.mark.parametrize(("args", "version"), STANDARDS)
def test_a_standard_sets_throws_and_ends(args, version):
    config = parse_config([*args, "--seed", "3", "--sensor.range", "1"])
    assert config.env.standard == version
    assert config.env.task == training_task(version, DodgeballConfig())
    # Nothing else.
    env = replace(config.env, task=DodgeballConfig())
    assert env == EnvConfig(sensor=SensorConfig(range=1.0))
    assert config.seed == 3


def test_a_throw_or_an_end_beside_a_standard_makes_it_custom():
    lead = parse_config(["--standard", "1", "--task.throws.lead", "0.5"]).env
    assert lead.standard == "custom"
    throws = training_task("1", DodgeballConfig()).throws
    assert lead.task.throws == replace(throws, lead=0.5)
    end = parse_config(["--task.success-s", "2", "--standard", "paper"]).env
    assert end.standard == "custom"
    assert end.task.throws.first_delay == (0.0, 0.0)
    # What belongs to no standard does not.
    drive = ["--standard", "1", "--task.action-scale", "0.2"]
    assert parse_config(drive).env.standard == "1"


@pytest.mark.parametrize("name", ["3", "Paper", "run"])
def test_a_standard_that_is_none_is_refused(name, capsys):
    with pytest.raises(SystemExit) as ended:
        parse_config(["--standard", name])
    assert ended.value.code == 2
    text = capsys.readouterr().err
    assert "--standard" in text
    assert "paper" in text


def test_a_policy_says_what_standard_it_was_trained_on(config: TrainConfig):
    args = ["--standard", "paper", "--run-dir", str(config.run_dir)]
    args += ["--num-envs", "4", "--num-workers", "1", "--total-frames", "64"]
    args += ["--sensor.coverage", "none", "--ppo.num-mini-batches", "1"]
    run = Run.create(parse_config(args))
    with open_trainer(run) as trainer:
        train(trainer)
    file = run.path / "policies" / "000000000064.safetensors"
    assert load_tensors(file)[1]["policy"]["standard"] == "paper"
    assert egoskin.load_policy(file).env_config.standard == "paper"
    assert Run.open(run.path).config.env.standard == "paper"
    # A resume has it already.
    for version in ("paper", "2"):
        with pytest.raises(ValueError, match="--standard cannot be changed on resume"):
            parse_config(["--resume", str(run.path), "--standard", version])
    assert parse_config(["--resume", str(run.path)]).env.standard == "paper"


def test_policies_are_kept_at_the_start_in_between_and_at_the_end(config: TrainConfig):
    # Of 64, 128 and 192 frames the second is the first past 65.
    run = Run.create(replace(config, snapshot_frames=65))
    with open_trainer(run) as trainer:
        train(trainer)
    found = sorted((run.path / "policies").iterdir())
    assert [int(path.stem) for path in found] == [0, 128, 192]
    assert egoskin.load_policy(found[-1]).policy_spec.frames == 192


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
