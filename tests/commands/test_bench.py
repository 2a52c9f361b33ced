"""Benchmarks: their rows, and that they do not change the runs they measure."""

from __future__ import annotations

import json
import re
import subprocess
import sys
import time
from pathlib import Path

import psutil
import pytest

from calling import succeed
from egoskin.commands.bench.gradients import GradientBench, gradient_rows
from egoskin.commands.bench.loop import LoopConfig, cpu_time
from egoskin.make import EnvConfig
from egoskin.runs.config import TrainConfig
from egoskin.runs.run import Run
from egoskin.sensors.config import SensorConfig


def test_bench_loop_gives_its_rows(tmp_path: Path):
    succeed(
        *("bench", "loop"),
        *("--num-envs", "8", "--num-workers", "1", "--warmup", "0", "--rounds", "1"),
        *("--json", tmp_path / "loop.json"),
    )
    rows = json.loads((tmp_path / "loop.json").read_text())["rows"]
    by_name = {row["name"]: row for row in rows}
    speeds = [
        "raw",
        "task",
        "env",
        "sensors",
        "policy",
        "train_field",
        "train_ray_grid",
    ]
    others = [
        f"{name}_{kind}" for name in ("memory", "serial") for kind in ("field", "ray")
    ]
    for name in [*speeds, *others]:
        assert by_name[name]["value"] > 0
    assert rows[0]["name"] == "raw"
    assert rows[0]["ratio"] == 1.0
    # The parts of the wall time add up to the time of a whole step.
    parts = [row["value"] for row in rows if row["name"].endswith("_wall")]
    assert len(parts) == 7
    assert sum(parts) == pytest.approx(1e6 / by_name["train_field"]["value"])


def test_cpu_time_resolves_less_than_a_tick():
    alone = [psutil.Process()]
    outer = time.process_time()
    before = cpu_time(alone)
    inner = time.process_time()
    while time.process_time() < inner + 2e-3:
        pass
    inner = time.process_time() - inner
    spent = cpu_time(alone) - before
    outer = time.process_time() - outer
    assert inner - 1e-6 < spent < outer + 1e-6


def test_cpu_time_is_the_sum_over_processes_and_refuses_one_that_has_ended():
    code = "import sys; sum(range(3_000_000)); print(flush=True); sys.stdin.read()"
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    with subprocess.Popen([sys.executable, "-c", code], **pipes) as other:
        assert other.stdout
        other.stdout.readline()
        waiting = psutil.Process(other.pid)
        alone = cpu_time([waiting])
        ticks = waiting.cpu_times()
        assert alone == pytest.approx(ticks.user + ticks.system, abs=0.05)
        assert cpu_time([waiting, waiting]) >= 2 * alone > 0
    with pytest.raises(ProcessLookupError):
        cpu_time([waiting])


@pytest.mark.parametrize(
    ("name", "args", "unit"),
    [
        ("physics", ("--steps", "1"), "environment steps/s of one core"),
        ("sensors", ("--snapshots", "1"), "ms"),
    ],
)
def test_a_bench_of_parts_gives_positive_rows(name, args, unit, tmp_path: Path):
    size = ("--num-envs", "2", "--rounds", "1", *args)
    succeed("bench", name, *size, "--json", tmp_path / "rows.json")
    rows = json.loads((tmp_path / "rows.json").read_text())["rows"]
    assert len({row["name"] for row in rows}) == len(rows) > 1
    assert all(row["value"] > 0 and row["unit"] == unit for row in rows)


@pytest.mark.slow
def test_bench_gradients_compares_rollouts_and_leaves_the_run_alone(
    trained: Path, tmp_path: Path
):
    before = {p: p.read_bytes() for p in trained.rglob("*") if p.is_file()}
    args = ("--run", trained, "--rollouts", "3", "--json", tmp_path / "g.json")
    succeed("bench", "gradients", *args)
    rows = json.loads((tmp_path / "g.json").read_text())["rows"]
    # The run's own decay comes first.
    names = [row["name"] for row in rows]
    assert names[:3] == ["lambda_0.8", "lambda_0", "lambda_0.5"]
    assert rows[0]["ratio"] == 1.0
    assert all(-1 < row["value"] < 1 for row in rows)
    assert {p: p.read_bytes() for p in trained.rglob("*") if p.is_file()} == before


def test_bench_gradients_names_the_damaged_checkpoint_not_its_copy(tmp_path: Path):
    run = Run.create(TrainConfig(num_envs=2, run_dir=tmp_path / "run"))
    run.checkpoint_path.write_bytes(b"damaged")
    with pytest.raises(ValueError, match=re.escape(f"{run.checkpoint_path} is trunc")):
        gradient_rows(GradientBench(run=run.path))


def test_bench_accuracy_compares_two_rates(tmp_path: Path):
    args = ("--throws", "6", "--json", tmp_path / "accuracy.json")
    succeed("bench", "accuracy", *args)
    rows = json.loads((tmp_path / "accuracy.json").read_text())["rows"]
    by_name = {row["name"]: row for row in rows}
    # Standing shows the same forces; the ball is met within a control step.
    assert by_name["stand_floor_force"]["ratio"] < 0.01
    assert 0 < by_name["impact_time"]["ratio"] < 1


@pytest.mark.slow
def test_bench_gymnasium_compares_its_forms_with_our_own(tmp_path: Path):
    args = ("--num-envs", "4", "--num-workers", "2", "--steps", "3", "--rounds", "1")
    succeed("bench", "gymnasium", *args, "--json", tmp_path / "rows.json")
    rows = json.loads((tmp_path / "rows.json").read_text())["rows"]
    assert [row["name"] for row in rows] == [
        "torchrl",
        "gymnasium_vector",
        "gymnasium_single",
    ]
    assert rows[0]["ratio"] == 1
    assert all(row["value"] > 0 for row in rows)


def test_bench_loop_refuses_what_it_would_not_measure():
    for options in ({"coverage": "none"}, {"coverage": "ray", "reduce": "min"}):
        env = EnvConfig(sensor=SensorConfig(**options))
        with pytest.raises(ValueError, match="field and full ray grid are measured"):
            LoopConfig(env=env)
