"""Studies and their manifests: what is fixed, what may be added, what is refused."""

from __future__ import annotations

import dataclasses
import json
import re
import shutil
from pathlib import Path
from typing import Any

import pytest

from egoskin.make import EnvConfig
from egoskin.runs.config import INIT_HASH, SKIN_HASH, TrainConfig
from egoskin.storage.formats import content_hash, read_sealed, sealed_json
from egoskin.storage.serialization import to_plain
from egoskin.study.findings import CELLS, FINDINGS
from egoskin.study.folder import StudyFolder
from egoskin.study.manifest import (
    EvaluationPlan,
    Manifest,
    Study,
    load_study,
    resolve,
)
from egoskin.study.metrics import METRICS
from egoskin.study.shipped import PAPER, SMOKE, STUDIES
from owning import TOML, write_robot
from studies import POLICY, as_format_1

STUDY = Study(
    name="small",
    purpose="to test",
    cells=({"sensor.range": 1}, {"sensor.coverage": "none"}),
    seeds=(0, 1),
    frames=512,
    base={"num_envs": 32},
)


def changed(**fields: Any) -> Manifest:
    return resolve(dataclasses.replace(STUDY, **fields))


@pytest.fixture(scope="module")
def resolved() -> dict[str, Manifest]:
    return {name: resolve(study) for name, study in STUDIES.items()}


# --- the shipped studies ------------------------------------------------------------


def test_the_papers_study_is_that_of_the_paper(resolved):
    paper = resolved["paper"]
    assert (len(paper.cells), len(paper.runs)) == (32, 320)
    # 4096 agents x 16 steps x 3000 epochs.
    assert {run.end for run in paper.runs} == {196_608_000}
    assert {cell.config.env.standard for cell in paper.cells} == {"paper"}
    assert paper.not_default() == {
        "env.privileged": "velocity",
        "env.task.throws.first_delay": [0.0, 0.0],
        "total_frames": 196_608_000,
    }
    assert {run.end for run in resolved["paper-1000"].runs} == {65_536_000}


def test_the_findings_are_decided_by_29_cells_of_the_default_recipe(resolved):
    findings = resolved["findings"]
    assert (len(findings.cells), findings.not_default()) == (29, {})
    names = {cell.name for cell in findings.cells}
    # All but the blind robot, which is only the visual baseline of the figures.
    assert names - {"blind"} == CELLS
    for other in ("paper", "paper-1000"):
        assert {cell.name for cell in resolved[other].cells} >= CELLS
    assert {f.metric for f in FINDINGS} <= {m.name for m in METRICS}


def test_every_cell_is_run_with_a_seed_before_any_with_the_next(resolved):
    runs = resolved["findings"].runs
    assert [run.seed for run in runs] == [0] * 29 + [1] * 29 + [2] * 29
    assert len({run.name for run in runs}) == 87


# --- cells --------------------------------------------------------------------------


def test_runs_are_chosen_by_patterns_in_the_order_of_the_study():
    manifest = changed()
    names = [run.name for run in manifest.runs]
    assert [r.name for r in manifest.matching(["blind-*", "*-seed0"])] == [
        name for name in names if name != "field-proximity-1m-seed1"
    ]
    assert manifest.matching(["*"]) == manifest.runs
    with pytest.raises(ValueError, match="no run 'blind-sed1', did you mean 'blind-s"):
        manifest.matching(["*", "blind-sed1"])


def test_runs_end_with_a_whole_rollout():
    # Of 32 agents x 16 steps: no fewer frames than are asked.
    ends = [changed(frames=frames).runs[0].end for frames in (1, 512, 513)]
    assert ends == [512, 512, 1024]


def test_a_cell_is_named_by_what_differs():
    manifest = changed(
        cells=(
            {},
            {"history": 3},
            {"sensor.coverage": "ray", "sensor.reduce": "min"},
            {"ppo.network.hidden": [64, 64], "skin.num_sensors": 8},
            {"task.throws.first_delay": [0.0, 0.5]},
            {"task.throws.azimuth_deg": [-90.0, 90.0]},
            {"task.throws.azimuth_deg": [90.0, 90.0]},
        )
    )
    assert [cell.name for cell in manifest.cells] == [
        "field-proximity-2m",
        "field-proximity-2m-history-3",
        "ray-proximity-2m-reduce-min",
        "field-proximity-2m-num_sensors-8-hidden-64-64",
        "field-proximity-2m-first_delay-0.0-0.5",
        "field-proximity-2m-azimuth_deg-minus90.0-90.0",
        "field-proximity-2m-azimuth_deg-90.0-90.0",
    ]
    assert manifest.cells[-1].config.env.standard == "custom"
    run = manifest.runs[0].config
    assert (run.num_workers, run.learner_threads, run.num_envs) == (1, 1, 32)


@pytest.mark.parametrize(
    ("cell", "text"),
    [
        ({"sensor.rang": 1}, "no field 'sensor.rang', did you mean 'range'"),
        ({"sensr.range": 1}, "no field 'sensr', did you mean 'sensor'"),
        ({"histori": 1}, "no field 'histori', did you mean 'history'"),
        ({"pppo.gamma": 1}, "no field 'pppo', did you mean 'ppo'"),
        ({"sensor.range": "far"}, "range"),
        ({"sensor": {"range": 1.0}}, "sensor is a group.*one by one, as sensor.cover"),
        ({"sensor.range": -1.0}, "sensor.range=-1.0.*must be at least 0.001"),
        ({"sensor.reduce": "min"}, "is for ray sensors"),
        ({"seed": 1}, "seed cannot be set here"),
        ({"total_frames": 1}, "total_frames cannot be set here"),
        ({"checkpoint_interval": 1.0}, "checkpoint_interval cannot be set here"),
        ({"sensor.coverage": "none"}, "cell blind is defined twice"),
        ({"skin.path": "no.json"}, r"no\.json"),
        ({"robot": "ROBOT"}, "robot walker cannot be trained: the default pose is out"),
        ({"init_from": "localization"}, "reads 3 values of 'signal', but here there "),
    ],
)
def test_a_cell_that_cannot_exist_is_named(cell, text, tmp_path: Path):
    if "robot" in cell:
        toml = TOML.replace("left_shoulder = 0.1", "left_shoulder = 1.8")
        cell = {"robot": str(write_robot(tmp_path / "walker", toml))}
    with pytest.raises(ValueError, match=rf"(?s)study small, cell 2.*({text})"):
        changed(cells=({"sensor.coverage": "none"}, cell))


def test_two_cells_of_one_name_are_told_what_they_differ_in(tmp_path: Path):
    cells = []
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        path = shutil.copy(POLICY, tmp_path / name / "p.safetensors")
        cells.append({"sensor.coverage": "none", "init_from": str(path)})
    text = (
        "cell 2: another cell is also named blind-init_from-p.safetensors; they only "
        "differ in init_from: give one of them a name"
    )
    with pytest.raises(ValueError, match=re.escape(text)):
        changed(cells=tuple(cells))
    named = changed(cells=({**cells[0], "name": "first"}, cells[1]))
    assert [c.name for c in named.cells] == ["first", "blind-init_from-p.safetensors"]
    # The name of a blind cell has no range.
    blind = {"sensor.coverage": "none"}
    with pytest.raises(ValueError, match=r"named blind; they .* in sensor\.range"):
        changed(cells=(blind, {**blind, "sensor.range": 1.0}))


def test_cells_may_have_names_of_their_own(tmp_path: Path):
    named = changed(cells=({"name": "base"}, {"name": "long", "history": 8}))
    assert [run.name for run in named.runs[:2]] == ["base-seed0", "long-seed0"]
    assert named.overrides(named.cells[1]) == {"env.history": 8}
    named.save(tmp_path / "manifest.json")
    assert Manifest.load(tmp_path / "manifest.json") == named
    # The same runs under two names would be trained twice.
    with pytest.raises(ValueError, match="cell 2: base and field-proximity-2m are the"):
        changed(cells=({"name": "base"}, {}))
    text = "cell field-proximity-2m is the manifest's cell base: give it that name"
    with pytest.raises(ValueError, match=text):
        named.extended(changed(cells=({},), seeds=(7,)))
    more = named.extended(changed(cells=({"name": "base"},), seeds=(7,)))
    assert (more.cells, more.seeds) == (named.cells, (*named.seeds, 7))


@pytest.mark.parametrize("name", ["a/b", "", "-a", "..", 3, None])
def test_names_of_cells_are_part_of_file_names(name):
    with pytest.raises(ValueError, match=f"cell 1: a cell's name may .* got {name!r}"):
        changed(cells=({"name": name},))


def test_a_cell_whose_name_is_too_long_for_files_is_told_by_its_number():
    cell = {"ppo.network.hidden": [256] * 41 + [1000]}
    assert len(changed(cells=(cell,)).runs[0].name) == 200
    text = r"cell 2: the names of its runs would have 201 bytes, and at most 200 "
    with pytest.raises(ValueError, match=text):
        changed(cells=({}, cell), seeds=(0, 10))


@pytest.mark.parametrize(
    ("fields", "text"),
    [
        ({"cells": ()}, "at least one cell"),
        ({"seeds": (-1,)}, "seed must be"),
        ({"seeds": (0, 1, 0)}, "study small: a seed is given twice"),
        ({"frames": 0}, "frames must be"),
        ({"name": "a/b"}, "name"),
    ],
)
def test_a_study_of_nothing_is_refused(fields, text):
    with pytest.raises(ValueError, match=text):
        dataclasses.replace(STUDY, **fields)


def test_an_evaluation_has_no_more_episodes_than_can_be_played():
    with pytest.raises(ValueError, match="episodes must be at most 1,048,576"):
        EvaluationPlan(episodes=2_000_000)


def test_a_study_can_be_a_file(tmp_path: Path):
    path = tmp_path / "mine.json"
    path.write_text(json.dumps(to_plain(STUDY)))
    assert resolve(load_study(path)) == resolve(STUDY)
    path.write_text(json.dumps({**to_plain(STUDY), "cell": []}))
    with pytest.raises(ValueError, match=r"mine\.json: .*cell"):
        load_study(path)


# --- the manifest -------------------------------------------------------------------


def test_a_manifest_is_read_as_it_was_written(tmp_path: Path):
    for study in (STUDY, SMOKE, PAPER):
        resolve(study).save(tmp_path / "m.json")
        assert Manifest.load(tmp_path / "m.json") == resolve(study)


def test_cells_and_seeds_may_be_added():
    more = changed(cells=(*STUDY.cells, {"sensor.range": 2}), seeds=(0, 1, 2))
    both = resolve(STUDY).extended(more)
    assert both == more
    assert len(both.runs) == 9
    # Seeds that are not named again stay.
    assert both.extended(changed(seeds=(5,))).seeds == (0, 1, 2, 5)


@pytest.mark.parametrize(
    ("other", "text"),
    [
        ({"frames": 1024}, "total_frames"),
        ({"standard": "paper"}, "first_delay"),
        ({"base": {"num_envs": 64}}, "num_envs"),
        ({"evaluation": EvaluationPlan(episodes=8)}, "evaluation cannot be changed"),
        ({"name": "other"}, "study cannot be changed"),
    ],
)
def test_nothing_else_may_change(other, text, tmp_path: Path):
    folder = StudyFolder(tmp_path)
    folder.plan(resolve(STUDY))
    before = folder.manifest_path.read_bytes()
    with pytest.raises(ValueError, match=text):
        folder.plan(changed(**other))
    assert folder.manifest_path.read_bytes() == before


def test_a_manifest_that_was_edited_is_refused(tmp_path: Path):
    folder = StudyFolder(tmp_path)
    folder.plan(resolve(STUDY))
    text = folder.manifest_path.read_text()
    folder.manifest_path.write_text(text.replace('"num_envs": 32', '"num_envs": 64'))
    with pytest.raises(ValueError, match=r"manifest\.json is damaged or was edited"):
        folder.manifest()
    with pytest.raises(ValueError, match="is not a study folder"):
        StudyFolder(tmp_path / "none").manifest()


def test_a_study_begun_before_options_changed_goes_on_as_it_was(tmp_path: Path):
    folder = StudyFolder(tmp_path)
    study = dataclasses.replace(STUDY, standard="1")
    folder.plan(resolve(study))
    as_format_1(folder.manifest_path)
    manifest = folder.manifest()
    assert manifest == resolve(study)
    assert {run.config.env.standard for run in manifest.runs} == {"1"}
    # After seeds are added, it is written in the current format.
    more = dataclasses.replace(study, seeds=(0, 1, 2))
    assert folder.plan(resolve(more)) == folder.manifest() == resolve(more)
    assert "compile_kernels" not in folder.manifest_path.read_text()


def test_seeds_are_added_without_a_change_of_the_purpose():
    more = dataclasses.replace(
        STUDY, purpose="one more", seeds=(7,), cells=STUDY.cells[:1]
    )
    manifest = resolve(STUDY).extended(resolve(more))
    assert manifest.purpose == "to test"
    assert manifest.seeds == (*STUDY.seeds, 7)
    assert len(manifest.cells) == len(STUDY.cells)


def test_a_default_that_changes_changes_no_study_that_has_begun(tmp_path: Path):
    folder = StudyFolder(tmp_path)
    folder.plan(resolve(STUDY))
    # As if the discount's default had been different at that time.
    content, _ = read_sealed(folder.manifest_path)
    content["base"]["ppo"]["gamma"] = 0.9
    folder.manifest_path.write_bytes(sealed_json(content))
    manifest = folder.manifest()
    assert {run.config.ppo.gamma for run in manifest.runs} == {0.9}
    assert TrainConfig().ppo.gamma != 0.9
    with pytest.raises(ValueError, match=r"it differs in ppo\.gamma"):
        folder.plan(resolve(STUDY))


def test_an_option_that_is_no_more_and_had_an_effect_is_refused(tmp_path: Path):
    folder = StudyFolder(tmp_path)
    folder.plan(resolve(STUDY))
    as_format_1(folder.manifest_path)
    content = json.loads(folder.manifest_path.read_text())
    content["cells"][1]["overrides"]["core_frames"] = [0, 7]
    content.pop("sha256")
    folder.manifest_path.write_text(
        json.dumps({**content, "sha256": content_hash(content)})
    )
    with pytest.raises(ValueError, match=r"manifest\.json was made with core_frames="):
        folder.manifest()


def test_files_are_named_by_absolute_paths_and_pinned_by_their_content(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    config = EnvConfig()
    skin = config.skin.build(config.robot_config)
    (tmp_path / "skins").mkdir()
    skin.save(tmp_path / "skins/my.json")
    shutil.copy(POLICY, tmp_path / "old.safetensors")
    monkeypatch.chdir(tmp_path)
    cells = (
        {"skin.path": "skins/my.json"},
        {"sensor.coverage": "none", "init_from": "old.safetensors"},
        {"sensor.coverage": "none", "init_from": "blind"},
    )
    manifest = changed(cells=cells)
    manifest.save(tmp_path / "m.json")
    monkeypatch.chdir("/")
    assert Manifest.load(tmp_path / "m.json") == manifest
    names = ("my.json", "old.safetensors", "blind")
    assert [c.name.rpartition("-")[2] for c in manifest.cells] == [*names]
    one, other, own = (cell.config for cell in manifest.cells)
    assert one.env.skin.path == tmp_path / "skins/my.json"
    assert other.init_from == tmp_path / "old.safetensors"
    assert own.init_from == Path("blind")
    # The same networks, by whatever name.
    assert manifest.cells[1].init_sha256 == manifest.cells[2].init_sha256 is not None
    with pytest.raises(ValueError, match=r"small, cell 1: no policy none\.safet"):
        changed(cells=({"init_from": "none.safetensors"},))


def test_a_run_is_compared_by_the_content_of_its_files_not_their_place():
    cell = {"sensor.coverage": "none", "init_from": "blind"}
    run = changed(cells=(cell,)).runs[0]
    moved = dataclasses.replace(run.config, init_from=Path("/elsewhere"))
    hashes = run.cell.hashes
    assert run.differences(moved, hashes) == []
    assert run.differences(moved, {**hashes, INIT_HASH: "0"}) == [INIT_HASH]
    assert run.differences(moved, {**hashes, SKIN_HASH: "0"}) == [SKIN_HASH]
    new = dataclasses.replace(run.config, init_from=None)
    assert run.differences(new) == ["init_from"]


def test_robots_of_ones_own_are_kept_as_data(tmp_path: Path):
    one = str(write_robot(tmp_path / "one"))
    other = str(write_robot(tmp_path / "other", TOML.replace("kp = 150", "kp = 160")))
    cells = ({}, {"robot": other}, {"robot": "h1_2"})
    own = changed(base={"robot": one, "skin.num_sensors": 8}, cells=cells)
    names = [
        "field-proximity-2m",
        *(f"field-proximity-2m-robot-{name}" for name in ("other", "h1_2")),
    ]
    assert [cell.name for cell in own.cells] == names
    own.save(tmp_path / "manifest.json")
    for name in ("one", "other"):
        (tmp_path / name / "robot.toml").unlink()
    loaded = Manifest.load(tmp_path / "manifest.json")
    assert loaded == own
    gains = [cell.config.env.robot_config.gains for cell in loaded.cells[:2]]
    assert [each["stiff"]["*_hip"].kp for each in gains] == [150, 160]
    with pytest.raises(ValueError, match=r"small, cell 1: .*robot.toml"):
        changed(cells=({"robot": one},))
