"""scripts/results.py: runs stored and reported, and bad input."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import pytest

from calling import BATCH, fail, succeed
from egoskin.storage.formats import read_sealed, sealed_json


def metrics(folder: Path) -> list[dict[str, str]]:
    with open(folder / "metrics.csv", newline="") as file:
        return list(csv.DictReader(file))


def test_a_run_is_stored_and_reported_again_when_it_is_longer(
    trained: Path, tmp_path: Path
):
    pytest.importorskip("matplotlib")
    stored, report = tmp_path / "results", tmp_path / "results.md"
    stored.mkdir()
    (stored / "notes.md").write_text("## By hand\n\nThis stays.\n")
    add = ("results.py", "add", trained, "--episodes", "16", "--results", stored)
    succeed(*add)
    folder = stored / "field_proximity_2m_seed0"
    frames = f"{4 * BATCH:012d}"
    assert {str(p.relative_to(folder)) for p in folder.rglob("*.*")} == {
        "config.json",
        "run.json",
        "metrics.csv",
        f"policies/{frames}.safetensors",
        f"evaluation_{frames}.json",
    }
    made = json.loads((folder / "run.json").read_text())
    assert made["command"].startswith("egoskin train --num-envs 32")
    assert str(trained) not in (folder / "run.json").read_text()
    assert (made["seed"], made["frames"]) == (0, 4 * BATCH)
    assert made["wall_s"] == pytest.approx(float(metrics(trained)[-1]["time/wall_s"]))
    evaluation = json.loads((folder / f"evaluation_{frames}.json").read_text())
    assert (evaluation["episodes"], evaluation["bank_seed"]) == (16, 0)

    # Its evaluation, once more, comes to the same whatever was written there.
    file = folder / f"evaluation_{frames}.json"
    spoilt = {**evaluation, "success": {"mean": 0.123}}
    file.write_text(json.dumps(spoilt))
    told = succeed("results.py", "repeat", folder)
    success = 100 * evaluation["success"]["mean"]
    assert f"success {success:.1f} %, was 12.3 %" in told
    assert json.loads(file.read_text()) == evaluation

    # The same run once more is an update, another configuration is refused.
    succeed(*add)
    config, _ = read_sealed(folder / "config.json")
    config["env"]["sensor"]["range"] = 1.0
    (folder / "config.json").write_bytes(sealed_json(config))
    assert "another configuration: choose a --name" in fail(*add)

    succeed("results.py", "write", "--results", stored, "--out", report)
    text = report.read_text()
    assert "This stays." in text
    assert "field proximity, 1 m" in text
    assert (tmp_path / "results-other-recipes.png").read_bytes()[:4] == b"\x89PNG"


@pytest.mark.parametrize(
    ("args", "expected"),
    [
        (["add", "nothing"], "no run folder"),
        (["add", "nothing", "--name", "a/b"], "must be the name of a folder"),
        (["add", "nothing", "--episodes", "0"], "must be at least 1"),
        (["add", "nothing", "--results", "elsewhere"], "no folder elsewhere"),
        (["repeat"], "name the stored runs"),
        (["repeat", "results"], "results is not whole: it has no config.json"),
        (["write", "--results", "results", "--out", "new.md"], "holds no runs"),
        (["write", "--out", "no/results.md"], "no folder no"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_bad_input_to_results_is_one_clear_message(
    args: list[str], expected: str, tmp_path: Path, monkeypatch
):
    pytest.importorskip("matplotlib")
    (tmp_path / "results").mkdir()
    monkeypatch.chdir(tmp_path)
    assert expected in fail("results.py", *args)
    assert [p.name for p in tmp_path.rglob("*")] == ["results"]
