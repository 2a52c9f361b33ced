"""A study on a Ray cluster of two nodes, and faults done to it for real."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from typing import Any

import pytest
from test_study_runner import (
    in_the_middle,
    jobs,
    start,
    study,
    table,
    tiny,
    undisturbed,
    wait_for,
)

ray = pytest.importorskip("ray", reason="extra ray")
pytestmark = [
    pytest.mark.slow,
    # Of Ray, while it is imported.
    pytest.mark.filterwarnings("ignore"),
]
__all__ = ["start", "study", "tiny", "undisturbed"]


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


def test_a_node_that_is_lost_costs_no_run(cluster, study, start, undisturbed):
    runner = start(study.path, *on(cluster))
    wait_for(lambda: in_the_middle(study))
    cluster.remove_node(cluster.list_all_nodes()[-1], allow_graceful=False)
    assert runner.end() == 0, runner.text()
    # Ray says that it moved the task; nothing is counted as a failure of the run.
    assert "failed, try" not in runner.text()
    assert table(study) == undisturbed


def test_a_runner_that_is_killed_ends_its_tasks(cluster, study, start, undisturbed):
    runner = start(study.path, *on(cluster))
    wait_for(lambda: in_the_middle(study))
    runner.process.send_signal(signal.SIGKILL)
    runner.end()
    wait_for(lambda: not jobs(study))
    again = start(study.path, *on(cluster))
    assert again.end() == 0, again.text()
    assert table(study) == undisturbed


def test_ctrl_c_ends_all_tasks_with_checkpoints(cluster, study, start, undisturbed):
    runner = start(study.path, *on(cluster))
    wait_for(lambda: in_the_middle(study))
    runner.process.send_signal(signal.SIGINT)
    assert runner.end() == 130
    assert "Traceback" not in runner.text()
    wait_for(lambda: not jobs(study))
    assert any(s.state == "begun" for s in study.status(study.manifest()))
    again = start(study.path, *on(cluster))
    assert again.end() == 0, again.text()
    assert table(study) == undisturbed


def test_without_a_cluster_there_is_one_line(study, start):
    runner = start(study.path, "--on", "ray", "--ray-address", "127.0.0.1:1")
    assert runner.end() == 2
    (line,) = runner.text().splitlines()
    assert "no Ray cluster at '127.0.0.1:1'" in line
