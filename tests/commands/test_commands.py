"""Commands as a user runs them: train, stop, resume, evaluate, and bad input."""

from __future__ import annotations

import csv
import json
import os
import signal
import threading
import time
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from tensordict import TensorDict

import egoskin
import egoskin.commands.evaluate as command
from calling import BATCH, SCHEDULES, SMALL, call, fail, succeed
from egoskin.agents.ppo import PPO
from egoskin.agents.rollout import collect
from egoskin.commands.evaluate import EvaluateConfig
from egoskin.commands.upper_bound import table
from egoskin.commands.verify import run_hash
from egoskin.envs.dodgeball import DodgeballConfig
from egoskin.evaluation import operating_map, perturbations
from egoskin.evaluation.perturbations import PERTURBATIONS
from egoskin.evaluation.throw_set import (
    Avoided,
    Estimate,
    Evaluation,
    evaluate,
    standard_task,
)
from egoskin.evaluation.upper_bound import Outcome, UpperBound
from egoskin.progress import counted
from egoskin.runs import trainer
from egoskin.runs.run import Run
from egoskin.sensors import MASK_ALL, Skin
from egoskin.storage.tensor_file import load_tensors


def metrics(folder: Path) -> list[dict[str, str]]:
    with open(folder / "metrics.csv", newline="") as file:
        return list(csv.DictReader(file))


def test_a_run_folder_holds_what_is_needed_to_understand_it(trained: Path):
    config = json.loads((trained / "config.json").read_text())
    sensor = config["env"]["sensor"]
    assert (sensor["coverage"], sensor["signal"]) == ("field", "proximity")
    assert sensor["range"] == 2.0
    assert config["env"]["task"]["throws"]["radius"] == 0.15
    (start,) = json.loads((trained / "versions.json").read_text())["starts"]
    assert start["packages"]["torch"] == torch.__version__
    assert len(json.loads((trained / "skin.json").read_text())["sensors"]) == 64
    assert [int(row["frames"]) for row in metrics(trained)] == [
        BATCH * n for n in (1, 2, 3, 4)
    ]
    assert list(trained.glob("events.out.tfevents.*"))
    names = [path.stem for path in sorted((trained / "policies").iterdir())]
    assert names == ["000000000000", f"{4 * BATCH:012d}"]


def test_a_resumed_run_equals_one_that_never_stopped(
    trained: Path, tmp_path: Path, monkeypatch
):
    correlations, frames = [], []
    update = PPO.update

    def collecting(*args):
        correlations.append(args[-1])
        return collect(*args)

    def updating(self: PPO, rollout: TensorDict, now: int):
        frames.append(now)
        return update(self, rollout, now)

    monkeypatch.setattr(trainer, "collect", collecting)
    monkeypatch.setattr(PPO, "update", updating)
    args = ("--run-dir", tmp_path / "halves", "--total-frames", 2 * BATCH)
    succeed("train", *SMALL, *SCHEDULES, *args)
    succeed("train", "--resume", tmp_path / "halves", "--total-frames", 4 * BATCH)
    whole, halves = (Run.open(path) for path in (trained, tmp_path / "halves"))
    assert run_hash(halves) == run_hash(whole)
    # The schedules change with the frames of the run, not of the call.
    now = halves.config.ppo.noise_correlation
    assert correlations == [0, now, now, now]
    assert frames == [0, BATCH, 2 * BATCH, 3 * BATCH]


def test_ctrl_c_leaves_a_checkpoint_and_says_how_to_go_on(tmp_path: Path):
    folder = tmp_path / "stopped"

    def interrupt() -> None:
        while not (folder / "metrics.csv").exists():
            time.sleep(0.02)
        os.kill(os.getpid(), signal.SIGINT)

    threading.Thread(target=interrupt, daemon=True).start()
    out = succeed("train", *SMALL, "--run-dir", folder)
    assert f"egoskin train --resume {folder}" in out
    _, header = load_tensors(folder / "checkpoint.safetensors")
    assert header["frames"] == int(metrics(folder)[-1]["frames"]) > 0


EPISODES = 6


def figures_of(folder: Path, *args: str | Path) -> tuple[dict, str]:
    """(JSON, text) of an evaluation."""
    out = folder / "out.json"
    done = call("evaluate", *args, "--episodes", EPISODES, "--json", out)
    assert done.returncode == 0, done.stderr
    assert f"playing {EPISODES} episodes" in done.stderr
    return json.loads(out.read_text()), done.stdout


@pytest.fixture(scope="module")
def evaluated(trained: Path, tmp_path_factory) -> dict[str, tuple[dict, str]]:
    """(JSON, text) of evaluations by each standard."""
    folder = tmp_path_factory.mktemp("evaluated")
    return {
        standard: figures_of(folder, trained, "--standard", standard)
        for standard in ("1", "2", "paper", "run")
    }


def test_an_evaluation_has_the_figures_promised(evaluated):
    result, text = evaluated["2"]
    assert result.keys() == {
        "policy",
        "throws_of_training",
        "success",
        "success_5s",
        "survival_time",
        "ended_by_ball",
        "ended_by_fall",
        "ended_by_self_contact",
        "diverged",
        "rigid_success",
        "avoided",
        "episodes",
        "standard",
        "trained_on",
        "throw_set",
        "frames",
        "mask",
        "skin",
        "engine",
        "trained_by_engine",
    }
    about = {"standard": "2", "trained_on": "2", "throw_set": 0, "mask": []}
    about |= {"engine": "mujoco", "trained_by_engine": "mujoco"}
    assert {key: result[key] for key in about} == about
    assert result["frames"] == 4 * BATCH
    assert f"trained for {4 * BATCH:,} frames on standard 2; evaluated on " in text
    assert "success (no contact for 3 s)" in text
    assert "no contact for 5 s" in text
    assert result["success_5s"]["mean"] <= result["success"]["mean"]
    assert result["success"].keys() == result["survival_time"].keys()
    assert result["success"].keys() == {"mean", "low", "high"}
    ends = result["ended_by_ball"] + result["ended_by_fall"] + result["diverged"]
    assert result["success"]["mean"] + ends == pytest.approx(1.0)


def test_an_evaluation_says_what_the_policy_does_and_at_another_physics_rate(
    trained: Path, tmp_path: Path
):
    out = succeed(
        "evaluate",
        *(trained, "--episodes", EPISODES, "--json", tmp_path / "out.json"),
        *("--behaviour", "--check-substeps", "8", "--standard", "run"),
    )
    assert "physics at 120 Hz" in out
    assert "physics at 480 Hz" in out
    assert "success lost with the other physics rate" in out
    # With the throws of its training, the first throw comes after a delay.
    assert "before the first throw, from 0.5 s on" in out
    assert "speed at arrival" in out
    assert "mechanical power" in out
    result = json.loads((tmp_path / "out.json").read_text())
    assert result["check_substeps"] == 8
    assert result["checked"]["episodes"] == result["episodes"] == EPISODES
    assert 0 < result["behaviour"]["waiting"]["base_speed"] < 1
    # Another rate gives other episodes.
    assert result["checked"]["survival_time"] != result["survival_time"]
    numbers = result["behaviour"]["throws"]["number of the ball"]
    assert [g["name"] for g in numbers] == ["first", "second", "third", "later"]
    groups = result["behaviour"]["throws"]["direction"]
    assert [g["name"] for g in groups] == ["front", "left", "back", "right"]
    assert sum(g["episodes"] for g in groups) == EPISODES


def test_an_evaluation_says_by_which_standard_it_judges(evaluated):
    results = {}
    for standard, (result, text) in evaluated.items():
        assert result["trained_on"] == "2"
        judged = "2" if standard == "run" else standard
        assert result["standard"] == judged
        throws = f"standard {judged}"
        if standard == "run":
            throws = "the throws of its training"
        assert f"on standard 2; evaluated on {throws}, throw set 0" in text
        results[standard] = result["survival_time"]
    # Standards 2 and paper give the same result, with the first ball at the start; in
    # its training that ball comes later, and version 1 aims elsewhere.
    assert results["2"] == results["paper"]
    assert len({str(value) for value in results.values()}) == 3


def test_an_evaluation_may_mask_all_sensors_or_those_of_some_links(
    trained: Path, tmp_path: Path
):
    policy = egoskin.load_policy(trained)
    task = standard_task(policy.env_config)
    links = ["torso_link", "left_elbow_link"]
    for names, mask in (([], ["all"]), (links, links)):
        result, text = figures_of(tmp_path, trained, "--mask", *names)
        assert result["mask"] == mask
        assert f"sensors masked: {', '.join(mask)}" in text
        # Its success is that of the policy with masked sensors.
        played = evaluate(
            policy,
            *(task, policy.skin),
            throw_set=0,
            episodes=EPISODES,
            mask=mask,
        )
        assert result["survival_time"] == asdict(played.survival_time)
        assert result["success"] == asdict(played.success)
    assert EvaluateConfig(policy=trained, mask=("all",)).masked == MASK_ALL


def test_an_evaluation_may_wear_another_skin(tmp_path: Path):
    policy = egoskin.load_policy("field_proximity")
    trained = Path("field_proximity")
    path, known = tmp_path / "worn.json", len(policy.skin)
    moved = replace(policy.skin, range=np.full(known, 0.3))
    moved.save(path)
    result, text = figures_of(tmp_path, trained, "--skin", path)
    assert f", skin {path}" in text
    assert result["skin"] == str(path)
    task = standard_task(policy.env_config)
    played, own = (
        evaluate(policy, task, skin, throw_set=0, episodes=EPISODES)
        for skin in (Skin.load(path), policy.skin)
    )
    assert result["survival_time"] == asdict(played.survival_time)
    assert played.survival_time != own.survival_time
    moved.select(range(5)).save(path)
    message = f"the skin gives 5 readings, but the policy was trained with {known}"
    assert message in fail("evaluate", trained, "--skin", path)
    assert "the policy reads no skin" in fail("evaluate", "blind", "--skin", path)
    replace(moved, robot="g1").save(path)
    assert "g1" in fail("evaluate", trained, "--skin", path)


@pytest.mark.parametrize(
    ("args", "expected"),
    [
        (["--skin", "no.json"], "no.json"),
        (
            ["--mask", "torso_lnk"],
            "no sensor on 'torso_lnk', did you mean 'torso_link'? (links",
        ),
        (["--mask", "all", "torso_link"], "no sensor on 'all'"),
        (["--standard", "3"], "--standard"),
        (["--map", "map.txt"], ".png"),
        (["--map", "no/map.png"], "no folder no"),
        (["--map", "a.png", "--json", "./a.png"], "--json and --map are the same"),
        (["--throw-set", str(2**32)], "throw_set must be in [0, 2**32)"),
        (["--episodes", "0"], "episodes must be at least 1"),
        (["--check-substeps", "0"], "check_substeps must be at least 1, got 0"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_bad_input_to_an_evaluation_is_one_clear_message(
    args: list[str], expected: str, trained: Path, tmp_path: Path, monkeypatch
):
    pytest.importorskip("matplotlib")
    monkeypatch.chdir(tmp_path)
    text = fail("evaluate", trained, *args)
    assert expected in text
    assert "playing" not in text
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_an_evaluation_draws_an_operating_map(
    trained: Path, tmp_path: Path, monkeypatch
):
    pytest.importorskip("matplotlib")
    # Two lines: one of two points and one of a single point.
    fast, tempo = {operating_map._SPEED: (4.0, 8.0)}, {operating_map._INTERVAL: (1.0,)}
    monkeypatch.setattr(operating_map, "_MAPS", (fast, tempo, fast | tempo))
    picture = tmp_path / "map.png"
    result, text = figures_of(tmp_path, trained, "--map", picture, "--mask")
    assert f"{picture}: success against speed" in text
    assert picture.read_bytes()[:4] == b"\x89PNG"
    speed, interval, both = result["map"]
    assert speed["names"] == ["speed of the ball [m/s]"]
    assert [point["values"] for point in speed["points"]] == [[4.0], [8.0]]
    assert result["map_episodes"] == max(result["episodes"] // 4, 1)
    assert interval["trained"] == [[1.0, 2.0]]
    assert [point["values"] for point in both["points"]] == [[4.0, 1.0], [8.0, 1.0]]


def test_an_evaluation_tells_what_a_policy_bears(
    trained: Path, tmp_path: Path, monkeypatch
):
    # Keep the first, and the one that combines all.
    first, *_, last = PERTURBATIONS.items()
    kept = dict([first, last])
    monkeypatch.setattr(perturbations, "PERTURBATIONS", kept)
    result, text = figures_of(tmp_path, trained, "--perturbed")
    names = [row["name"] for row in result["perturbed"]]
    assert names == list(kept)
    each = result["perturbed_episodes"]
    assert each == max(result["episodes"] // 4, 1)
    assert f"\n  {counted(each, 'episode')} each\n" in text
    assert all(f"\n  {name} " in text for name in names)


def test_the_workers_of_an_evaluation_are_those_of_all_its_parts(
    trained: Path, monkeypatch
):
    used = []

    def noted(*args, num_workers: int | None = None, **options):
        used.append((options["episodes"], num_workers))
        return []

    monkeypatch.setattr(command, "perturb", noted)
    args = ("--perturbed", "--episodes", "8", "--num-workers", "2")
    assert call("evaluate", trained, *args).returncode == 0
    # A quarter of the episodes, on as many workers as divide it.
    assert used == [(2, 2)]


def test_the_throw_set_of_an_evaluation_is_that_asked_for(monkeypatch):
    given = {}

    def noted(*args, **options):
        given.update(options)
        raise SystemExit

    monkeypatch.setattr(command, "evaluate", noted)
    call("evaluate", "field_proximity", "--throw-set", "5", "--episodes", "8")
    assert (given["throw_set"], given["episodes"]) == (5, 8)


def test_a_table_names_the_ages_of_the_task():
    share = Estimate(mean=0.5, low=0.4, high=0.6)
    result = Evaluation(
        success=share,
        success_5s=share,
        survival_time=share,
        ended_by_ball=0.5,
        ended_by_fall=0.0,
        ended_by_self_contact=0.0,
        diverged=0.0,
        rigid_success=0.0,
        avoided=Avoided(first_ball=None, later_balls=None),
        episodes=8,
    )
    task = DodgeballConfig(success_s=2.0, episode_length_s=4.0)
    text = command.table(result, "title", task)
    assert "success (no contact for 2 s)" in text
    assert "no contact for 4 s" in text
    assert "survival time (at most 4 s)" in text


def test_an_upper_bound_counts_what_policy_and_search_avoid(tmp_path: Path):
    out = tmp_path / "upper-bound.json"
    search = ("--search.samples", "4", "--search.iterations", "1")
    # Long enough for the ball to arrive in each plan, short enough to take seconds.
    done = call(
        "upper-bound",
        *("field_proximity", "--throws", "12", "--json", out),
        *(*search, "--search.stand-s", "0.75"),
    )
    assert done.returncode == 0, done.stderr
    assert "12 throws (ball 1 of the episodes) of throw set 0 that came" in done.stdout
    assert "iteration 1 of 1" in done.stderr
    content = json.loads(out.read_text())
    assert content["all"]["throws"] == 12
    assert (content["ball"], content["search"]["seed"]) == (1, 0)
    rows = content["by_height_m"]
    assert sum(row["throws"] for row in rows) == 12
    avoided = sum(row["policy_avoids"] for row in rows)
    assert 0 < avoided <= sum(row["search_avoids"] for row in rows)
    # The least range of a sensor is 1 mm.
    for reach in ("0", "1e-4"):
        bad = fail("upper-bound", "field_proximity", "--reach", reach)
        assert "reach must be at least 0.001" in bad


def test_the_options_of_an_upper_bound_reach_the_search(monkeypatch):
    given = {}

    def noted(policy, config, search, **options):
        given.update(options, seed=search.seed)
        raise SystemExit

    monkeypatch.setattr("egoskin.commands.upper_bound.find_upper_bound", noted)
    args = ("--throw-set", "3", "--throws", "5", "--ball", "2", "--reach", "0.5")
    call("upper-bound", "field_proximity", *args, "--search.seed", "7")
    del given["on_iteration"]
    expected = {"throw_set": 3, "throws": 5, "ball": 2, "reach": 0.5, "seed": 7}
    assert given == expected


def test_all_throws_include_those_aimed_above_the_last_group():
    # Of three throws, the policy avoids the first and the last, aimed at 2.5 m.
    avoided = torch.tensor([True, False, True])
    found = UpperBound(
        height=torch.tensor([0.5, 1.0, 2.5]),
        policy=Outcome(avoided=avoided, stood=avoided),
        best=Outcome(avoided=avoided | True, stood=avoided),
    )
    lines = table(found, "title").splitlines()
    assert lines[-2].split() == ["1.3", "to", "2", "m", *"00000"]
    assert lines[-1].split() == ["all", *"32232"]


def test_a_run_and_its_last_policy_act_alike_without_any_environment(trained: Path):
    policy = egoskin.load_policy(trained / "policies" / f"{4 * BATCH:012d}.safetensors")
    td = policy.env_config.sensor
    assert (td.coverage, td.signal, td.range) == ("field", "proximity", 2.0)
    assert len(policy.skin) == 64
    batch = TensorDict(
        {"observation": torch.zeros(7, 48), "signal": torch.ones(7, 64)}, [7]
    )
    action = policy(batch)["action"]
    assert torch.equal(egoskin.load_policy(trained)(batch)["action"], action)


CELLS = [
    ["--sensor.coverage", "none"],
    ["--sensor.coverage", "oracle"],
    ["--sensor.coverage", "oracle", "--history", "2"],
    *(
        ["--sensor.coverage", coverage, "--sensor.signal", signal, *reduced]
        for signal in ("localization", "proximity", "closeness", "binary")
        for coverage, reduced in (
            ("field", []),
            ("ray", []),
            ("ray", ["--sensor.reduce", "min"]),
        )
        # Refused: a localization does not depend on it.
        if not (reduced and signal == "localization")
    ),
    ["--sensor.corruption", "time_of_flight", "--history", "3"],
    ["--sensor.occlusion"],
    ["--sensor.signal", "localization", "--sensor.keep-last"],
    ["--sensor.range", "inf", "--sensor.field.half-angle-deg", "90"],
]


# By default one of each kind of observation; the others are marked slow.
QUICK = (
    "oracle-2",
    "field-localization",
    "field-binary",
    "ray-proximity",
    "ray-localization",
    "ray-binary-min",
    "time_of_flight-3",
)


def cell_id(args: list[str]) -> str:
    return "-".join(args[1::2])


@pytest.mark.parametrize(
    "sensor",
    [
        pytest.param(
            cell,
            id=cell_id(cell),
            marks=[] if cell_id(cell) in QUICK else pytest.mark.slow,
        )
        for cell in CELLS
    ],
)
def test_every_sensor_trains(sensor: list[str], tmp_path: Path):
    size = (*SMALL, "--num-workers", "1", "--total-frames", 2 * BATCH)
    succeed("train", *size, "--run-dir", tmp_path / "run", *sensor)
    assert egoskin.load_policy(tmp_path / "run").policy_spec.frames == 2 * BATCH


BAD_SKIN = """{"format": "egoskin-skin-1", "robot": "h1_2", "sensors": [
  {"link": "torso_lnk", "position": [0, 0, 0.1], "normal": [0, 0, 1]}]}"""


@pytest.mark.parametrize(
    ("args", "expected"),
    [
        (["--sensor.rnge", "1"], "--sensor.range"),
        (["--sensor.range", "-1"], "range must be at least 0.001"),
        (["--sensor.signal", "smell"], "proximity"),
        (["--num-envs", "32", "--num-workers", "3"], "valid: 1, 2, 4, 8, 16, 32"),
        (["--task.physics.gains", "strong"], "rotor_inertia, real"),
        (["--sensor.reduce", "min"], "reduce=min is for ray sensors"),
        (["--device", "gpu"], "available: cpu"),
        (["--skin.path", "skin.json"], "did you mean 'torso_link'"),
        (["--skin.path", "nothing.json"], "nothing.json"),
        (["--run-dir", "full"], "already exists"),
        (["--resume", "full"], "is not a run folder"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_bad_input_to_training_is_one_clear_message(
    args: list[str], expected: str, tmp_path: Path, monkeypatch
):
    (tmp_path / "skin.json").write_text(BAD_SKIN)
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "notes.txt").write_text("mine")
    monkeypatch.chdir(tmp_path)
    assert expected in fail("train", *args)
    assert sorted(os.listdir(tmp_path)) == ["full", "skin.json"]
    assert (tmp_path / "full" / "notes.txt").read_text() == "mine"
