"""scripts/verify.py: exact training passes, inexact training is found."""

from __future__ import annotations

import runpy
import sys
from pathlib import Path

import pytest
import torch

from egoskin.runs import TrainConfig
from egoskin.workers import WorkerPool

SCRIPT = str(Path(__file__).parents[1] / "scripts" / "verify.py")


def verify(monkeypatch, *args: str) -> None:
    monkeypatch.setattr(sys, "argv", ["verify.py", *args])
    runpy.run_path(SCRIPT, run_name="__main__")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("sensor", "skins"),
    [
        ([], 2),
        (["--sensor.coverage", "ray", "--sensor.signal", "closeness"], 2),
        # Nothing that could be corrupted.
        (["--sensor.signal", "localization"], 1),
        (["--sensor.coverage", "none"], 1),
    ],
    ids=["field", "ray", "localization", "blind"],
)
def test_training_is_exact(sensor, skins, monkeypatch, capsys):
    # 6 rollouts: the first throws land, rows reset at different times.
    verify(monkeypatch, "--num-envs", "64", "--iterations", "6", *sensor)
    text = capsys.readouterr().out
    assert "equal: training is exact" in text
    assert text.count("resumed after 3 rollouts") == skins
    # 4 workers x 16 rows; the odd numbers of agents give 45, 15 and 9 rows.
    assert "5 workers x 9 rows, 2 physics threads" in text


@pytest.mark.slow
def test_training_is_exact_at_the_default_size(monkeypatch):
    verify(monkeypatch, "--iterations", "4")


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
    agree = runpy.run_path(SCRIPT)["agree"]
    assert agree(config, tmp_path, "skin", 1) == exact
    lines = capsys.readouterr().out.splitlines()[1:]
    assert len(lines) == 4
    assert (len({line.split()[0] for line in lines}) == 1) == exact


def test_sizes_that_cannot_be_split_are_refused(monkeypatch, capsys):
    with pytest.raises(SystemExit) as ended:
        verify(monkeypatch, "--num-envs", "30")
    assert ended.value.code == 2
    assert "multiple of 4" in capsys.readouterr().err
