"""`egoskin verify`: exact training passes, inexact training is found."""

from __future__ import annotations

import pytest
import torch

from calling import call, fail, succeed
from egoskin.commands import verify
from egoskin.commands.verify import agree, run_hash
from egoskin.parallel import WorkerPool
from egoskin.runs.config import TrainConfig
from egoskin.runs.run import Run
from egoskin.runs.trainer import open_trainer, train
from egoskin.sensors.kernels.compilation import SETTING
from egoskin.storage.tensor_file import load_tensors, save_tensors
from making import blind_run


@pytest.mark.slow
@pytest.mark.parametrize(
    ("sensor", "skins"),
    [
        ([], 2),
        (["--sensor.coverage", "ray", "--sensor.signal", "closeness"], 2),
        # No sensors that could be corrupted.
        (["--sensor.signal", "localization"], 1),
        (["--sensor.coverage", "none"], 1),
    ],
    ids=["field", "ray", "localization", "blind"],
)
def test_training_is_exact(sensor, skins, monkeypatch):
    monkeypatch.delenv(SETTING)
    # 6 rollouts: the first throws land, rows reset at different times.
    text = succeed("verify", "--num-envs", "64", "--iterations", "6", *sensor)
    assert "equal: training is reproducible" in text
    # With 64 and with 45 agents.
    assert text.count("resumed after 3 rollouts") == 2 * skins
    assert text.count("compiled kernels") == 3 * skins
    assert text.count("plain kernels") == 3 * skins
    assert "5 workers, 2 physics threads, 4 learner threads, plain kernels" in text


@pytest.mark.slow
def test_training_is_exact_at_the_default_size(monkeypatch):
    monkeypatch.delenv(SETTING)
    succeed("verify", "--iterations", "4")


@pytest.mark.slow
@pytest.mark.parametrize("exact", [True, False])
def test_a_difference_of_one_bit_is_found(exact, monkeypatch, tmp_path, capsys):
    # One state of the environment is off by a bit, for two workers only.
    state = WorkerPool.simulation_state

    def off_by_a_bit(self: WorkerPool) -> dict[str, torch.Tensor]:
        result = state(self)
        if self.num_workers == 2:
            next(iter(result.values())).view(torch.uint8).view(-1)[0] ^= 1
        return result

    if not exact:
        monkeypatch.setattr(WorkerPool, "simulation_state", off_by_a_bit)
    config = TrainConfig(num_envs=16, total_frames=2 * 16 * 16)
    assert agree(config, tmp_path, "skin", 1) == exact
    lines = capsys.readouterr().out.splitlines()[1:]
    assert len(lines) == 4
    one, two, four, resumed = (line.split()[0] for line in lines)
    # One worker and four give the same result in both cases.
    assert one == four
    assert (one == two == resumed) == exact


@pytest.mark.parametrize("results", [(False, True), (True, False), (True, True)])
def test_one_difference_is_the_verdict(results, monkeypatch):
    # Both numbers of agents are tried; a blind robot has no sensors to corrupt.
    given = iter(results)
    monkeypatch.setattr(verify, "agree", lambda *args: next(given))
    done = call("verify", "--num-envs", "16", "--sensor.coverage", "none")
    assert next(given, None) is None
    assert done.returncode == (0 if all(results) else 1)
    assert ("NOT equal" in done.stderr) == (not all(results))


def test_the_hash_is_of_values_alone(tmp_path):
    run = Run.create(blind_run(tmp_path / "run", 128))
    with open_trainer(run) as trainer:
        train(trainer)
    before = run_hash(run)
    tensors, header = load_tensors(run.checkpoint_path)
    metrics = run.path / "metrics.csv"
    lines = [line.split(",") for line in metrics.read_text().splitlines()]

    # The order of fields and columns, times and descriptions of the run do not count.
    header["policy"], header["wall_s"] = {"other": 1}, -1.0
    reversed_ = dict(reversed(list(tensors.items())))
    save_tensors(run.checkpoint_path, reversed_, header)
    metrics.write_text("\n".join(",".join(reversed(line)) for line in lines) + "\n")
    assert run_hash(run) == before

    # Every value counts.
    key = "agent/head.log_std"
    tensors[key] = tensors[key] + 1e-6
    save_tensors(run.checkpoint_path, tensors, header)
    other = run_hash(run)
    assert other != before
    lines[-1][lines[0].index("reward/mean")] = "7.5"
    metrics.write_text("\n".join(map(",".join, lines)) + "\n")
    assert run_hash(run) not in (before, other)


def test_sizes_that_cannot_be_split_are_refused():
    assert "multiple of 4" in fail("verify", "--num-envs", "30")
