"""Runs started through the library: threads, saved policies, recorded commit."""

from __future__ import annotations

import os
import re
import resource
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensordict import TensorDict

import egoskin
from calling import limit_file_size
from egoskin.agents.ppo import NonFiniteError
from egoskin.commands.train import with_resume_advice
from egoskin.envs.dodgeball import DodgeballConfig
from egoskin.envs.rewards import TERMS
from egoskin.envs.standards import training_task
from egoskin.make import EnvConfig
from egoskin.robots.builtin import H1_2
from egoskin.runs import trainer as trainer_module
from egoskin.runs.config import TrainConfig, parse_config
from egoskin.runs.events import EventFile
from egoskin.runs.films import FilmMaker
from egoskin.runs.run import Run
from egoskin.runs.starts import git_state
from egoskin.runs.survival import SurvivalCurve
from egoskin.runs.trainer import METRIC_KEYS, Trainer, open_trainer, train
from egoskin.sensors import Field, Ray, Skin, place_sensors
from egoskin.sensors.config import SensorConfig, SkinConfig
from egoskin.storage.files import PARTIAL
from egoskin.storage.formats import read_sealed, sealed_json
from egoskin.storage.tensor_file import load_tensors, save_tensors
from making import blind_run


@pytest.fixture
def config(tmp_path: Path) -> TrainConfig:
    """Three rollouts of 64 frames."""
    return blind_run(tmp_path / "run", 192)


def test_a_run_learns_with_its_own_number_of_threads(config: TrainConfig):
    before = torch.get_num_threads()
    others = set(threading.enumerate())
    run = Run.create(replace(config, learner_threads=3))
    try:
        with open_trainer(run) as trainer:
            trainer.iterate()
            new = set(threading.enumerate()) - others
            assert sum("learner" in thread.name for thread in new) == 3
            assert torch.get_num_threads() == 1
    finally:
        torch.set_num_threads(before)


def test_the_seed_draws_the_networks_and_the_episodes(tmp_path):
    drawn = []
    for number, seed in enumerate((0, 1, 0)):
        config = replace(blind_run(tmp_path / str(number), 64), seed=seed)
        with open_trainer(Run.create(config)) as trainer:
            weights = [w.detach().clone() for w in trainer.agent.parameters()]
            drawn.append((weights, trainer.root["observation"].clone()))
    (one, start), (other, other_start), (again, same_start) = drawn
    assert all(torch.equal(a, b) for a, b in zip(one, again, strict=True))
    assert not all(torch.equal(a, b) for a, b in zip(one, other, strict=True))
    assert torch.equal(start, same_start)
    assert not torch.isclose(start, other_start).all(-1).any()


def test_a_run_without_a_folder_is_named_after_time_sensor_and_seed(
    tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    config = replace(blind_run(tmp_path / "run", 64), run_dir=None, seed=3)
    path = Run.create(config).path
    assert re.fullmatch(r"runs/\d{8}-\d{6}-blind-seed3", str(path))
    assert (tmp_path / path / "config.json").is_file()
    g1 = replace(config, env=replace(config.env, robot="g1"))
    assert re.fullmatch(r"runs/\d{8}-\d{6}-g1-blind-seed3", str(Run.create(g1).path))


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
    message = r"config\.json lacks env\.task\.throws\.lead: another version wrote it"
    with pytest.raises(ValueError, match=message):
        parse_config(args)


STANDARDS = [([], "2"), (["--standard", "2"], "2"), (["--standard", "1"], "1")]
STANDARDS += [(["--standard=paper"], "paper")]


@pytest.mark.parametrize(("args", "version"), STANDARDS)
def test_a_standard_sets_throws_and_ends(args, version):
    config = parse_config([*args, "--seed", "3", "--sensor.range", "1"])
    assert config.env.standard == version
    assert config.env.task == training_task(version, DodgeballConfig())
    # Nothing else changes.
    env = replace(config.env, task=DodgeballConfig())
    assert env == EnvConfig(sensor=SensorConfig(range=1.0))
    assert config.seed == 3


def test_a_standard_that_sets_nothing_is_refused():
    # Only the command line can distinguish defaults from given values.
    with pytest.raises(ValueError, match=r"has standard 2: .*training_task\('1'"):
        TrainConfig(standard="1")
    task = training_task("1", DodgeballConfig())
    assert TrainConfig(standard="1", env=EnvConfig(task=task)).env.standard == "1"


def test_a_throw_or_an_end_beside_a_standard_makes_it_custom():
    lead = parse_config(["--standard", "1", "--task.throws.lead", "0.5"]).env
    assert lead.standard == "custom"
    throws = training_task("1", DodgeballConfig()).throws
    assert lead.task.throws == replace(throws, lead=0.5)
    end = parse_config(["--task.success-s", "2", "--standard", "paper"]).env
    assert end.standard == "custom"
    assert end.task.throws.first_delay == (0.0, 0.0)
    # Options outside the standard do not.
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
    # On resume, it is known already.
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


@pytest.mark.parametrize(("interval", "frames"), [(1e-6, [64, 128]), (1e9, [0, 0])])
def test_checkpoints_are_written_at_their_interval(
    interval: float, frames: list[int], config: TrainConfig
):
    run = Run.create(replace(config, checkpoint_interval=interval))
    found = []

    def read(_: object) -> None:
        found.append(load_tensors(run.checkpoint_path)[1]["frames"])

    with open_trainer(run) as trainer:
        train(trainer, show=read)
    # When the second and the third rollout are shown.
    assert found[1:] == frames
    assert load_tensors(run.checkpoint_path)[1]["frames"] == 192


@pytest.mark.slow
def test_films_are_made_of_policies_on_the_way(config: TrainConfig, capfd):
    with open_trainer(Run.create(replace(config, film_every=128))) as trainer:
        train(trainer)
    run = trainer.run
    assert run.policy_path(128).exists()
    films = {path.name for path in (run.path / "films").iterdir()}
    told = capfd.readouterr().err
    assert films == {"000000000128.mp4", "000000000128.png"} or "OpenGL" in told


@pytest.mark.slow
def test_a_film_that_cannot_be_made_is_told_of(tmp_path, capfd):
    (tmp_path / "config.json").write_text("{}")
    with FilmMaker(tmp_path, 60.0) as maker:
        maker.start(tmp_path / "config.json")
    waiting, line = capfd.readouterr().err.splitlines()
    assert waiting.startswith("waiting for the film ")
    assert line.startswith("note: film ")
    assert ".mp4 failed: " in line
    assert "config.json" in line


@pytest.mark.parametrize(
    ("control_hz", "fps"), [(60.0, 20.0), (10.0, 10.0), (50 / 3,) * 2]
)
def test_a_film_has_no_more_frames_than_the_run_has_steps(
    control_hz, fps, tmp_path, monkeypatch
):
    commands = []

    class Done:
        returncode = 0

        def __init__(self, command: list[str], **kwargs: Any) -> None:
            commands.append(command)

        def poll(self) -> int:
            return 0

        def communicate(self) -> tuple[None, str]:
            return None, ""

    monkeypatch.setattr(subprocess, "Popen", Done)
    with FilmMaker(tmp_path, control_hz) as maker:
        maker.start(tmp_path / "policy.safetensors")
    (command,) = commands
    assert float(command[command.index("--fps") + 1]) == fps
    assert command[command.index("--size") + 1 :][:3] == ["480", "270", "--longest-of"]
    # The throws are those of the training.
    assert command[command.index("--standard") + 1] == "run"


def test_a_long_log_does_not_slow_its_next_line(config: TrainConfig, tmp_path: Path):
    def seconds(lines: int) -> float:
        run = Run.create(replace(config, run_dir=tmp_path / str(lines)))
        run.record_start()
        row = {"frames": 1.0, **{f"value_{i}": i / 3 for i in range(30)}}
        run.start_metrics(0)
        run.log(row)
        run._metrics += run._metrics[1:] * lines
        began = time.process_time()
        for _ in range(20):
            run.log(row)
        ended = time.process_time()
        run.close()
        return ended - began

    assert min(seconds(50_000 + i) for i in range(3)) < 10 * seconds(1)


def test_a_killed_film_is_told_of_and_one_that_training_ends_is_not(tmp_path, capfd):
    with FilmMaker(tmp_path, 60.0) as maker:
        maker.start(tmp_path / "policy.safetensors")
        assert maker._process is not None
        maker._process.kill()
    assert "policy.mp4 failed: exit status -9" in capfd.readouterr().err
    with suppress(OSError), FilmMaker(tmp_path, 60.0) as maker:
        maker.start(tmp_path / "policy.safetensors")
        raise OSError("full")
    assert capfd.readouterr().err == ""


def test_advice_after_a_failure_is_a_command_that_helps(config: TrainConfig, tmp_path):
    run = Run.create(replace(config, run_dir=tmp_path / "a run"))
    with (
        pytest.raises(SystemExit, match=f"--resume '{run.path}'"),
        with_resume_advice(run),
    ):
        raise OSError("disk full")
    # A resume would fail again at the same update.
    with (
        pytest.raises(SystemExit, match=f"--init-from '{run.path}'") as ended,
        with_resume_advice(run),
    ):
        raise NonFiniteError("loss_actor nan", TensorDict())
    assert "--resume" not in str(ended.value)
    # The other options stay as they are.
    assert f"--config '{run.path / 'config.json'}'" in str(ended.value)


def test_metrics_go_to_weights_and_biases(config: TrainConfig, monkeypatch):
    """Checks the calls to wandb; a resume continues the same wandb run."""
    given = {}

    class Recorded:
        Error = RuntimeError

        def init(self, **options: object) -> Recorded:
            given.update(options, rows=[], finished=False)
            return self

        def log(self, metrics: dict[str, float], step: int) -> None:
            given["rows"].append((step, metrics["reward/mean"]))

        def finish(self) -> None:
            given["finished"] = True

    monkeypatch.setitem(sys.modules, "wandb", Recorded())
    with open_trainer(Run.create(replace(config, log="wandb"))) as trainer:
        train(trainer)
    identity = given["id"]
    rows = trainer.run.metrics().splitlines()[1:]
    assert [step for step, _ in given["rows"]] == [64, 128, 192]
    assert len(rows) == 3
    assert given["finished"]
    assert given["config"]["num_envs"] == 4
    again = parse_config(["--resume", str(trainer.run.path), "--total-frames", "256"])
    with open_trainer(Run(trainer.run.path, again)) as trainer:
        train(trainer)
    assert given["id"] == identity
    assert [step for step, _ in given["rows"]] == [256]


def test_a_commit_is_recorded_only_of_a_repository_that_holds_the_source(
    tmp_path, monkeypatch
):
    # An installed copy in an ignored folder of a user's repository.
    source = tmp_path / "site" / "run.py"
    source.parent.mkdir()
    source.write_text("")
    # A developer's own settings, such as signed commits, do not apply.
    for name in ("GIT_CONFIG_GLOBAL", "GIT_CONFIG_SYSTEM"):
        monkeypatch.setenv(name, os.devnull)
    git = ["git", "-c", "user.name=a", "-c", "user.email=a@b", "-C", str(tmp_path)]
    (tmp_path / ".gitignore").write_text("site\n")
    for command in (["init", "-q"], ["add", "."], ["commit", "-q", "-m", "mine"]):
        subprocess.run([*git, *command], check=True)
    assert git_state(source) is None
    for command in (["add", "-f", "site"], ["commit", "-q", "-m", "with it"]):
        subprocess.run([*git, *command], check=True)
    state = git_state(source)
    assert state is not None
    assert len(state["commit"]) == 40
    assert not state["changed"]
    source.write_text("changed")
    assert git_state(source)["changed"]


# --- folders prepared by another user -----------------------------------------------


def test_nothing_is_written_through_a_link(config: TrainConfig, tmp_path: Path):
    run = Run.create(config)
    with open_trainer(run) as trainer:
        train(trainer)
    victim = tmp_path / "victim"
    victim.write_text("mine")
    # The id of the writing process is predictable.
    partial = f".checkpoint.safetensors.{os.getpid()}.partial"
    for name in (partial, "metrics.csv", "versions.json"):
        (run.path / name).unlink(missing_ok=True)
        (run.path / name).symlink_to(victim)
    longer = ["--resume", str(run.path), "--total-frames", "256"]
    with open_trainer(Run(run.path, parse_config(longer))) as trainer:
        train(trainer)
    assert victim.read_text() == "mine"
    assert len((run.path / "metrics.csv").read_text().splitlines()) == 5
    assert not (run.path / "metrics.csv").is_symlink()
    assert egoskin.load_policy(run.path).policy_spec.frames == 256


@pytest.mark.parametrize("name", ["lock", "policies"])
def test_a_link_that_cannot_be_replaced_is_refused(
    name: str, config: TrainConfig, tmp_path: Path
):
    run = Run.create(config)
    elsewhere = tmp_path / "elsewhere"
    if name == "lock":
        elsewhere.write_text("mine")
    else:
        (run.path / name).rmdir()
        elsewhere.mkdir()
    (run.path / name).symlink_to(elsewhere)
    with (
        pytest.raises(ValueError, match=f"{name} is a link, which is not followed"),
        open_trainer(run),
    ):
        pass
    if name == "lock":
        assert elsewhere.read_text() == "mine"
    else:
        assert not list(elsewhere.iterdir())


def test_a_metrics_file_turned_into_a_link_while_it_trains_is_not_followed(
    config: TrainConfig, tmp_path: Path
):
    victim = tmp_path / "victim"
    victim.write_text("mine")
    run = Run.create(config)
    with open_trainer(run) as trainer:
        run.log(trainer.iterate())
        (run.path / "metrics.csv").unlink()
        (run.path / "metrics.csv").symlink_to(victim)
        with pytest.raises(OSError, match=r"metrics\.csv"):
            train(trainer)
    assert victim.read_text() == "mine"


# --- the disk -----------------------------------------------------------------------


@contextmanager
def full_disk() -> Iterator[None]:
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    limit_file_size(16)
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


@pytest.mark.parametrize(
    ("write", "name"),
    [
        (lambda t: t.run.log({"frames": 64}), "metrics.csv"),
        (lambda t: t.run._events.log({"frames": 64, "x": 1.0}), "events.out.tfevents"),
        (lambda t: EventFile(t.run.path, 0), "events.out.tfevents"),
        (lambda t: t.run.write_config(), "config.json"),
        (lambda t: t.run.record_start(), "versions.json"),
        (lambda t: t.save(), "checkpoint.safetensors"),
        (lambda t: t.keep_policy(), "000000000064.safetensors"),
        (lambda t: t.dump(NonFiniteError("x", TensorDict())), "not-finite-"),
        (lambda t: Run.create(replace(t.config, run_dir=t.run.path / "new")), "skin"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_a_full_disk_names_the_file(write, name: str, finished: Trainer):
    with pytest.raises(OSError, match="File too large") as error, full_disk():
        write(finished)
    assert Path(str(error.value.filename)).name.startswith(name)
    assert not list(finished.run.path.rglob(PARTIAL))
    # A run that could not be created can be created again.
    assert not (finished.run.path / "new").exists()


def test_a_folder_renamed_while_it_trains_ends_with_one_clear_error(
    config: TrainConfig,
):
    run = Run.create(config)
    moved = run.path.with_name("moved")
    with open_trainer(run) as trainer:
        run.log(trainer.iterate())
        trainer.save()
        run.path.rename(moved)
        with pytest.raises(OSError, match=r"No such file .*run/metrics\.csv"):
            train(trainer)
    assert not run.path.exists()
    assert "--resume it by its new name" in run.resume_advice()
    again = Run(moved, parse_config(["--resume", str(moved)]))
    with open_trainer(again) as trainer:
        assert trainer.frames == 64
        train(trainer)


# --- checkpoints that do not fit ----------------------------------------------------


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("optimizer/0/exp_avg", torch.zeros(3), "optimiser state belongs to other"),
        ("optimizer/1/step", torch.zeros(1), "optimiser state belongs to other"),
        ("optimizer/1/exp_avg_sq", None, "optimiser state belongs to other"),
        ("agent/head.log_std", torch.zeros(21, 1), r"expected \[21\] of float32, got"),
        (
            "agent/head.log_std",
            torch.zeros(21, dtype=torch.float64),
            r"got \[21\] of float64",
        ),
        ("agent/head.log_std", None, "'head.log_std' of the networks is missing"),
        ("env/simulation/physics", torch.zeros(4, 3), "'env/simulation/physics' does"),
        ("env/root/observation", None, "'env/root/observation' is missing"),
        ("survival/ended", torch.zeros(3), "'survival/ended' does not fit"),
        ("random_state", torch.zeros(5, dtype=torch.uint8), "'random_state' does not"),
    ],
)
def test_a_tensor_that_does_not_fit_is_named_before_anything_is_loaded(
    name, value, message, finished: Trainer
):
    tensors, header = finished.run.load_checkpoint()
    before = finished.agent.head.log_std.detach().clone()
    tensors["agent/head.log_std"] = before / 2
    if value is None:
        del tensors[name]
    else:
        tensors[name] = value
    with pytest.raises(ValueError, match=message):
        finished.load(tensors, header)
    assert torch.equal(finished.agent.head.log_std, before)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("frames", None),
        ("frames", -1),
        ("frames", "many"),
        ("wall_s", float("nan")),
        ("learning_rate", 0.0),
        ("learning_rate", [1]),
    ],
)
def test_a_header_that_no_training_writes_is_refused(name, value, finished: Trainer):
    tensors, header = finished.run.load_checkpoint()
    if value is None:
        del header[name]
    else:
        header[name] = value
    with pytest.raises(ValueError, match=name):
        finished.load(tensors, header)


# --- what is logged -----------------------------------------------------------------


def outputs(steps: int, agents: int) -> TensorDict:
    """Return the outputs of a rollout in which nothing happens, ``[T, N]``."""
    info = TensorDict(batch_size=[steps, agents])
    for key in METRIC_KEYS:
        info[key] = torch.zeros(steps, agents, 1, dtype=torch.bool)
    for key in ("episode_step", "first_throw_step"):
        info[key] = info[key].long()
    info["reward"] = torch.zeros(steps, agents, 1)
    info["reward_terms"] = torch.zeros(steps, agents, len(TERMS))
    return info


def test_an_episode_ends_by_one_cause(finished: Trainer):
    info = outputs(1, 4)
    # Of four: hit and thrown over; hit; fallen; and one that goes on.
    info["hit"][0, :2] = True
    info["fallen"][0, [0, 2]] = True
    info["terminated"][0, :3] = True
    metrics = finished._episode_metrics(info)
    assert metrics["episode/ended_by_ball"] == pytest.approx(2 / 3)
    assert metrics["episode/ended_by_fall"] == pytest.approx(1 / 3)


def test_success_and_survival_count_from_the_first_throw(
    finished: Trainer, monkeypatch
):
    task = finished.config.env.task

    def metrics(later: int) -> dict[str, float]:
        curve = SurvivalCurve(task.episode_steps)
        monkeypatch.setattr(finished, "survival", curve)
        # Steps 30 to 30 + 3 s of four agents, thrown at after step 30; one ends at 31.
        steps = torch.arange(30, 31 + round(task.success_s * task.physics.control_hz))
        info = outputs(len(steps), 4)
        info["episode_step"] = (later + steps)[:, None, None].expand(-1, 4, 1).clone()
        info["first_throw_step"] = torch.full((*info.shape, 1), later + 30)
        info["terminated"][1, 0] = True
        # It has started again, and waits for its first throw.
        info["episode_step"][2:, 0] = 1
        return finished._episode_metrics(info)

    found = metrics(0)
    # 3 of 4 survive age 1, and all three the rest.
    assert found["episode/success"] == pytest.approx(3 / 4)
    # Ages 0 to 3 s have been reached: 1 step of survival 1 and 3 s of 3/4.
    expected = 1 / task.physics.control_hz + 3 / 4 * task.success_s
    assert found["episode/survival_s"] == pytest.approx(expected)
    # Only the age counts.
    np.testing.assert_equal(metrics(7), found)


def test_the_survival_of_earlier_rollouts_fades(finished: Trainer, monkeypatch):
    task = finished.config.env.task
    curve = SurvivalCurve(task.episode_steps)
    monkeypatch.setattr(finished, "survival", curve)
    # Four of four end at age 1, and none of four in the next rollout.
    info = outputs(1, 4)
    info["episode_step"][:] = 1
    info["terminated"][:] = True
    finished._episode_metrics(info)
    assert curve.probability(1) == 0
    info["terminated"][:] = False
    finished._episode_metrics(info)
    # The first four count as 0.9 each: 3.6 of 7.6 end.
    assert curve.probability(1) == pytest.approx(4 / 7.6)


def test_rewards_and_diverged_rows_by_hand(finished: Trainer):
    info = outputs(3, 2)
    info["reward"][:, :, 0] = torch.tensor([[-1.0, 2], [3, 4], [-3, 7]])
    info["diverged"][:2, 1] = True
    # The n-th term is n and n + 2 of the two agents.
    number = torch.arange(float(len(TERMS)))
    info["reward_terms"][:, 0], info["reward_terms"][:, 1] = number, number + 2
    metrics = finished._episode_metrics(info)
    assert metrics["reward/mean"] == pytest.approx(2.0)
    assert metrics["reward/negative_share"] == pytest.approx(2 / 6)
    assert metrics["episode/diverged"] == 2
    for i, name in enumerate(TERMS):
        assert metrics[f"reward/{name}"] == pytest.approx(i + 1)


def test_times_by_hand_also_of_a_training_that_goes_on(finished: Trainer, monkeypatch):
    tensors, header = finished.run.load_checkpoint()
    before = header["wall_s"]
    assert before > 0
    # Three seconds for the rollout of 64 frames, one for the update.
    times = iter((10.0, 13.0, 14.0))
    clock = SimpleNamespace(perf_counter=lambda: next(times))
    monkeypatch.setattr(trainer_module, "time", clock)
    metrics = finished.iterate()
    assert metrics["time/collect_share"] == pytest.approx(3 / 4)
    assert metrics["time/steps_per_s"] == pytest.approx(16.0)
    assert metrics["time/wall_s"] == pytest.approx(before + 4)
    finished.load(tensors, header)
    assert finished.wall_s == before


@pytest.mark.parametrize("back", [False, True])
def test_tensorboard_shows_each_point_once(
    back: bool, config: TrainConfig, monkeypatch
):
    now = time.time_ns()
    run = Run.create(config)
    with open_trainer(run) as trainer:
        # Logged after the checkpoint at frame 0, as if the process had been killed.
        run.log(trainer.iterate())
    if back:
        monkeypatch.setattr(time, "time_ns", lambda: now - 10**15)
    again = Run.open(run.path)
    with open_trainer(again) as trainer:
        train(trainer)
    events = EventAccumulator(str(run.path))
    events.Reload()
    steps = [point.step for point in events.Scalars("reward/mean")]
    assert steps == [64, 128, 192]


def test_options_that_a_skin_file_leaves_without_effect_are_refused(
    config: TrainConfig, tmp_path: Path
):
    plain = place_sensors(H1_2, 4, seed=0)
    whole = replace(plain, range=np.ones(4), coverage=(Field(),) * 4)
    part = replace(plain, range=np.array([1, 1, 1, np.nan]), coverage=(Field(),) * 4)
    grid = replace(plain, coverage=(Ray(grid=(4, 4)),) * 4)

    def create(skin: Skin, name: str, **sensor: Any) -> None:
        skin.save(tmp_path / "skin.json")
        env = EnvConfig(
            skin=SkinConfig(path=tmp_path / "skin.json"), sensor=SensorConfig(**sensor)
        )
        Run.create(replace(config, env=env, run_dir=tmp_path / name))

    text = "has no effect: the skin file sets the (range|type) of each sensor"
    for skin, sensor in (
        (whole, {"range": 0.5}),
        (whole, {"coverage": "ray"}),
        (whole, {"field": Field(half_angle_deg=45)}),
        (grid, {"coverage": "ray", "ray": Ray(grid=(2, 2))}),
    ):
        with pytest.raises(ValueError, match=text):
            create(skin, "never", **sensor)
    assert not (tmp_path / "never").exists()
    # The default, what the file also says, and what some sensor takes.
    create(whole, "default")
    create(whole, "same", range=1.0)
    create(part, "some", range=0.5)
    create(grid, "kind", coverage="ray")
    create(grid, "both", coverage="ray", ray=Ray(grid=(4, 4)))
