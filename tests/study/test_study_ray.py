"""A study on a Ray cluster of two nodes, with real faults."""

from __future__ import annotations

import dataclasses
import os
import signal
import time
from collections.abc import Iterator
from typing import Any

import pytest
from test_study_runner import (
    BATCH,
    STUDY,
    in_the_middle,
    jobs,
    start,
    study,
    table,
    undisturbed,
)

from calling import wait_for
from egoskin.runs.run import Run
from egoskin.study.claims import is_locked
from egoskin.study.folder import StudyFolder
from egoskin.study.manifest import Manifest, resolve
from egoskin.study.runner import STOP_TIMEOUT_S

ray = pytest.importorskip("ray", reason="extra ray")
pytestmark = [
    pytest.mark.slow,
    # Ray's own warnings while it is imported.
    pytest.mark.filterwarnings("ignore"),
]
__all__ = ["start", "study", "undisturbed"]


@pytest.fixture(scope="module")
def tiny() -> Manifest:
    """A study of two runs that write checkpoints only when they are stopped."""
    base = {**STUDY.base, "checkpoint_interval": 3600.0}
    return resolve(dataclasses.replace(STUDY, seeds=(0,), frames=16 * BATCH, base=base))


@pytest.fixture
def cluster() -> Iterator[Any]:
    """A cluster of a head without cores and two nodes of one core."""
    from ray.cluster_utils import Cluster  # pyright: ignore[reportMissingImports]

    made = Cluster(initialize_head=True, head_node_args={"num_cpus": 0})
    for _ in range(2):
        made.add_node(num_cpus=1)
    made.wait_for_nodes()
    yield made
    made.shutdown()


def on(cluster: Any) -> tuple[str, ...]:
    return ("--on", "ray", "--ray-address", cluster.address)


def claimed_runs(folder: StudyFolder) -> list[str]:
    """Return the names of the runs that a process has claimed."""
    status = folder.status(folder.manifest().runs)
    return [s.run.name for s in status if s.state == "running"]


def kept(folder: StudyFolder) -> dict[str, int]:
    """Return the frames of the checkpoints of runs that have stopped, by name.

    No process works on them, and none of their training is lost.
    """
    assert not jobs(folder)
    stopped = {}
    for status in folder.status(folder.manifest().runs):
        path = folder.run_path(status.run.name)
        assert status.state in ("missing", "stopped", "done")
        assert not is_locked(path / "lock")
        if status.state == "stopped" and status.frames:
            _, header = Run.open(path).load_checkpoint()
            assert header["frames"] == status.frames
            stopped[status.run.name] = status.frames
    return stopped


def test_a_node_that_is_lost_costs_no_run(cluster, study, start, undisturbed):
    runner = start(study.path, *on(cluster))
    wait_for(lambda: in_the_middle(study))
    cluster.remove_node(cluster.list_all_nodes()[-1], allow_graceful=False)
    assert runner.end() == 0, runner.text()
    # Ray moves the task to another node; the run does not count as failed.
    assert "failed, try" not in runner.text()
    assert table(study) == undisturbed


def test_a_node_that_joins_later_is_used(cluster, study, start, undisturbed):
    cluster.remove_node(cluster.list_all_nodes()[-1])
    runner = start(study.path, *on(cluster))
    wait_for(lambda: len(claimed_runs(study)) == 1)
    (first,) = jobs(study).values()
    # Held, so that the first node is not free for the second run before the new one is.
    os.kill(first, signal.SIGSTOP)
    try:
        cluster.add_node(num_cpus=1)
        wait_for(lambda: len(claimed_runs(study)) == 2)
    finally:
        os.kill(first, signal.SIGCONT)
    assert runner.end() == 0, runner.text()
    assert table(study) == undisturbed


def test_a_runner_that_is_killed_ends_its_tasks(cluster, study, start, undisturbed):
    runner = start(study.path, *on(cluster))
    wait_for(lambda: in_the_middle(study))
    runner.process.send_signal(signal.SIGKILL)
    runner.end()
    # The locks of a process are freed by its last thread.
    wait_for(lambda: not (jobs(study) or claimed_runs(study)))
    assert kept(study)
    again = start(study.path, *on(cluster))
    assert again.end() == 0, again.text()
    assert table(study) == undisturbed


def test_ctrl_c_ends_all_tasks_with_checkpoints(cluster, study, start, undisturbed):
    runner = start(study.path, *on(cluster))
    wait_for(lambda: in_the_middle(study))
    runner.process.send_signal(signal.SIGINT)
    begin = time.monotonic()
    assert runner.end() == 130
    assert time.monotonic() - begin < STOP_TIMEOUT_S
    assert "Traceback" not in runner.text()
    before = kept(study)
    assert before
    # A batch system sends SIGTERM instead, here before anything has started.
    ended = start(study.path, *on(cluster))
    wait_for(ended.text)
    ended.process.send_signal(signal.SIGTERM)
    assert ended.end() == 143, ended.text()
    assert "Traceback" not in ended.text()
    after = kept(study)
    assert all(after.get(name, frames) >= frames for name, frames in before.items())
    again = start(study.path, *on(cluster))
    assert again.end() == 0, again.text()
    assert table(study) == undisturbed


def test_without_a_cluster_there_is_one_line(study, start):
    for address, text in (("127.0.0.1:1", "refused"), ("127.0.0.1", "host:port")):
        runner = start(study.path, "--on", "ray", "--ray-address", address)
        assert runner.end() == 2
        (line,) = runner.text().splitlines()
        assert f"no Ray cluster at '{address}'" in line
        assert text in line


def test_runs_that_fit_on_no_node_do_not_wait_for_one(cluster, study, start):
    runner = start(study.path, *on(cluster), "--cores-per-run", "2")
    assert runner.end() == 2
    (line,) = runner.text().splitlines()
    assert "--cores-per-run 2: the nodes of the cluster have 0, 1, 1 cores" in line
