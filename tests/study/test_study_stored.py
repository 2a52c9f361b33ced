"""Stored runs: thinned metrics, the record of how they were made, completeness."""

from __future__ import annotations

import dataclasses
import json
import re
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from egoskin.runs.run import Run, TrainConfig
from egoskin.storage.serialization import read_json
from egoskin.study.folder import StudyFolder
from egoskin.study.stored import evaluation_path, load_run, record, thin

STUDIES = Path(__file__).parents[2] / "studies"
ARCHIVE = STUDIES / "version-1"


def test_thinned_metrics_keep_a_line_for_each_block_and_the_last():
    lines = [f"{n * 65536},{n / 3}" for n in range(1, 11)]
    kept = thin("\n".join(["frames,x", *lines]), 2**18).splitlines()
    # Blocks of 2**18 = 4 x 65536: lines 1 (in block 0), 4, 8 and the last, 10.
    assert kept[0] == "frames,x"
    assert [int(line.split(",")[0]) // 65536 for line in kept[1:]] == [1, 4, 8, 10]
    assert kept[1].endswith(",0.333333")
    # Thinned metrics are not changed again.
    assert thin("\n".join(kept), 2**18).splitlines() == kept
    assert thin("frames,x\n", 2**18) == "frames,x\n"


def test_a_record_says_what_was_run_but_not_where(tmp_path: Path):
    run = Run(tmp_path, dataclasses.replace(TrainConfig(), seed=4))
    (tmp_path / "metrics.csv").write_text(
        "frames,time/wall_s\n100,1.5\n200,3.5\n300,9.0\n"
    )
    with pytest.raises(ValueError, match=r"no versions\.json"):
        record(run, 200)
    start = {
        "command": ["/some/where/ppo.py", "--run-dir", "/x", "--seed", "4"],
        "python": "3.11.7",
        "machine": "Linux x86_64",
        "cores": 2,
        "packages": {"torch": "2.13", "mujoco": "4.0"},
        "git": {"commit": "0123456789", "changed": True},
    }
    again = {**start, "command": ["ppo.py", "--resume=/x"], "git": None}
    (tmp_path / "versions.json").write_text(json.dumps([start, again]))
    made = record(run, 200)
    assert made.command == "python scripts/ppo.py --seed 4"
    assert made.commit == "0123456+, unknown"
    assert (made.seed, made.frames, made.wall_s) == (4, 200, 3.5)
    assert made.machine == (
        "Linux x86_64, 2 cores, Python 3.11.7, torch 2.13, mujoco 4.0"
    )


@pytest.mark.parametrize("missing", ["run.json", "metrics.csv", "evaluation"])
def test_a_folder_that_is_not_whole_is_named(missing, tmp_path: Path):
    half = tmp_path / "half"
    shutil.copytree(ARCHIVE / "results" / "blind-seed0", half)
    for path in half.glob(f"{missing}*"):
        path.unlink()
    with pytest.raises(ValueError, match=rf"half is incomplete: .*{missing}"):
        load_run(half)


@pytest.mark.parametrize("kept", [0, 500, -100, "rows"])
def test_metrics_that_were_not_copied_to_their_end_are_refused(kept, tmp_path: Path):
    # Read as they are, the run would count as one that has not learnt.
    part = tmp_path / "part"
    shutil.copytree(ARCHIVE / "results" / "blind-seed0", part)
    text = (part / "metrics.csv").read_text()
    lines = text.splitlines(keepends=True)
    text = "".join(lines[:-1]) if kept == "rows" else text[:kept]
    (part / "metrics.csv").write_text(text)
    with pytest.raises(ValueError, match=r"part.*metrics\.csv.*not.*whole"):
        load_run(part)


def test_a_result_with_two_evaluations_is_named(tmp_path: Path):
    shutil.copytree(ARCHIVE, tmp_path / "study")
    folder = StudyFolder(tmp_path / "study")
    manifest = folder.manifest()
    path = folder.result_path("blind-seed0")
    (file,) = path.glob("evaluation_*")
    shutil.copy(file, path / "evaluation_000000065536.json")
    run = manifest.run("blind-seed0")
    for ask in (lambda: folder.status([run]), lambda: folder.result(run)):
        with pytest.raises(ValueError, match="blind-seed0 has 2 evaluations") as error:
            ask()
        assert file.name in str(error.value)


@pytest.mark.parametrize("study", ["findings", "num-sensors"])
def test_the_runs_so_far_of_the_studies_in_progress_are_read(study):
    folder = StudyFolder(STUDIES / study)
    manifest = folder.manifest()
    results = folder.results(manifest)
    stored = {path.name for path in (folder.path / "results").iterdir()}
    assert {r.run.name for r in results} == stored
    standards = {r.stored.config.env.standard for r in results}
    assert standards == {manifest.evaluation.standard}


def test_the_runs_of_version_1_are_kept_as_a_study():
    folder = StudyFolder(ARCHIVE)
    manifest = folder.manifest()
    results = folder.results(manifest)
    assert len(results) == 16
    assert {r.stored.config.env.standard for r in results} == {"1"}
    assert manifest.evaluation.standard == "1"


def _assert_printed(text: str, shares: Sequence[float]):
    """Assert that the percentages in a text are these, to the digits it shows."""
    printed = re.findall(r"\d+(?:\.(\d+))?", text)
    numbers = [float(n) for n in re.findall(r"\d+(?:\.\d+)?", text)]
    assert len(numbers) == len(shares), text
    for number, digits, share in zip(numbers, printed, shares, strict=True):
        assert abs(number - 100 * share) <= 0.5 * 10 ** -len(digits) + 1e-9, text


def _cell(name: str) -> str:
    """Return the cell of a row, as "ray proximity, closest beam, 2 m"."""
    signal, *rest = name.split(", ")
    reach = rest.pop().replace(" ", "") if rest else ""
    parts = [signal.replace(" ", "-"), reach, "reduce-min" if rest else ""]
    return "-".join(filter(None, parts))


def _stored(study: str) -> list[str]:
    return sorted(path.name for path in (STUDIES / study / "results").iterdir())


def _evaluation(run: str, study: str = "findings") -> dict[str, Any]:
    return read_json(evaluation_path(STUDIES / study / "results" / run))


def _table(after: str) -> list[list[str]]:
    """Return the rows of the first table after a text in the results, without head."""
    text = (STUDIES.parent / "docs" / "results.md").read_text()
    table = text.split(after)[1].split("\n\n|")[1].split("\n\n")[0]
    return [line.strip("| ").split(" | ") for line in table.splitlines()[2:]]


def _assert_measured(
    found: dict[str, Any], values: Sequence[str], *, blind: bool = False
):
    """Assert that the cells of a row, from success at 3 s on, are an evaluation's."""
    three, five, masked, first, later, falls = values
    success = found["success"]
    _assert_printed(three, [success[k] for k in ("mean", "low", "high")])
    _assert_printed(five, [found["success_5s"]["mean"]])
    hidden = [] if blind else [found["masked"]["success"]["mean"]]
    _assert_printed(masked, hidden)
    _assert_printed(first, [found["avoided"]["first_ball"]])
    _assert_printed(later, [found["avoided"]["later_balls"]])
    _assert_printed(falls, [found["ended_by_fall"]])


def test_the_table_of_the_results_is_that_of_the_study():
    runs = []
    for name, seed, *values in _table("## Version 2"):
        runs.append(f"{_cell(name)}-seed{seed}")
        _assert_measured(_evaluation(runs[-1]), values, blind=name == "blind")
    assert sorted(runs) == _stored("findings")


def test_the_table_of_the_number_of_sensors_is_that_of_its_study():
    runs = []
    for number, seed, *values in _table("### How many sensors"):
        fewer = "" if number == "64" else f"-num_sensors-{number}"
        runs.append(f"field-proximity-2m{fewer}-seed{seed}")
        found = _evaluation(runs[-1], "num-sensors")
        _assert_measured(found, values)
        if not fewer:
            assert found == _evaluation(runs[-1])
    assert sorted(runs) == _stored("num-sensors")


def test_the_table_of_the_readme_is_that_of_the_study():
    text = (STUDIES.parent / "README.md").read_text()
    head, _, *lines = (
        text.split("\n| untouched for 3 s ")[1].split("\n\n")[0].splitlines()
    )
    ranges = head.strip("| ").split(" | ")
    shown = 0
    for line in lines[:-1]:
        name, *values = (c.strip() for c in line.strip("|").split("|"))
        for reach, value in zip(ranges, values, strict=True):
            runs = (STUDIES / "findings" / "results").glob(
                f"{_cell(f'{name}, {reach}')}-seed*"
            )
            found = [_evaluation(run.name) for run in sorted(runs)]
            _assert_printed(value, [f["success"]["mean"] for f in found])
            shown += len(found)
    assert f"| the same {shown} policies, masked |" in lines[-1]
