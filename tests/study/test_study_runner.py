"""Studies with real runs: results are kept, shared and repeated despite faults."""

from __future__ import annotations

import csv
import dataclasses
import io
import json
import os
import select
import shlex
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest

from calling import call, hide, limit_file_size, succeed, wait_for
from egoskin.commands import study as command
from egoskin.commands.study import Run as RunStudy
from egoskin.commands.study import print_status, show
from egoskin.evaluation.throw_set import evaluate, standard_task
from egoskin.make import EnvConfig
from egoskin.runs.run import Run
from egoskin.sensors import MASK_ALL
from egoskin.storage.formats import read_sealed, sealed_json
from egoskin.storage.serialization import to_plain
from egoskin.storage.tensor_file import load_tensors, save_tensors
from egoskin.study import cost as cost_module
from egoskin.study import evaluation, job
from egoskin.study import folder as study_folder
from egoskin.study.claims import claimed
from egoskin.study.cost import Cost, Speed, cost, measure, measure_all
from egoskin.study.folder import Failure, RunStatus, StudyFolder, policy_hash
from egoskin.study.job import CLAIMED, STOPPED, Stop, work
from egoskin.study.manifest import EvaluationPlan, Manifest, PlannedRun, Study, resolve
from egoskin.study.metrics import runs_csv
from egoskin.study.runner import (
    LocalRunner,
    Progress,
    end_job,
    how_it_ended,
    slurm_script,
)
from making import make_policy

# 16 agents x 16 steps are 256 frames a rollout.
BATCH = 256
STUDY = Study(
    name="tiny",
    purpose="to test",
    cells=({}, {"sensor.coverage": "none"}),
    seeds=(0, 1),
    frames=12 * BATCH,
    base={"num_envs": 16, "checkpoint_interval": 0.01},
    evaluation=EvaluationPlan(episodes=8),
)
SHORT = dataclasses.replace(STUDY, frames=2 * BATCH, cells=STUDY.cells[1:], seeds=(0,))
NAME = "blind-seed0"


class Never(Stop):
    """A stop without signal handlers: pytest keeps its own."""

    def __init__(self, requested: bool = False) -> None:
        self.requested = requested


def table(folder: StudyFolder) -> list[dict[str, str]]:
    """Return the table of all runs, without wall times."""
    manifest = folder.manifest()
    text = runs_csv(manifest, folder.results(manifest))
    rows = list(csv.DictReader(io.StringIO(text)))
    words = ("time", "wall", "per_s", "path")
    kept = [k for k in rows[0] if not any(word in k for word in words)]
    return [{k: row[k] for k in kept} for row in rows]


# --- a run --------------------------------------------------------------------------


@pytest.fixture(scope="module")
def finished(tmp_path_factory) -> Path:
    """A study of one short, finished run; tests copy it."""
    folder = StudyFolder(tmp_path_factory.mktemp("study") / "study")
    folder.plan(resolve(SHORT))
    assert work(folder, NAME, Never()) == 0
    return folder.path


@pytest.fixture
def folder(finished: Path, tmp_path: Path) -> StudyFolder:
    return StudyFolder(Path(shutil.copytree(finished, tmp_path / "study")))


def files(path: Path) -> dict[str, int]:
    return {str(p): p.stat().st_mtime_ns for p in path.rglob("*") if p.is_file()}


def test_a_finished_run_has_all_that_a_report_needs_and_is_not_run_again(
    folder: StudyFolder,
):
    assert sorted(p.name for p in folder.result_path(NAME).iterdir()) == [
        "config.json",
        "evaluation_000000000512.json",
        "metrics.csv",
        "policies",
        "run.json",
        "skin.json",
    ]
    before = files(folder.result_path(NAME)) | files(folder.run_path(NAME))
    assert work(folder, NAME, Never()) == 0
    assert files(folder.result_path(NAME)) | files(folder.run_path(NAME)) == before
    # The results alone are enough.
    expected = table(folder)
    shutil.rmtree(folder.path / "runs")
    assert table(folder) == expected
    (result,) = folder.results(folder.manifest())
    assert result.stored.evaluation["masked"] is None


def test_a_run_that_was_trained_is_only_judged(folder: StudyFolder):
    expected = table(folder)
    shutil.rmtree(folder.result_path(NAME))
    before = files(folder.run_path(NAME))
    # A stop while it is judged leaves no result.
    assert work(folder, NAME, Never(requested=True)) == STOPPED
    assert folder.status(folder.manifest().runs)[0].state == "stopped"
    folder.note_failure(NAME, "killed by SIGKILL")
    assert work(folder, NAME, Never()) == 0
    assert files(folder.run_path(NAME)) == before
    assert table(folder) == expected
    assert folder.failure(NAME) is None


def test_a_policy_without_the_last_checkpoint_is_not_trained_to_its_end(
    folder: StudyFolder,
):
    # A run killed between the two lacks the last lines of its metrics.
    run = Run.open(folder.run_path(NAME))
    _, header = run.load_checkpoint()
    assert header["frames"] == 2 * BATCH
    planned = folder.manifest().run(NAME)
    assert folder.is_trained(planned)
    last = run.checkpoint_path.read_bytes()
    tensors, header = load_tensors(run.checkpoint_path)
    save_tensors(run.checkpoint_path, tensors, {**header, "frames": BATCH})
    assert not folder.is_trained(planned)
    run.checkpoint_path.write_bytes(last)
    run.policy_path(2 * BATCH).unlink()
    assert not folder.is_trained(planned)


def test_without_a_checkpoint_the_metrics_tell_the_end_of_a_training(
    folder: StudyFolder,
):
    planned = folder.manifest().run(NAME)
    run = Run.open(folder.run_path(NAME))
    run.checkpoint_path.unlink()
    assert folder.is_trained(planned)
    path = run.path / "metrics.csv"
    lines = path.read_text().splitlines(keepends=True)
    path.write_text("".join(lines[:-1]))
    assert not folder.is_trained(planned)


def test_a_run_that_is_planned_for_longer_is_refused(folder: StudyFolder):
    manifest = folder.manifest()
    (cell,) = manifest.cells
    shorter = dataclasses.replace(cell.config, total_frames=BATCH)
    short = PlannedRun(cell=dataclasses.replace(cell, config=shorter), seed=0)
    with pytest.raises(ValueError, match="planned for 512 frames, the study for 256"):
        folder.open_run(short)


def test_a_stop_leaves_a_checkpoint_and_no_result(tmp_path: Path, capsys):
    folder = StudyFolder(tmp_path / "study")
    folder.plan(resolve(SHORT))
    # With other numbers of workers and threads than when it is resumed.
    assert work(folder, NAME, Never(requested=True), cores=2) == STOPPED
    assert (folder.run_path(NAME) / "checkpoint.safetensors").is_file()
    assert not folder.is_finished(NAME)
    status = folder.status(folder.manifest().runs)
    assert [s.state for s in status] == ["stopped"]
    assert str(Progress.of(status)).startswith("1 stopped; ")
    print_status(folder, folder.manifest(), status)
    assert "blind  stopped at 0%" in capsys.readouterr().out


def test_a_run_that_somebody_works_on_is_left_alone(folder: StudyFolder):
    shutil.rmtree(folder.result_path(NAME))
    with claimed(folder.claims, NAME) as mine:
        assert mine
        assert [s.state for s in folder.status(folder.manifest().runs)] == ["running"]
        assert work(folder, NAME, Never()) == CLAIMED
    assert not folder.is_finished(NAME)


def test_a_run_whose_claim_is_lost_has_not_failed(
    folder: StudyFolder, monkeypatch: pytest.MonkeyPatch
):
    ended = []

    @contextmanager
    def lose(path: Path, name: str, *, lost: Callable[[], None]) -> Iterator[bool]:
        lost()
        yield False

    monkeypatch.setattr(job, "claimed", lose)
    monkeypatch.setattr(os, "_exit", ended.append)
    work(folder, NAME, Never())
    assert ended == [CLAIMED]


def test_a_run_that_ppo_trains_is_left_to_it(folder: StudyFolder):
    shutil.rmtree(folder.result_path(NAME))
    with Run.open(folder.run_path(NAME)).locked():
        assert [s.state for s in folder.status(folder.manifest().runs)] == ["running"]
        assert work(folder, NAME, Never()) == CLAIMED
    assert work(folder, NAME, Never()) == 0


def test_a_run_that_is_being_trained_since_a_moment_is_left_alone(
    folder: StudyFolder, monkeypatch: pytest.MonkeyPatch
):
    shutil.rmtree(folder.result_path(NAME))
    monkeypatch.setattr(StudyFolder, "is_trained", lambda *args: False)
    with Run.open(folder.run_path(NAME)).locked():
        # The lock was still free when the job looked.
        monkeypatch.setattr(StudyFolder, "is_trained_elsewhere", lambda *args: False)
        assert work(folder, NAME, Never()) == CLAIMED


def test_a_run_is_judged_on_all_its_cores(
    folder: StudyFolder, monkeypatch: pytest.MonkeyPatch
):
    expected, used = table(folder), []
    shutil.rmtree(folder.result_path(NAME))
    play = evaluation.play_throws

    def noted(*args, num_workers: int, hold: bool = False, **options):
        used.append((num_workers, hold))
        return play(*args, num_workers=num_workers, hold=hold, **options)

    monkeypatch.setattr(evaluation, "play_throws", noted)
    assert work(folder, NAME, Never(), cores=2) == 0
    # Also the robot held rigid.
    assert sorted(used) == [(2, False), (2, True)]
    assert table(folder) == expected


def test_a_run_made_before_is_adopted(folder: StudyFolder, tmp_path: Path):
    expected = table(folder)
    made = tmp_path / "made"
    shutil.move(folder.run_path(NAME), made)
    shutil.rmtree(folder.result_path(NAME))
    # Its numbers of workers and threads differ from the study's.
    content, _ = read_sealed(made / "config.json")
    content.update(num_workers=2, learner_threads=None)
    (made / "config.json").write_bytes(sealed_json(content))
    assert folder.adopt(folder.manifest(), made).name == NAME
    before = files(made)
    assert work(folder, NAME, Never()) == 0
    assert files(made) == before
    assert table(folder) == expected
    with pytest.raises(ValueError, match="already exists"):
        folder.adopt(folder.manifest(), made)


def test_a_run_of_another_study_is_not_adopted(folder: StudyFolder, tmp_path: Path):
    manifest = resolve(dataclasses.replace(SHORT, base={"num_envs": 32}))
    other = StudyFolder(tmp_path / "other")
    other.plan(manifest)
    with pytest.raises(ValueError, match="blind-seed0, differs in num_envs"):
        other.adopt(manifest, folder.run_path(NAME))
    # Its folder and its result are not accepted either.
    shutil.copytree(folder.run_path(NAME), other.run_path(NAME))
    with pytest.raises(
        ValueError, match=r"does not match the manifest: it differs in num_envs"
    ):
        work(other, NAME, Never())
    shutil.copytree(folder.result_path(NAME), other.result_path(NAME))
    with pytest.raises(
        ValueError, match=r"does not match the manifest: it differs in num_envs"
    ):
        other.results(manifest)


@pytest.mark.parametrize(
    ("changed", "differs"),
    [
        ({"episodes": 7}, "evaluation.episodes"),
        ({"throw_set": 3}, "evaluation.throw_set"),
    ],
)
def test_a_result_of_another_evaluation_is_not_accepted(
    changed, differs, folder: StudyFolder, tmp_path: Path
):
    plan = dataclasses.replace(SHORT.evaluation, **changed)
    manifest = resolve(dataclasses.replace(SHORT, evaluation=plan))
    other = StudyFolder(tmp_path / "other")
    other.plan(manifest)
    shutil.copytree(folder.result_path(NAME), other.result_path(NAME))
    with pytest.raises(ValueError, match=f"it differs in {differs}$"):
        other.results(manifest)


def test_a_result_with_another_skin_is_not_accepted(folder: StudyFolder):
    manifest = folder.manifest()
    cells = [dataclasses.replace(c, skin_sha256="0" * 64) for c in manifest.cells]
    with pytest.raises(ValueError, match=r"it differs in skin_sha256$"):
        folder.results(dataclasses.replace(manifest, cells=tuple(cells)))


def test_an_adopted_run_that_is_gone_is_named(folder: StudyFolder, tmp_path: Path):
    made = tmp_path / "made"
    shutil.move(folder.run_path(NAME), made)
    shutil.rmtree(folder.result_path(NAME))
    folder.adopt(folder.manifest(), made)
    made.rename(tmp_path / "elsewhere")
    with pytest.raises(ValueError, match=f"blind-seed0 is a link to {made}, which d"):
        work(folder, NAME, Never())


def test_a_run_with_another_skin_is_refused(folder: StudyFolder):
    manifest = folder.manifest()
    cell = dataclasses.replace(manifest.cells[0], skin_sha256="0" * 64)
    dataclasses.replace(manifest, cells=(cell,)).save(folder.manifest_path)
    shutil.rmtree(folder.result_path(NAME))
    with pytest.raises(ValueError, match="not the skin of the study's cell blind"):
        work(folder, NAME, Never())


def test_a_run_whose_first_networks_have_changed_is_refused(tmp_path: Path):
    folder = StudyFolder(tmp_path / "study")
    cell = {"sensor.coverage": "none", "init_from": "blind"}
    study = dataclasses.replace(SHORT, cells=(cell,), base={"num_envs": 16})
    manifest = folder.plan(resolve(study))
    assert folder.open_run(manifest.runs[0]).config.init_from == Path("blind")
    old = dataclasses.replace(manifest.cells[0], init_sha256="0" * 64)
    manifest = dataclasses.replace(manifest, cells=(old,), seeds=(1,))
    with pytest.raises(ValueError, match="blind has changed: it is not what the study"):
        folder.open_run(manifest.runs[0])
    # It can be restored: no folder was made.
    assert not folder.run_path(manifest.runs[0].name).exists()


def test_a_link_to_a_run_that_cannot_be_read_is_removed(
    folder: StudyFolder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    made = tmp_path / "made"
    shutil.move(folder.run_path(NAME), made)

    def fail(path: Path) -> None:
        raise OSError(f"the disk of {path} is gone")

    monkeypatch.setattr(study_folder, "read_json", fail)
    with pytest.raises(OSError, match="is gone"):
        folder.adopt(folder.manifest(), made)
    assert not os.path.lexists(folder.run_path(NAME))


def test_a_result_that_was_edited_or_exchanged_is_refused(folder: StudyFolder):
    (file,) = folder.result_path(NAME).glob("evaluation_*.json")
    content = json.loads(file.read_text())
    content["success"]["mean"] = 0.99
    before = file.read_bytes()
    file.write_text(json.dumps(content))
    with pytest.raises(ValueError, match="is damaged or was edited"):
        table(folder)
    file.write_bytes(before)
    policies = folder.run_path(NAME) / "policies"
    (policy,) = (folder.result_path(NAME) / "policies").iterdir()
    shutil.copy(policies / "000000000000.safetensors", policy)
    with pytest.raises(ValueError, match="does not belong to the policy"):
        table(folder)
    content, _ = read_sealed(file)
    file.write_bytes(sealed_json({**content, "frames": BATCH}))
    with pytest.raises(ValueError, match="a policy of 256 frames, expected 512"):
        table(folder)


def test_a_hash_of_a_policy_is_of_what_it_is_and_not_of_its_file(
    folder: StudyFolder, tmp_path: Path
):
    (path,) = (folder.result_path(NAME) / "policies").iterdir()
    tensors, header = load_tensors(path)
    spec = header["policy"]

    def changed(**fields: object) -> str:
        other = {**header, "policy": {**spec, **fields}, "made": "elsewhere"}
        save_tensors(tmp_path / "other.safetensors", tensors, other)
        return policy_hash(tmp_path / "other.safetensors")

    skin = {**spec["skin"], "sensors": spec["skin"]["sensors"][1:]}
    hashes = [changed(), changed(frames=BATCH), changed(skin=skin)]
    assert hashes[0] == policy_hash(path)
    # The same weights, trained for less or with other sensors.
    assert len(set(hashes)) == 3


def test_of_a_long_run_some_250_lines_of_metrics_are_stored(folder: StudyFolder):
    (file,) = folder.result_path(NAME).glob("evaluation_*.json")
    content, _ = read_sealed(file)
    shutil.rmtree(folder.result_path(NAME))
    run = Run.open(folder.run_path(NAME))
    run.checkpoint_path.unlink()
    # A line for each frame.
    rows = [f"{frames},{frames / 1000}" for frames in range(1, 2 * BATCH + 1)]
    text = "\n".join(["frames,time/wall_s", *rows]) + "\n"
    (run.path / "metrics.csv").write_text(text)
    folder.finish(folder.manifest().run(NAME), content)
    _, *kept = (folder.result_path(NAME) / "metrics.csv").read_text().splitlines()
    assert 200 < len(kept) < 300
    assert kept[-1] == "512,0.512"


def test_a_policy_is_judged_with_and_without_its_skin():
    # With random weights it soon falls, one way or another.
    policy, plan = make_policy(EnvConfig()), EvaluationPlan(episodes=8)
    result = evaluation.evaluate_policy(policy, plan)
    config = standard_task(policy.env_config, plan.standard)
    which = {"throw_set": plan.throw_set, "episodes": plan.episodes}
    seen, masked = (
        dataclasses.asdict(evaluate(policy, config, policy.skin, mask=mask, **which))
        for mask in ((), MASK_ALL)
    )
    assert {name: result[name] for name in seen} == seen
    assert result["masked"] == masked
    assert seen != masked


# --- progress -----------------------------------------------------------------------


def test_status_tells_failures_and_what_is_left(folder: StudyFolder):
    more = dataclasses.replace(SHORT, seeds=(0, 1, 2))
    manifest = folder.plan(resolve(more))
    log = folder.log_path("blind-seed1")
    log.parent.mkdir()
    log.write_text("--- started\nerror: old\n--- started\nTraceback\nKeyError: 'x'\n")
    assert folder.last_error("blind-seed1") == "KeyError: 'x'"
    for tries in (1, 2):
        failure = folder.note_failure("blind-seed1", folder.last_error("blind-seed1"))
        assert failure == Failure(tries=tries, error="KeyError: 'x'")
    status = folder.status(manifest.runs)
    assert [s.state for s in status] == ["done", "failed", "missing"]
    assert status[1].failure == failure
    progress = Progress.of(status)
    assert str(progress) == "1 done, 1 failed, 1 missing; 33.3% of the frames, ETA -"
    # The time left is that of the runs that are still tried.
    (planned,) = (s.run for s in status[2:])
    half = planned.end // 2
    running = RunStatus(run=planned, state="running", frames=half, per_s=float(half))
    assert Progress.of([*status[:2], running]).left_s == pytest.approx(3)
    assert Progress.of([*status[:2], running], tries=2).left_s == pytest.approx(1)
    folder.forget_failures(manifest.runs[:1])
    assert folder.status(manifest.runs)[1].state == "failed"
    folder.forget_failures(manifest.runs)
    assert folder.status(manifest.runs)[1].state == "missing"


def test_the_last_error_of_a_worker_has_its_reason(folder: StudyFolder):
    path = folder.log_path(NAME)
    path.parent.mkdir(exist_ok=True)
    path.write_text(
        "--- started\nerror: worker 0 of 1 raised\nTraceback\n  line 1\nValueError: x\n"
    )
    assert folder.last_error(NAME) == "worker 0 of 1 raised: ValueError: x"
    path.write_text("--- started\nnote\nerror: the disk is full\n")
    assert folder.last_error(NAME) == "the disk is full"
    assert how_it_ended(folder, NAME, 1) == "the disk is full"
    assert how_it_ended(folder, NAME, -signal.SIGKILL) == "killed by SIGKILL"


def test_a_failure_stays_on_a_terminal(monkeypatch: pytest.MonkeyPatch, capsys):
    monkeypatch.setenv("TERM", "xterm")
    for live, text in (
        (True, "\rprogress\x1b[K\rfailed\x1b[K\n"),
        (False, "progress\nfailed\n"),
    ):
        monkeypatch.setattr(sys.stdout, "isatty", lambda live=live: live)
        show("progress", False)
        show("failed", True)
        assert capsys.readouterr().out == text


def test_status_says_where_a_run_is_running(folder: StudyFolder, capsys):
    shutil.rmtree(folder.result_path(NAME))
    manifest = folder.manifest()
    with claimed(folder.claims, NAME):
        print_status(folder, manifest, folder.status(manifest.runs))
    where = f"{NAME}: running on {socket.gethostname()}, process {os.getpid()}\n"
    assert where in capsys.readouterr().out
    print_status(folder, manifest, folder.status(manifest.runs))
    assert "running on" not in capsys.readouterr().out


def test_a_job_that_is_dead_is_not_said_to_run(folder: StudyFolder, capsys):
    shutil.rmtree(folder.result_path(NAME))
    manifest = folder.manifest()
    with claimed(folder.claims, NAME):
        (owner,) = folder.claims.glob("*.owner.*")
        content = owner.read_text()
    # It was killed, and its run is trained by hand.
    owner.write_text(content)
    with Run.open(folder.run_path(NAME)).locked():
        print_status(folder, manifest, folder.status(manifest.runs))
    assert f"{NAME}: running outside the study\n" in capsys.readouterr().out


def test_a_failure_that_is_forgotten_meanwhile_is_none(folder: StudyFolder):
    # Another runner's job finishes the run while this one reads.
    folder.note_failure(NAME, "error")
    (path,) = folder.path.glob("failed/*.json")
    path.unlink()
    assert folder.failure(NAME) is None
    folder.forget_failures(folder.manifest().runs)


def test_a_study_costs_whole_runs_on_whole_cores(tiny: Manifest):
    total = cost(tiny, per_s=1000)
    # 4 runs of 3.072 s each: on three cores the fourth has to wait.
    assert (total.runs, total.frames) == (4, 4 * 12 * BATCH)
    assert total.core_s == pytest.approx(12.288)
    assert total.wall_s(3) == pytest.approx(2 * 3.072)
    assert total.wall_s(64) == pytest.approx(3.072)


def test_only_numbers_of_cores_that_all_cells_can_use_are_measured(
    monkeypatch: pytest.MonkeyPatch,
):
    monkeypatch.setattr(cost_module, "measure", lambda run, *numbers: numbers)
    cells = ({"num_envs": 16}, {"num_envs": 6})
    manifest = resolve(dataclasses.replace(SHORT, cells=cells))
    assert measure_all(manifest, manifest.runs[0], 4) == [(1, 4), (2, 2)]


def test_a_long_study_with_fewer_runs_than_cores_uses_them_all():
    total = Cost(runs=3, frames=60_000_000, per_s=1000, disk=0.0)
    # On 16 cores each run has 4, on 2 cores the third has to wait.
    assert total.wall_s(16) == pytest.approx(20_000 / 4)
    assert total.wall_s(2) == pytest.approx(2 * 20_000)
    short = dataclasses.replace(total, frames=30_000_000)
    assert short.wall_s(16) == pytest.approx(10_000)


LONG = dataclasses.replace(STUDY, frames=65_536_000, seeds=(0,))
"""A study that is long enough to be measured."""


def speeds(cores: int) -> list[Speed]:
    """Speeds on a machine where a run hardly gains from more cores than eight."""
    per_s = {1: 160e3, 2: 158e3, 4: 155e3, 8: 120e3, 16: 80e3}
    return [
        Speed(cores_per_run=n, parallel=cores // n, per_s=x) for n, x in per_s.items()
    ]


@pytest.mark.parametrize(("runs", "cores"), [(16, 1), (8, 2), (4, 4), (3, 8), (1, 16)])
def test_runs_that_are_fewer_than_the_cores_have_several_each(
    runs: int, cores: int, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
):
    monkeypatch.setattr(command, "available_cores", lambda: 16)
    monkeypatch.setattr(command, "measure_all", lambda *args: speeds(args[2]))
    cells, seeds = STUDY.cells[:1], tuple(range(runs))
    manifest = resolve(dataclasses.replace(LONG, cells=cells, seeds=seeds))
    status = [RunStatus(run=run, state="missing") for run in manifest.runs]
    assert RunStudy(dir=tmp_path)._cores_per_run(manifest, status) == cores


def test_a_run_that_cannot_be_measured_is_told_and_another_is(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys
):
    manifest = resolve(dataclasses.replace(LONG, seeds=(0, 1)))
    one, other = (cell.name for cell in manifest.cells)
    tried = []

    def measure_all(manifest: Manifest, run: PlannedRun, cores: int) -> list[Speed]:
        tried.append(run.name)
        if run.cell.name in broken:
            raise ValueError("no skin")
        return speeds(cores)

    monkeypatch.setattr(command, "available_cores", lambda: 16)
    monkeypatch.setattr(command, "measure_all", measure_all)
    run = RunStudy(dir=tmp_path)
    status = [RunStatus(run=run, state="missing") for run in manifest.runs]
    broken = {one}
    assert run._cores_per_run(manifest, status) == 4
    assert tried == [f"{one}-seed0", f"{other}-seed0"]
    note = f"note: {one}-seed0 cannot be measured: no skin\n"
    assert capsys.readouterr().err == note
    broken = {one, other}
    assert run._cores_per_run(manifest, status) == 1
    # A run that has used up its tries is not measured.
    tried.clear()
    lost = Failure(tries=3, error="no skin")
    failed = [
        dataclasses.replace(s, state="failed", failure=lost)
        if s.run.cell.name == one
        else s
        for s in status
    ]
    run._cores_per_run(manifest, failed)
    assert tried == [f"{other}-seed0"]
    assert run._cores_per_run(manifest, failed[::2]) == 1
    assert tried == [f"{other}-seed0"]


MEASURING = """
import os, sys, time
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace

@dataclass
class Config:
    num_workers: int = 1
    learner_threads: int = 1

def wait(*args):
    Path(sys.argv[2], str(os.getpid())).touch()
    time.sleep(600)

if __name__ == sys.argv[1]:
    wait()
if __name__ == "__main__":
    from egoskin.commands.errors import clear_errors
    from egoskin.study import cost

    cost._train = wait
    with clear_errors():
        cell = SimpleNamespace(name="x")
        cost.measure(SimpleNamespace(cell=cell, config=Config()), parallel=2)
"""


@pytest.mark.parametrize(
    ("number", "where"),
    [
        # While the processes import, and while they train.
        (signal.SIGINT, "__mp_main__"),
        (signal.SIGKILL, ""),
    ],
)
def test_a_measurement_that_is_ended_leaves_nothing(number, where, tmp_path: Path):
    script, temporary, begun = (tmp_path / x for x in ("m.py", "tmp", "begun"))
    script.write_text(MEASURING)
    temporary.mkdir()
    begun.mkdir()
    with subprocess.Popen(
        [sys.executable, str(script), where, str(begun)],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        env={**os.environ, "TMPDIR": str(temporary)},
    ) as process:
        try:
            wait_for(lambda: len(list(begun.iterdir())) == 2)
            # Ctrl-C reaches the whole group.
            (os.killpg if number == signal.SIGINT else os.kill)(process.pid, number)
            # A child that lives keeps the pipe open.
            _, errors = process.communicate(timeout=60)
        finally:
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
    killed = number == signal.SIGKILL
    assert process.returncode == (-number if killed else 128 + number)
    # Python itself tells of the semaphores of a process that is killed.
    assert killed or errors == "stopped\n"
    assert not list(temporary.iterdir())


@pytest.mark.slow
def test_the_speed_is_measured_and_nothing_is_left(
    tiny: Manifest, monkeypatch, tmp_path
):
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    speed = measure(tiny.runs[1], 2)
    assert 10 < speed.per_s < 1e6
    assert str(speed).startswith("1 run side by side on 2 cores each: ")
    assert not list(tmp_path.glob("egoskin-*"))


def test_the_slurm_script_shares_the_folder_among_its_elements():
    manifest = resolve(SHORT)
    text = slurm_script(manifest, Path("/a/b"), cores=8, elements=3, hours=1.5)
    assert text.startswith("#!/bin/bash\n")
    assert "until `status` shows that all runs are done" in text
    lines = ("--array=0-2", "--cpus-per-task=8", "--mem-per-cpu=3G", "--time=90")
    for line in (*lines, "--signal=B:TERM@"):
        assert f"#SBATCH {line}" in text
    assert '--dir /a/b --parallel "$SLURM_CPUS_PER_TASK"' in text
    text = slurm_script(manifest, Path("/a/b c"), cores=8, elements=3, hours=1.5)
    command = f"exec {shlex.quote(sys.executable)} -m egoskin study run"
    assert f"{command} --dir '/a/b c' --parallel" in text
    assert "#SBATCH --output='/a/b c/logs/slurm-%A-%a.log'" in text


# --- the runner, with real faults ---------------------------------------------------


class Asked(LocalRunner):
    """A runner that raises InterruptedError when it would start a run."""

    def _begin(self, run: PlannedRun) -> None:
        raise InterruptedError(run.name)


def test_no_process_is_begun_for_a_run_that_ppo_trains(folder: StudyFolder):
    shutil.rmtree(folder.result_path(NAME))
    runner = Asked(folder, parallel=1)
    (planned,) = folder.manifest().runs
    with Run.open(folder.run_path(NAME)).locked():
        # A job would only spend seconds on imports and then leave the run alone.
        runner._start([planned])
    with pytest.raises(InterruptedError, match=NAME):
        Asked(folder, parallel=1)._start([planned])


def test_cores_that_do_not_divide_the_agents_are_refused_before_a_run_starts(
    folder: StudyFolder,
):
    text = "--cores-per-run 3 must divide num_envs of every cell; that of blind is 16"
    with pytest.raises(ValueError, match=text):
        LocalRunner(folder, cores_per_run=3)


def test_only_the_chosen_runs_are_executed(folder: StudyFolder):
    manifest = folder.plan(resolve(dataclasses.replace(SHORT, seeds=(0, 1, 2))))
    # The run with seed 0 is finished; the others are not begun.
    runs = manifest.matching(["*-seed0"])
    (status,) = Asked(folder, runs=runs).run()
    assert (status.run.name, status.state) == (NAME, "done")
    with pytest.raises(InterruptedError, match="blind-seed2"):
        Asked(folder, runs=manifest.matching(["*-seed[02]"])).run()


class Scripted(LocalRunner):
    """A runner whose runs end at once, with these exit statuses in turn."""

    def __init__(self, folder: StudyFolder, *statuses: int, **options) -> None:
        super().__init__(folder, **options)
        self.statuses, self.now = list(statuses), []
        self.begun: list[tuple[str, ...]] = []

    def _running(self) -> list[str]:
        return self.now

    def _begin(self, run: PlannedRun) -> None:
        self.now.append(run.name)
        self.begun.append(tuple(self.now))

    def _ended(self) -> dict[str, tuple[int, str]]:
        ended, self.now = self.now, []
        return {name: (self.statuses.pop(0), "error") for name in ended}


@pytest.fixture
def at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Runners that do not wait."""
    for name in ("_POLL", "_LOOK"):
        monkeypatch.setattr(f"egoskin.study.runner.{name}", 0.0)


@pytest.mark.usefixtures("at_once")
def test_a_run_that_stops_or_is_claimed_by_others_has_not_failed(folder: StudyFolder):
    shutil.rmtree(folder.result_path(NAME))
    # Somebody sends its process a SIGTERM, or starts another runner.
    runner = Scripted(folder, STOPPED, CLAIMED, job.FAILED, tries=1)
    (status,) = runner.run()
    assert runner.begun == [(NAME,)] * 3
    assert status.failure == Failure(tries=1, error="error")


@pytest.mark.usefixtures("at_once")
def test_no_more_runs_are_executed_at_once_than_is_asked(folder: StudyFolder):
    folder.plan(resolve(dataclasses.replace(SHORT, seeds=(0, 1, 2, 3))))
    runner = Scripted(folder, *[job.FAILED] * 3, parallel=2, tries=1)
    status = runner.run()
    assert [each.state for each in status] == ["done", "failed", "failed", "failed"]
    one, two, three = (f"blind-seed{seed}" for seed in (1, 2, 3))
    assert runner.begun == [(one,), (one, two), (three,)]


def test_a_run_that_does_not_stop_is_killed_with_its_workers():
    script = "trap '' TERM; sleep 60 & echo started; wait"
    with subprocess.Popen(
        ["sh", "-c", script], stdout=subprocess.PIPE, start_new_session=True
    ) as process:
        assert process.stdout is not None
        process.stdout.readline()
        process.terminate()
        end_job(process, 0.1)
        assert process.returncode == -signal.SIGKILL
        # A worker that lives keeps the pipe open.
        assert select.select([process.stdout], [], [], 10)[0]


def test_a_run_whose_runner_has_ended_stops(monkeypatch: pytest.MonkeyPatch):
    # pytest keeps its signal handlers.
    monkeypatch.setattr(job, "take", lambda *args: None)
    monkeypatch.setattr(job, "_LOOK", 0.01)
    stop = Stop(parent=os.getppid())
    time.sleep(0.05)
    assert not stop.requested
    # The system gives it to another process.
    monkeypatch.setattr(os, "getppid", lambda: 1)
    wait_for(lambda: stop.requested, seconds=10)


class Waiting(Asked):
    """A runner whose only run takes a second."""

    def __init__(self, folder: StudyFolder) -> None:
        super().__init__(folder)
        self._until = time.monotonic() + 1

    def _running(self) -> list[str]:
        return [NAME] if time.monotonic() < self._until else []

    def _ended(self) -> dict[str, tuple[int, str]]:
        return {} if self._running() else {NAME: (0, "")}


def test_a_runner_that_waits_leaves_the_file_system_alone(
    folder: StudyFolder, monkeypatch: pytest.MonkeyPatch
):
    manifest = folder.plan(resolve(dataclasses.replace(SHORT, seeds=(0, 1))))
    other, looks = manifest.runs[1].name, []
    failure = folder.failure

    def noted(name: str) -> Failure | None:
        looks.append(name)
        return failure(name)

    folder.note_failure(other, "error")
    monkeypatch.setattr(folder, "failure", noted)
    runner = Waiting(folder)
    runner._tries = 1
    began = time.monotonic()
    status = runner.run()
    # The progress line and the final status read it once each, as do the first look
    # and the one after the end of the run.
    assert looks == [other] * 4
    assert [each.state for each in status] == ["done", "failed"]
    assert time.monotonic() - began < 3


class Runner:
    """`egoskin study run` in a separate process."""

    def __init__(self, folder: Path, *args: str, **options) -> None:
        self.log = folder.with_name(f"{folder.name}-{time.monotonic_ns()}.log")
        script = [sys.executable, "-m", "egoskin", "study", "run"]
        with open(self.log, "w") as output:
            self.process = subprocess.Popen(
                [*script, "--dir", str(folder), "--parallel", "2", *args],
                stdout=output,
                stderr=subprocess.STDOUT,
                start_new_session=True,
                **options,
            )

    def text(self) -> str:
        return self.log.read_text()

    def end(self) -> int:
        return self.process.wait(900)


@pytest.fixture
def start() -> Iterator[Callable[..., Runner]]:
    """Starts runners that end with the test."""
    started: list[Runner] = []

    def begin(*args, **options) -> Runner:
        started.append(Runner(*args, **options))
        return started[-1]

    yield begin
    for runner in started:
        if runner.process.poll() is None:
            runner.process.terminate()
            runner.process.wait(200)


@pytest.fixture(scope="module")
def tiny() -> Manifest:
    return resolve(STUDY)


@pytest.fixture
def study(tiny: Manifest, tmp_path: Path) -> StudyFolder:
    folder = StudyFolder(tmp_path / "study")
    folder.plan(tiny)
    return folder


@pytest.fixture(scope="module")
def undisturbed(tiny: Manifest, tmp_path_factory) -> list[dict[str, str]]:
    """The table of a study that ran without faults."""
    folder = StudyFolder(tmp_path_factory.mktemp("undisturbed") / "study")
    folder.plan(tiny)
    runner = Runner(folder.path)
    assert runner.end() == 0, runner.text()
    rows = table(folder)
    assert len({row["policy_sha256"] for row in rows}) == len(rows) == len(tiny.runs)
    return rows


def in_the_middle(folder: StudyFolder) -> list[str]:
    """Return the runs that are between a quarter and the end of their frames."""
    status = folder.status(folder.manifest().runs)
    return [s.run.name for s in status if 3 * BATCH < s.frames < s.run.end]


def jobs(folder: StudyFolder) -> dict[str, int]:
    """Return the process ids of the jobs of a study, by the name of the run."""
    found = {}
    for path in Path("/proc").glob("[0-9]*"):
        try:
            command = (path / "cmdline").read_text().split("\0")
            state = (path / "stat").read_text().rpartition(")")[2].split()[0]
        except OSError:
            continue
        ours = "egoskin.study.job" in command and str(folder.path) in command
        if ours and state != "Z":
            found[command[command.index(str(folder.path)) + 1]] = int(path.name)
    return found


needs_proc = pytest.mark.skipif(
    not Path("/proc/self/maps").exists(), reason="looks for processes in /proc"
)


@pytest.mark.slow
@needs_proc
def test_a_runner_that_is_killed_ends_its_runs_and_is_started_again(
    study, start, undisturbed
):
    runner = start(study.path)
    wait_for(lambda: in_the_middle(study))
    assert jobs(study)
    runner.process.send_signal(signal.SIGKILL)
    runner.end()
    # Orphaned jobs notice it and stop with a checkpoint.
    wait_for(lambda: not jobs(study))
    before = study.status(study.manifest().runs)
    assert any(s.state == "stopped" and s.frames for s in before)
    again = start(study.path)
    assert again.end() == 0, again.text()
    assert table(study) == undisturbed


@pytest.mark.slow
@needs_proc
def test_a_run_that_is_killed_is_tried_again(study, start, undisturbed):
    runner = start(study.path)
    wait_for(lambda: set(in_the_middle(study)) & jobs(study).keys())
    name, pid = next(
        (n, p) for n, p in jobs(study).items() if n in in_the_middle(study)
    )
    os.kill(pid, signal.SIGKILL)
    assert runner.end() == 0, runner.text()
    assert f"{name} failed, try 1 of 3: killed by SIGKILL" in runner.text()
    assert table(study) == undisturbed
    assert not study.failure(name)


@pytest.mark.slow
@needs_proc
def test_two_runners_share_a_study(study, start, undisturbed):
    one, two = start(study.path), start(study.path)
    seen: dict[str, set[int]] = {}
    while None in (one.process.poll(), two.process.poll()):
        for name, pid in jobs(study).items():
            seen.setdefault(name, set()).add(pid)
        time.sleep(0.05)
    assert (one.end(), two.end()) == (0, 0), one.text() + two.text()
    assert table(study) == undisturbed
    # No run was trained twice: each was started once, by whoever claimed it.
    for run in study.manifest().runs:
        assert len(Run.open(study.run_path(run.name)).starts()) == 1


@pytest.mark.slow
@needs_proc
def test_ctrl_c_ends_all_runs_with_checkpoints(study, start, undisturbed):
    runner = start(study.path)
    wait_for(lambda: in_the_middle(study))
    runner.process.send_signal(signal.SIGINT)
    assert runner.end() == 130
    assert not jobs(study)
    assert "Traceback" not in runner.text()
    for status in study.status(study.manifest().runs):
        if status.state == "stopped" and status.frames:
            _, header = Run.open(study.run_path(status.run.name)).load_checkpoint()
            assert header["frames"] == status.frames
    again = start(study.path)
    assert again.end() == 0, again.text()
    assert table(study) == undisturbed


@pytest.mark.slow
def test_a_full_disk_is_told_and_what_was_missing_is_made_up_for(
    study, start, undisturbed
):
    # No checkpoint fits any more.
    full = start(study.path, "--tries", "1", preexec_fn=lambda: limit_file_size(50000))
    assert full.end() == 1
    for run in study.manifest().runs:
        failure = study.failure(run.name)
        assert failure is not None
        assert "File too large" in failure.error
        assert failure.error in full.text()
    # It is not tried again forever.
    assert start(study.path, "--tries", "1").end() == 1
    again = start(study.path, "--again")
    assert again.end() == 0, again.text()
    assert table(study) == undisturbed


# --- the command --------------------------------------------------------------------


def test_the_command_plans_tells_and_reports(finished: Path, tmp_path: Path):
    folder = shutil.copytree(finished, tmp_path / "study")
    mine = tmp_path / "mine.json"
    mine.write_text(json.dumps(to_plain(dataclasses.replace(SHORT, seeds=(0, 1)))))
    args = ("--dir", folder, "--steps-per-s", "1000")
    planned = succeed("study", "plan", mine, *args)
    assert "2 runs, 0.0 M frames" in planned
    assert "not the default: num_envs = 16" in planned
    assert succeed("study", "plan", *args) == planned
    ended = succeed("study", "run", "--dir", folder, "--only", "*-seed0")
    assert "1 done, 1 missing" in ended
    status = succeed("study", "status", folder)
    assert status.splitlines()[1].split()[:2] == ["blind", "done"]
    succeed("study", "report", folder)
    assert (folder / "report/index.html").is_file()
    assert "1 of 2 runs are done" in (folder / "report/report.md").read_text()
    array = succeed("study", "slurm", folder, "--cores", "2")
    assert "#SBATCH --array=0-0" in array


def test_the_command_tells_what_is_left_and_what_is_not_tried_again(
    folder: StudyFolder,
):
    folder.plan(resolve(dataclasses.replace(SHORT, seeds=(0, 1, 2))))
    args = ("--dir", folder.path)
    planned = succeed("study", "plan", *args, "--steps-per-s", "0.1")
    # Two runs of 512 steps.
    assert "\n  1 of these runs are done; left: 2 runs, 2.8 core-hours\n" in planned
    for _ in range(3):
        folder.note_failure("blind-seed1", "error")
    again = f"not tried again; to retry: egoskin study run --dir {folder.path} --again"
    ended = call("study", "run", *args, "--only", "blind-seed1")
    assert (ended.returncode, ended.stdout.splitlines()[-1]) == (1, again)
    assert again not in call("study", "run", *args, "--only", "blind-seed0").stdout


@pytest.mark.parametrize(
    ("args", "text"),
    [
        (("plan", "papr"), "no study 'papr' (valid: paper"),
        (("plan",), "a study or the --dir of an existing one is required"),
        (("run", "smoke", "--dir", "{0}/no/where"), "there is no folder {0}/no"),
        (
            ("run", "smoke", "--dir", "{0}/new", "--only", "blind-seed9"),
            "no run 'blind",
        ),
        (("plan", "smoke", "--dir", __file__), "test_study_runner.py is a file, not"),
        (
            ("run", "smoke", "--dir", "{0}/new", "--ray-address", "1.2.3.4:5"),
            "--ray-address has no effect without --on ray",
        ),
        (("plan", "smoke", "--dir", "{0}/no/where"), "there is no folder {0}/no"),
        (("status", "{0}"), "is not a study folder"),
        (("run", "--dir", "{0}"), "is not a study folder"),
        (("report", "{0}"), "is not a study folder"),
        (("adopt", "{0}", "{0}"), "is not a study folder"),
    ],
)
def test_bad_input_is_one_line(args, text, tmp_path: Path):
    done = call("study", *(a.format(tmp_path) for a in args))
    assert done.returncode == 2
    error = done.stderr
    assert text.format(tmp_path) in error
    assert len(error.splitlines()) == 1
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("package", "args", "error"),
    [
        (
            "matplotlib",
            ("report",),
            "a report needs matplotlib: `pip install 'egoskin[study]'`",
        ),
        (
            "ray",
            ("run", "--on", "ray", "--dir"),
            "--on ray needs ray: `pip install 'egoskin[ray]'`",
        ),
    ],
)
def test_a_package_that_is_missing_is_named(
    package, args, error, finished: Path, monkeypatch
):
    hide(package, monkeypatch)
    assert call("study", *args, finished).stderr == f"error: {error}\n"
    assert not (finished / "report").exists()
