"""The report of a study, from made-up runs."""

from __future__ import annotations

import csv
import dataclasses
import io
import json
import math
import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from calling import fail
from egoskin.commands.study import what_is_seen
from egoskin.runs.run import Run
from egoskin.study.differences import differences
from egoskin.study.figures import (
    _draw_curves,
    equivalence,
    forest,
    learning_curves,
    metric_by_cell,
    places,
    sample_efficiency,
    save,
    success_by_range,
)
from egoskin.study.findings import judge_findings
from egoskin.study.folder import StudyFolder
from egoskin.study.manifest import Manifest, resolve
from egoskin.study.metrics import BY_NAME, METRICS, frames_to, runs_csv, tables
from egoskin.study.page import page, table
from egoskin.study.report import _difference_rows, write_report
from egoskin.study.shipped import FINDINGS, SMOKE
from studies import expected, store, store_all

FIGURES = (
    "equivalence",
    "findings",
    "learning-curves",
    "sample-efficiency",
    "success-by-range",
)


@pytest.fixture(scope="module")
def manifest() -> Manifest:
    return resolve(FINDINGS)


@pytest.fixture(scope="module")
def folder(manifest: Manifest, tmp_path_factory) -> StudyFolder:
    """A study with one seed for the ray cells and three for the others; its report."""
    folder = StudyFolder(tmp_path_factory.mktemp("study"))
    folder.plan(manifest)
    store_all(folder, manifest, keep=lambda r: r.seed == 0 or "ray" not in r.name)
    write_report(folder, folder.path / "report")
    return folder


@pytest.fixture
def without_pictures(monkeypatch):
    """Drawing takes most of the time of a report."""

    def save(figure: Figure, out: Path, name: str) -> None:
        (out / f"{name}.svg").write_text("<svg/>")

    monkeypatch.setattr("egoskin.study.report.save", save)


def test_a_report_of_no_study_is_refused_for_that(tmp_path):
    error = fail("study", "report", tmp_path / "nope")
    assert f"{tmp_path / 'nope'} is not a study folder" in error


def test_a_report_needs_nothing_else(folder: StudyFolder):
    out = folder.path / "report"
    names = {p.name for p in out.iterdir()}
    pictures = {f"{name}.{kind}" for name in FIGURES for kind in ("png", "svg")}
    assert names == {"report.md", "index.html", "runs.csv", *pictures}
    text = (out / "report.md").read_text()
    assert set(re.findall(r"!\[.*?\]\((.*?)\)", text)) == {f"{n}.png" for n in FIGURES}
    html = (out / "index.html").read_text()
    # The page embeds its pictures and has no external links.
    assert html.count('src="data:image/svg+xml;base64,') == len(FIGURES)
    assert not re.search(r'(src|href)="(?!data:)', html)


def test_the_answer_comes_first_and_what_is_missing_is_told(folder: StudyFolder):
    text = (folder.path / "report" / "report.md").read_text()
    first = text.splitlines()[:5]
    assert "55 of 87 runs are done" in first[2]
    assert re.fullmatch(
        r"\*\*Of the paper's findings (\w+: [\w, ]+(; )?)+\.\*\*", first[4]
    )
    missing = text.split("## Missing runs")[1].split("##")[0]
    (row,) = (line for line in missing.splitlines() if line.startswith("| 1, 2 |"))
    assert row.count("ray-") == 16
    assert "field" not in missing
    assert "blind" not in missing


def test_a_finding_without_runs_is_listed_as_untested(
    manifest: Manifest, tmp_path: Path, without_pictures
):
    folder = StudyFolder(tmp_path)
    folder.plan(manifest)
    store_all(folder, manifest, keep=lambda r: r.cell.name == "field-proximity-2m")
    write_report(folder, tmp_path / "report")
    text = (tmp_path / "report" / "report.md").read_text()
    verdicts = "refuted: 6b; untested: 1a, 1b, 1c, 2, 3, 4, 5, 6a"
    assert f"**Of the paper's findings {verdicts}.**" in text
    # Why most of them have no verdict.
    assert "at least two seeds of the cells it rests on: 27 of 28 cells have" in text
    for label, claims in (("1a", 20), ("3", 1), ("6a", 1)):
        (row,) = (line for line in text.splitlines() if line.startswith(f"| {label} |"))
        assert row.endswith(f"| **untested** |  | no runs yet | 0 | 0 of {claims} |  |")


def test_a_run_that_failed_is_told_among_the_missing(
    manifest: Manifest, tmp_path: Path, without_pictures
):
    folder = StudyFolder(tmp_path)
    folder.plan(manifest)
    keep = "field-proximity-1m"
    store_all(folder, manifest, keep=lambda r: r.cell.name != keep)
    folder.note_failure(f"{keep}-seed1", "no memory")
    write_report(folder, tmp_path / "report")
    text = (tmp_path / "report" / "report.md").read_text()
    assert f"| 0, 1 (failed), 2 | {keep} |" in text


def test_the_table_has_a_row_for_each_run_in_full_precision(
    folder: StudyFolder, manifest: Manifest
):
    with open(folder.path / "report" / "runs.csv", newline="") as source:
        rows = list(csv.DictReader(source))
    assert [row["run"] for row in rows] == [
        r.name for r in manifest.runs if r.seed == 0 or "ray" not in r.name
    ]
    by_run = {row["run"]: row for row in rows}
    result = folder.result(manifest.run("field-proximity-2m-seed1"))
    row = by_run[result.run.name]
    share = result.stored.evaluation["success"]["mean"]
    end = result.run.end
    assert float(row["success_3s"]) == 100 * share
    assert float(row["later_avoided"]) == 100 * (0.8 * share)
    assert float(row["success_5s"]) == 100 * (share / 2)
    assert float(row["survival_s"]) == 1 + 6 * share
    assert float(row["falls"]) == 100 * (0.1 * (1 - share))
    assert float(row["masked_success_3s"]) == 1
    # In an hour.
    assert float(row["frames_per_s"]) == end / 3600
    # 1 - exp(-t / 0.2) reaches these shares of 0.9924, its end value, at these t.
    for percent, t in ((50, 0.1371), (90, 0.4473)):
        frames = float(row[f"m_frames_to_{percent}"]) * 1e6
        assert frames == pytest.approx(t * end, rel=2e-3)
    assert (row["range_m"], row["signal"], row["frames"]) == (
        "2.0",
        "proximity",
        str(result.run.end),
    )
    # A blind robot has no signal and no sensors to mask.
    blind = by_run["blind-seed0"]
    assert blind["signal"] == blind["range_m"] == blind["masked_success_3s"] == ""


def test_the_table_tells_the_throws_of_training_from_those_of_judgement(
    tmp_path: Path,
):
    plan = dataclasses.replace(SMOKE.evaluation, standard="1", episodes=16)
    mine = resolve(dataclasses.replace(SMOKE, standard="paper", evaluation=plan))
    folder, run = StudyFolder(tmp_path), mine.runs[0]
    store(folder, mine, run, 50.0)
    (row,) = csv.DictReader(io.StringIO(runs_csv(mine, [folder.result(run)])))
    assert (row["trained_on"], row["judged_on"]) == ("paper", "1")
    assert (row["throws"], row["throw_set"]) == ("16", str(plan.throw_set))


def test_nothing_but_named_columns_depends_on_when_and_where(
    folder: StudyFolder, manifest: Manifest, tmp_path: Path
):
    other = StudyFolder(tmp_path)
    other.plan(manifest)
    run = manifest.runs[0]
    store(
        other,
        manifest,
        run,
        100 * folder.result(run).stored.evaluation["success"]["mean"],
    )
    path = other.result_path(run.name) / "run.json"
    path.write_text(
        path.read_text().replace("3600.0", "7200.0").replace('"Linux"', '"Other"')
    )
    rows = []
    for own in (folder, other):
        text = runs_csv(manifest, [own.result(run)])
        rows += list(csv.DictReader(io.StringIO(text)))
    differ = {k for k in rows[0] if rows[0][k] != rows[1][k]}
    assert differ == {"wall_s", "frames_per_s"}


def test_a_report_is_the_same_bytes_each_time(folder: StudyFolder, tmp_path: Path):
    write_report(folder, tmp_path / "again")
    for path in (folder.path / "report").iterdir():
        assert path.read_bytes() == (tmp_path / "again" / path.name).read_bytes()


def test_a_study_without_runs_has_a_report(
    manifest: Manifest, tmp_path: Path, without_pictures
):
    folder = StudyFolder(tmp_path)
    folder.plan(manifest)
    write_report(folder, tmp_path / "report")
    assert "0 of 87 runs" in (tmp_path / "report" / "report.md").read_text()


def test_cells_of_other_kinds_are_reported_too(tmp_path: Path):
    cells = ({}, {"history": 3}, {"ppo.network.hidden": [64, 64]})
    study = dataclasses.replace(FINDINGS, name="mine", cells=cells, seeds=(0, 1))
    folder, manifest = StudyFolder(tmp_path), resolve(study)
    folder.plan(manifest)
    store_all(folder, manifest)
    # Only the first is in the paper's grid.
    assert list(places(manifest)) == ["field-proximity-2m"]
    write_report(folder, tmp_path / "report")
    text = (tmp_path / "report" / "report.md").read_text()
    assert "learning-curves.png" in text
    # It is judged on its own question, not on the paper's.
    assert "the paper's findings" not in text
    rows = text.split("## Differences to the first cell")[1].split("##")[0]
    row = r"\| field-proximity-2m-history-3 \| [+-].* to .*\) \| [\d.]+ \| 2 of \d+ \|"
    assert re.search(row, rows)
    assert rows.count("\n| field-proximity-2m") == 2
    assert "difference [percentage points] (95 %)" in rows
    assert (tmp_path / "report" / "differences.svg").is_file()


def test_cells_are_compared_in_the_metric_that_is_asked_for(
    manifest: Manifest, tmp_path: Path
):
    cells = ({}, {"name": "longer", "history": 3})
    study = dataclasses.replace(FINDINGS, name="mine", cells=cells, seeds=(0, 1, 2))
    folder, mine = StudyFolder(tmp_path), resolve(study)
    folder.plan(mine)
    for run in mine.runs:
        # Longer by 0.06 s with each point of success: by 0.60, 0.66 and 0.72 s.
        better = (10.0 + run.seed) * (run.cell.name == "longer")
        store(folder, mine, run, 40.0 + run.seed + better)
    write_report(folder, tmp_path / "report", BY_NAME["survival_s"])
    text = (tmp_path / "report" / "report.md").read_text()
    assert "Mean survival, restricted to 10 s: each cell minus field-prox" in text
    assert "| cell | difference [s] (95 %) | p | seeds |" in text
    assert "| longer | +0.66 (+0.51 to +0.81) |" in text
    folder = StudyFolder(tmp_path / "paper")
    folder.plan(manifest)
    with pytest.raises(ValueError, match=r"study findings is judged .* --metric"):
        write_report(folder, tmp_path / "other", BY_NAME["falls"])
    assert not (tmp_path / "other").exists()


def test_the_cost_of_a_decision_is_in_core_hours(
    manifest: Manifest, tmp_path: Path, without_pictures
):
    hours, totals, needed = [], [], None
    for cores in (1, 4):
        folder = StudyFolder(tmp_path / str(cores))
        folder.plan(manifest)
        cells = ("ray-binary-1m", "ray-binary-1m-reduce-min")
        for run in manifest.runs:
            if run.cell.name in cells and run.seed < 2:
                store(folder, manifest, run, 50.0 + 5 * run.seed * len(run.cell.name))
                config = dataclasses.replace(run.config, num_workers=cores)
                Run(folder.result_path(run.name), config).write_config()
        write_report(folder, folder.path / "report")
        text = (folder.path / "report" / "report.md").read_text()
        (row,) = (line for line in text.splitlines() if line.startswith("| 6a |"))
        hours.append(float(row.split("|")[-2]))
        found = re.search(
            r"next 1,000 core-hours would decide, cheapest first, 6a: "
            r"([\d,]+) runs, ([\d,]+) core-hours\.",
            text,
        )
        assert found
        totals.append([float(n.replace(",", "")) for n in found.groups()])
        judged = judge_findings(tables(folder.results(manifest)))
        (needed,) = (j.seeds_needed for j in judged if j.finding.label == "6a")
    # Each run took an hour of wall time; two cells have two seeds each.
    assert needed is not None
    runs = 2 * (needed - 2)
    assert hours == [runs, 4 * runs]
    assert totals == [[runs, runs], [runs, 4 * runs]]


def test_the_next_core_hours_decide_the_cheapest_findings_and_share_runs(
    manifest: Manifest, tmp_path: Path, without_pictures
):
    folder = StudyFolder(tmp_path)
    folder.plan(manifest)

    def said() -> str:
        write_report(folder, folder.path / "report")
        text = (folder.path / "report" / "report.md").read_text()
        return "".join(s for s in text.splitlines() if s.startswith("The next"))

    def runs(*labels: str) -> int:
        judged = judge_findings(tables(folder.results(manifest)))
        more: dict[str, int] = {}
        for j in (j for j in judged if j.finding.label in labels):
            assert j.seeds_needed is not None
            for name in (n for claim in j.deciding for n in claim.claim.weights):
                more[name] = max(more.get(name, 0), j.seeds_needed - 2)
        return sum(more.values())

    assert said() == ""
    success = {
        "field-proximity-1m": (40.0, 46.0),
        "field-proximity-2m": (70.0, 64.0),
        "field-localization-1m": (41.0, 43.0),
        "field-localization-2m": (66.0, 68.0),
        "ray-localization-1m": (30.0, 31.0),
        "ray-proximity-1m-reduce-min": (22.0, 31.0),
        "ray-binary-1m-reduce-min": (31.0, 34.0),
        "ray-binary-1m": (30.5, 33.0),
    }
    stored = [
        (manifest.run(f"{name}-seed{seed}"), value)
        for name, values in success.items()
        for seed, value in enumerate(values)
    ]
    # Each takes an hour of wall time.
    for run, value in stored:
        store(folder, manifest, run, value)
    total = runs("6a", "1a", "2", "5")
    assert total < runs("6a") + runs("1a") + runs("2") + runs("5")
    assert runs("6a") < runs("1a") < runs("2") < runs("5")
    assert f" cheapest first, 6a, 1a, 2, 5: {total} runs, {total} core-" in said()
    for cores, findings in ((4, ("6a", "1a", "2")), (512, ())):
        for run, _ in stored:
            config = dataclasses.replace(run.config, num_workers=cores)
            Run(folder.result_path(run.name), config).write_config()
        total = runs(*findings)
        listed = f"{', '.join(findings)}: {total} runs, {cores * total:,} core-hours."
        assert (listed if findings else " would decide none of them.") in said()


def test_the_claim_of_a_row_is_the_one_that_needs_its_seeds(
    manifest: Manifest, tmp_path: Path, without_pictures
):
    folder = StudyFolder(tmp_path)
    folder.plan(manifest)
    # With one seed; at 2 m the end of the region is nearer.
    success = {"proximity-1m": 50.0, "localization-1m": 50.0}
    success |= {"proximity-2m": 64.0, "localization-2m": 60.0}
    for name, value in success.items():
        store(folder, manifest, manifest.run(f"field-{name}-seed0"), value)
    write_report(folder, tmp_path / "report")
    text = (tmp_path / "report" / "report.md").read_text()
    (row,) = (line for line in text.splitlines() if line.startswith("| 2 |"))
    assert "| field-proximity-2m - field-localization-2m: +4.0 |" in row


def test_runs_on_an_unknown_number_of_cores_have_no_core_hours(
    manifest: Manifest, tmp_path: Path, without_pictures
):
    def cost(folder: StudyFolder) -> str:
        write_report(folder, folder.path / "report")
        text = (folder.path / "report" / "report.md").read_text()
        (row,) = (line for line in text.splitlines() if line.startswith("| 6a |"))
        return row.split("|")[-2].strip()

    folder = StudyFolder(tmp_path)
    folder.plan(manifest)
    one, other = (
        manifest.run(f"ray-binary-1m{name}-seed0") for name in ("", "-reduce-min")
    )
    for run, success in ((one, 50.0), (other, 70.0)):
        store(folder, manifest, run, success)
        config = dataclasses.replace(run.config, num_workers=None)
        Run(folder.result_path(run.name), config).write_config()
    # The spread of seeds, for the number that is needed.
    more = manifest.run("ray-binary-1m-seed1")
    store(folder, manifest, more, 55.0)
    known = cost(folder)
    config = dataclasses.replace(more.config, num_workers=None)
    Run(folder.result_path(more.name), config).write_config()
    assert (float(known) > 0, cost(folder)) == (True, "")


def test_the_visibility_of_balls_that_all_miss_is_reported(
    manifest: Manifest, tmp_path: Path, without_pictures
):
    folder = StudyFolder(tmp_path)
    folder.plan(manifest)
    store(folder, manifest, manifest.runs[0], 50.0)
    cell = {"coverage": "field", "range": 0.5, "warning": {"hits": 0}}
    (tmp_path / "visibility.json").write_text(json.dumps({"cells": [cell]}))
    write_report(folder, tmp_path / "report")
    text = (tmp_path / "report" / "report.md").read_text()
    assert "| field 0.5 m | - | - / - / - |" in text


@pytest.mark.parametrize("content", [{}, [], {"cells": [{}]}, {"cells": [1]}])
def test_a_damaged_visibility_is_named(content, tmp_path: Path):
    folder = StudyFolder(tmp_path)
    folder.plan(resolve(SMOKE))
    path = tmp_path / "visibility.json"
    path.write_text(json.dumps(content))
    with pytest.raises(ValueError, match=f"{path} .* --visibility"):
        write_report(folder, tmp_path / "report")


def test_seeds_without_a_spread_are_not_told_to_be_more_than_enough():
    # All pairs differ by 60, so nothing is decided; the cells have a spread.
    table = {"one": {0: 1.0, 1: 2.0, 2: 3.0}, "other": {0: 61.0, 1: 62.0, 2: 63.0}}
    found = differences(list(table), table)
    (row,) = _difference_rows(found, BY_NAME["success_3s"]).splitlines()[2:]
    assert row == "| other | +60.0 | 1.000 | 3, needs more |"


def test_a_study_without_a_purpose_has_a_report(tmp_path: Path, without_pictures):
    folder = StudyFolder(tmp_path)
    folder.plan(resolve(dataclasses.replace(FINDINGS, purpose="")))
    write_report(folder, tmp_path / "report")
    text = (tmp_path / "report" / "report.md").read_text()
    assert text.startswith("# Study findings\n\n0 of 87 runs are done.")


def test_signals_whose_seeds_have_no_spread_are_neither_equal_nor_different(
    manifest: Manifest,
):
    cells = ("field-proximity-1m", "field-localization-1m")
    table = {cells[0]: {0: 60.0, 1: 70.0}, cells[1]: {0: 50.0, 1: 60.0}}
    figure = equivalence(manifest, table)
    (axes,) = figure.axes
    points = [x for x in axes.lines if x.get_marker() == "o" and len(x.get_xdata())]
    assert [point.get_color() for point in points] == ["#888888"]


def test_signals_are_equivalent_by_their_90_and_different_by_their_95_percent_interval(
    manifest: Manifest,
):
    localization = np.array([50.0, 60.0, 55.0])
    values = {
        "localization": localization,
        # Of three pairs with a standard deviation of 2.5 the 90 % interval is +- 4.2,
        # the 95 % interval +- 6.2.
        "proximity": localization + np.array([-2.5, 0.0, 2.5]),
        "binary": localization + np.array([-21.0, -20.0, -19.0]),
    }
    table = {f"field-{k}-1m": dict(enumerate(x)) for k, x in values.items()}
    # With rays binary is better.
    table["ray-localization-1m"] = dict(enumerate(values["binary"]))
    table["ray-binary-1m"] = dict(enumerate(localization))
    figure = equivalence(manifest, table)
    assert figure is not None
    (axes,) = figure.axes
    names = [tick.get_text().split(" m: ")[1] for tick in axes.get_yticklabels()]
    assert names == [
        "proximity - localization",
        "binary - localization",
        "binary - proximity",
        "binary - localization",
    ]
    points = [x for x in axes.lines if x.get_marker() == "o" and len(x.get_xdata())]
    same, different = "#0072B2", "#D55E00"
    found = [point.get_color() for point in points]
    assert found == [same, different, different, different]
    # Thin 95 % and thick 90 % intervals.
    ends = {
        line.get_linewidth(): np.asarray(line.get_xdata()).tolist()
        for line in axes.lines
        if len(line.get_xdata()) == 2 and list(line.get_ydata()) == [0, 0]
    }
    assert ends[3.0] == pytest.approx([-4.215, 4.215], abs=1e-3)
    assert ends[1.0] == pytest.approx([-6.210, 6.210], abs=1e-3)


def test_the_lowest_panel_of_each_column_has_numbers_on_its_axis(tmp_path: Path):
    cells = ({"sensor.range": 1.0}, {"sensor.range": 2.0}, {"history": 3})
    mine = resolve(dataclasses.replace(FINDINGS, name="mine", cells=cells, seeds=(0,)))
    folder = StudyFolder(tmp_path)
    folder.plan(mine)
    store_all(folder, mine)
    figure = learning_curves(mine, folder.results(mine))
    assert figure is not None
    one, two, other, hidden = figure.axes
    assert not hidden.get_visible()
    # The other cells are below the first column.
    told = [axes.xaxis.get_tick_params()["labelbottom"] for axes in (one, two, other)]
    assert told == [False, True, True]


def test_curves_of_a_long_training_make_a_small_picture(tmp_path: Path):
    rng = np.random.default_rng(0)
    flat = SimpleNamespace(
        frames=np.arange(1, 1001) * 65536.0, success=0.001 * rng.random(1000)
    )
    seed: Any = SimpleNamespace(stored=flat)
    figure = Figure()
    axes = figure.subplots()
    axes.set_ylim(0, 100)
    # One seed is its own mean; two are also drawn each.
    _draw_curves(axes, [seed], "red", "-", "one seed")
    assert len(axes.lines) == 1
    _draw_curves(axes, [seed, seed], "blue", "-", "two seeds")
    assert len(axes.lines) == 1 + 3
    save(figure, tmp_path, "curves")
    paths = re.findall(r'd="([^"]*)"', (tmp_path / "curves.svg").read_text())
    assert max(path.count("L") for path in paths) < 250


def test_a_run_that_has_not_learnt_has_a_mark_of_its_own(tmp_path: Path):
    folder, mine = StudyFolder(tmp_path), resolve(SMOKE)
    for run in mine.runs:
        learns = run.cell.name != "blind" and run.seed == 0
        store(folder, mine, run, 60.0 if learns else 1.0)
    results = folder.results(mine)
    figure = sample_efficiency(mine, results)
    assert figure is not None
    (axes,) = figure.axes
    end = results[0].run.end / 1e6
    crosses = [x for x in axes.lines if x.get_marker() == "x" and len(x.get_xdata())]
    found = [np.transpose(x.get_data()).tolist() for x in crosses]
    # Of two blind seeds, and of the second with a skin.
    assert found == [[[end, 0]], [[end, 1], [end, 1]]]
    # A cell of which no run has learnt has no mean.
    means = [x for x in axes.lines if x.get_marker() == "o" and len(x.get_xdata())]
    assert {y for x in means for y in np.asarray(x.get_ydata()).tolist()} == {0}


def test_the_success_over_the_range_is_drawn_for_each_signal_and_geometry(
    manifest: Manifest,
):
    field = {0.5: [20.0, 30.0, 40.0], 1.0: [50.0, 61.0, 62.0]}
    table = {
        f"field-proximity-{reach:g}m": dict(enumerate(values))
        for reach, values in field.items()
    }
    table["ray-binary-1m-reduce-min"] = {0: 11.0}
    table["ray-binary-1m"] = {0: 12.0}
    table["ray-localization-1m"] = {0: 13.0}
    figure = success_by_range(manifest, table)
    assert figure is not None
    fields, rays, closest = figure.axes
    # The outer two of three seeds count a quarter of the middle one.
    (line,) = (x for x in fields.lines if x.get_label() == "proximity")
    np.testing.assert_allclose(line.get_ydata(), [30, (61 + 0.25 * 112) / 1.5])
    # At its range, but for the shift that tells signals apart.
    np.testing.assert_allclose(line.get_xdata(), [0.5, 1.0], rtol=0.05)
    dots = [x for x in fields.lines if x.get_marker() == "."]
    assert [np.asarray(x.get_ydata()).tolist() for x in dots] == list(field.values())
    for axes, binary in ((rays, 12.0), (closest, 11.0)):
        drawn = {
            x.get_label(): np.asarray(x.get_ydata()).tolist()
            for x in axes.lines
            if len(x.get_xdata()) and not str(x.get_label()).startswith("_")
        }
        # Localization is the same for both.
        assert drawn == {"localization": [13.0], "binary": [binary]}


def test_each_panel_of_learning_curves_has_the_cells_of_its_range(tmp_path: Path):
    cells = ({"sensor.range": 1.0}, {"sensor.range": 2.0})
    mine = resolve(dataclasses.replace(FINDINGS, name="mine", cells=cells, seeds=(0,)))
    folder = StudyFolder(tmp_path)
    folder.plan(mine)
    for run, success in zip(mine.runs, (40.0, 80.0), strict=True):
        store(folder, mine, run, success)
    figure = learning_curves(mine, folder.results(mine))
    assert figure is not None
    for axes, reach, success in zip(figure.axes, (1, 2), (40.0, 80.0), strict=True):
        assert axes.get_title() == f"field, {reach} m"
        (line,) = axes.lines
        # In millions and per cent; it ends at 1 - exp(-5) of the success.
        assert line.get_xdata()[-1] == pytest.approx(mine.runs[0].end / 1e6)
        assert line.get_ydata()[-1] == pytest.approx(success * 0.9933, rel=1e-3)


def test_a_forest_has_the_region_and_the_effect_of_each_claim():
    cells = ("field-proximity-1m", "field-localization-1m")
    success = {cells[0]: {0: 58.0, 1: 61.0}, cells[1]: {0: 60.0, 1: 60.0}}
    judged = judge_findings({"success_3s": success, "share_to_90": {}})
    (two,) = (j for j in judged if j.finding.label == "2")
    (axes,) = forest([two]).axes
    regions = [(bar.get_x(), bar.get_width()) for bar in axes.patches]
    assert regions == [(-5.0, 10.0)] * 2
    (point,) = (x for x in axes.lines if x.get_marker() == "o")
    # In the row of its claim, below the title.
    assert (point.get_xdata()[0], point.get_ydata()[0]) == (-0.5, 1.0)
    texts = {text.get_text(): text.get_position() for text in axes.texts}
    assert texts[" a cell has no run"] == (0, 2.0)


def test_the_steps_to_half_and_to_most_of_the_success_are_drawn_in_millions(
    tmp_path: Path,
):
    folder, mine = StudyFolder(tmp_path), resolve(SMOKE)
    run = mine.run("field-proximity-2m-seed0")
    store(folder, mine, run, 60.0)
    result = folder.result(run)
    figure = sample_efficiency(mine, [result])
    assert figure is not None
    (axes,) = figure.axes
    points = [x for x in axes.lines if x.get_marker() == "o" and len(x.get_xdata())]
    found = {x.get_markerfacecolor(): x.get_xdata()[0] for x in points}
    # Hollow at 50 %, full at 90 %, as in the legend.
    half = found.pop("white")
    (most,) = found.values()
    assert half == pytest.approx(0.1371 * run.end / 1e6, rel=0.01)
    assert most == pytest.approx(0.4473 * run.end / 1e6, rel=0.01)


def test_a_success_of_zero_is_not_cut_at_the_axis(manifest: Manifest):
    figure = success_by_range(manifest, {"field-proximity-1m": {0: 0.0}})
    assert figure is not None
    (axes,) = figure.axes
    assert not any(x.get_clip_on() for x in axes.lines if x.get_marker() == "s")


def own_study(*more: dict[str, object]) -> tuple[Manifest, dict]:
    """A study of fields that the paper does not change, and made-up successes."""
    cells = ({}, {"history": 3}, {"sensor.corruption": "time_of_flight"}, *more)
    mine = resolve(dataclasses.replace(FINDINGS, name="mine", cells=cells))
    values = [[50.0, 52.0, 54.0], [60.0, 62.5, 64.0], [51.0], *[[9.0]] * len(more)]
    names = [cell.name for cell in mine.cells]
    return mine, {n: dict(enumerate(v)) for n, v in zip(names, values, strict=True)}


def test_cells_of_any_fields_are_drawn_beside_their_differences():
    mine, table = own_study()
    names = list(table)
    found = differences(names, table)
    figure = metric_by_cell(mine, BY_NAME["success_3s"], table, found)
    assert figure is not None
    left, right = figure.axes
    labels = [tick.get_text() for tick in left.get_yticklabels()]
    assert [label.replace("\n", "") for label in labels] == names
    dots = [x for x in left.lines if x.get_marker() == "."]
    assert [np.asarray(x.get_xdata()).tolist() for x in dots] == [
        list(table[name].values()) for name in names[:2]
    ]
    hollow = [x for x in left.lines if x.get_markerfacecolor() == "white"]
    assert [x.get_data() for x in hollow] == [([51.0], [2])]
    marks = [x for x in right.lines if x.get_marker() == "o"]
    means = [(float(x.get_xdata()[0]), float(x.get_ydata()[0])) for x in marks]
    assert means == [(pytest.approx(10.1666667), 1.0), (pytest.approx(1.0), 2.0)]
    # Ten points with a spread of two: red.
    assert found[0].p_value <= 0.05
    assert [x.get_color() for x in marks] == ["#D55E00", "#888888"]
    one = {names[0]: {0: 1.0}}
    assert metric_by_cell(mine, BY_NAME["success_3s"], one, []) is None


def test_many_cells_of_any_fields_are_told_apart_by_their_lines(
    folder: StudyFolder, manifest: Manifest
):
    result = folder.results(manifest)[0]
    more = [{"history": n} for n in range(4, 11)]
    mine, _ = own_study(*more)
    runs = [dataclasses.replace(result, run=run) for run in mine.runs if run.seed == 0]
    figure = learning_curves(mine, runs)
    assert figure is not None
    styles = {
        (line.get_color(), line.get_linestyle())
        for axes in figure.axes
        for line in axes.lines
        if line.get_label() in {cell.name for cell in mine.cells[1:]}
    }
    assert len(styles) == len(mine.cells) - 1


def test_an_infinite_range_is_left_out_of_the_figure_over_ranges():
    names = ("field-proximity-1m", "field-proximity-infm")
    cells = ({"sensor.range": 1.0}, {"sensor.range": math.inf})
    mine = resolve(dataclasses.replace(FINDINGS, name="mine", cells=cells))
    figure = success_by_range(mine, {name: {0: 60.0} for name in names})
    assert figure is not None
    (axes,) = figure.axes
    assert [tick.get_text() for tick in axes.get_xticklabels()] == ["1"]
    assert np.isfinite(axes.get_xlim()).all()
    assert success_by_range(mine, {names[1]: {0: 60.0}}) is None


def test_the_warning_time_is_drawn_below_the_success_at_its_range(manifest: Manifest):
    warning = {"hits": 9, "5%": 0.06, "median": 0.09, "95%": 0.13}
    longer = {**warning, "median": 0.18, "95%": 0.25}
    seen = [
        {"coverage": "field", "range": 1.0, "warning": longer},
        {"coverage": "field", "range": 0.5, "warning": warning},
        {"coverage": "field", "range": 0.2, "warning": {"hits": 0}},
        {"coverage": "ray", "range": 2.0, "warning": warning},
    ]
    success = {"field-proximity-1m": {0: 60.0}}
    figure = success_by_range(manifest, success, seen)
    assert figure is not None
    above, below = figure.axes
    (line,) = below.lines
    np.testing.assert_allclose(line.get_xdata(), (0.5, 1.0))
    np.testing.assert_allclose(line.get_ydata(), (90.0, 180.0))
    assert [t.get_text() for t in below.get_xticklabels()] == ["0.5", "1"]
    assert above.get_xlim() == below.get_xlim()
    figure = success_by_range(manifest, success, seen[-1:])
    assert figure is not None
    assert len(figure.axes) == 1


def test_a_legend_fits_into_a_figure_of_one_panel():
    coverages = ({"sensor.coverage": "none"}, {"sensor.coverage": "oracle"})
    signals = ("localization", "proximity", "binary")
    cells = (*({"sensor.signal": signal} for signal in signals), *coverages)
    mine = resolve(dataclasses.replace(FINDINGS, name="mine", cells=cells))
    figure = success_by_range(mine, {cell.name: {0: 50.0} for cell in mine.cells})
    assert figure is not None
    FigureCanvasAgg(figure).draw()
    (legend,) = figure.legends
    box = legend.get_window_extent()
    assert len(legend.get_texts()) == 5
    assert figure.bbox.x0 <= box.x0 < box.x1 <= figure.bbox.x1


def test_visibility_is_that_of_the_cells_with_the_bases_skin(capsys):
    cells = (
        {"sensor.range": 0.5},
        {"sensor.range": 0.5, "skin.num_sensors": 8},
        {"sensor.range": 0.3, "sensor.occlusion": True},
        {"sensor.coverage": "none"},
        {"sensor.range": math.inf},
    )
    study = dataclasses.replace(
        FINDINGS, name="mine", cells=cells, base={"skin.num_sensors": 4}
    )
    seen = what_is_seen(resolve(study))
    assert [(c["coverage"], c["range"]) for c in seen["cells"]] == [("field", 0.5)]
    said = capsys.readouterr().out
    assert "not analysed" in said
    assert "field-proximity-infm" in said
    assert "field-proximity-0.5m-num_sensors-8, field-proximity-0.3m-occlusion" in said
    assert what_is_seen(resolve(dataclasses.replace(study, cells=cells[1:]))) == {}
    throws = {"task.throws.shape": "capsule", "task.throws.size": (0.1, 0.2)}
    assert what_is_seen(resolve(dataclasses.replace(study, base=throws))) == {}
    assert capsys.readouterr().out.endswith("visibility is analysed for spheres only\n")


def test_frames_to_a_share_are_read_off_the_curve(
    folder: StudyFolder, manifest: Manifest
):
    result = folder.result(manifest.run("field-proximity-2m-seed0"))
    end = result.run.end
    # 1 - exp(-t / 0.2) is half of its end value at t = 0.2 ln 2 = 0.1386; the end
    # is the mean of the last twentieth, 0.9924.
    own = -0.2 * np.log(1 - 0.5 * 0.9924)
    assert frames_to(result, 0.5) == pytest.approx(own * end, rel=2e-3)
    # A run that has not learnt has used its whole budget.
    blind = folder.result(manifest.run("blind-seed0"))
    assert frames_to(blind, 0.5) == blind.run.end
    # Between stored lines it is linear: 0, 0.2, 0.4 and then 0.8.
    stored = dataclasses.replace(
        result.stored,
        frames=np.array([0.0, 10, 20, 30]),
        success=np.array([0, 0.2, 0.4, 0.8]),
    )
    result = dataclasses.replace(result, stored=stored)
    assert frames_to(result, 0.75) == pytest.approx(25)


def test_a_run_without_an_episode_long_enough_to_tell_has_used_its_whole_budget(
    manifest: Manifest, tmp_path: Path
):
    folder, run = StudyFolder(tmp_path), manifest.run("blind-seed0")
    store(folder, manifest, run, 0.0)
    lines = [f"{run.end * i // 4},{i},nan" for i in range(1, 5)]
    text = "\n".join(["frames,time/wall_s,episode/success", *lines]) + "\n"
    (folder.result_path(run.name) / "metrics.csv").write_text(text)
    results = [folder.result(run)]
    assert frames_to(results[0], 0.5) == run.end
    values = tables(results)
    assert values["m_frames_to_90"]["blind"] == {0: run.end / 1e6}
    assert values["share_to_90"]["blind"] == {0: 100}
    assert learning_curves(manifest, results) is None
    assert sample_efficiency(manifest, results) is not None


def test_seeds_that_never_learn_do_not_make_a_cell_look_fast(tmp_path: Path):
    folder = StudyFolder(tmp_path)
    more = resolve(dataclasses.replace(FINDINGS, seeds=(0, 1, 2, 3, 4)))
    results = []
    for seed in range(5):
        run = more.run(f"field-proximity-2m-seed{seed}")
        store(folder, more, run, 60.0 if seed < 3 else 1.0)
        results.append(folder.result(run))
    # Three learn within about a fifth of the budget, two do not learn.
    for seed in range(3):
        frames = results[seed].run.end * np.array([0, 0.20 + 0.01 * seed, 0.5, 1])
        stored = dataclasses.replace(
            results[seed].stored, frames=frames, success=np.array([0, 0.5, 0.5, 0.5])
        )
        results[seed] = dataclasses.replace(results[seed], stored=stored)
    for kept, verdict in ((3, "confirmed"), (5, "undecided")):
        values = tables(results[:kept])
        (judged,) = (j for j in judge_findings(values) if j.finding.label == "6b")
        assert judged.verdict == verdict
    shares = values["share_to_90"]["field-proximity-2m"]
    # 90 % of the way to 20, 21, 22 %.
    assert list(shares.values()) == pytest.approx([18, 18.9, 19.8, 100, 100])


def test_a_value_that_only_some_seeds_have_says_how_many(
    tmp_path: Path, without_pictures
):
    folder, manifest = StudyFolder(tmp_path), resolve(SMOKE)
    folder.plan(manifest)
    # The second seed avoids no first ball, and thus has no later ones.
    for seed, success in enumerate((50.0, 0.0)):
        run = manifest.run(f"field-proximity-2m-seed{seed}")
        store(folder, manifest, run, success)
    write_report(folder, tmp_path / "report")
    text = (tmp_path / "report" / "report.md").read_text()
    (row,) = (x for x in text.splitlines() if x.startswith("| field-proximity-2m |"))
    assert row.count("n = ") == 1
    assert "| 40.0, n = 1 |" in row


def test_the_tables_hold_what_there_is(folder: StudyFolder, manifest: Manifest):
    values = tables(folder.results(manifest))
    assert values.keys() == {m.name for m in METRICS}
    assert "blind" not in values["masked_success_3s"]
    assert set(values["success_3s"]["field-binary-1m"]) == {0, 1, 2}
    own = values["success_3s"]["field-binary-1m"][0]
    assert own == pytest.approx(expected(manifest.run("field-binary-1m-seed0")), abs=15)


def test_markup_is_written_as_text(tmp_path: Path):
    text = "\n\n".join(
        ("# a < b", "**bold** & *slanted*", table(("x|y",), [("<b>1 * 2</b>",)]))
    )
    assert text.endswith("| x\\|y |\n| --- |\n| <b>1 * 2</b> |")
    html = page("t", text, tmp_path)
    assert "<h1>a &lt; b</h1>" in html
    assert "<strong>bold</strong> &amp; <em>slanted</em>" in html
    assert "<th>x|y</th>" in html
    assert "<td>&lt;b&gt;1 * 2&lt;/b&gt;</td>" in html
