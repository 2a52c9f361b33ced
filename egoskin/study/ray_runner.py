"""Execute the runs of a study on a Ray cluster, in a folder shared by all nodes.

Each run is a Ray task that reserves the run's cores, starts its job and waits for it.
Ray chooses the node. If a node is lost, Ray repeats the task on another one, where the
run resumes from its last checkpoint. Requires the extra `ray`.
"""

from __future__ import annotations

import logging
import signal
import socket
import time
from collections.abc import Collection
from pathlib import Path
from types import FrameType
from typing import Any

import ray  # pyright: ignore[reportMissingImports]
from ray.exceptions import RayError  # pyright: ignore[reportMissingImports]

from egoskin.parallel import own_settings
from egoskin.study.folder import StudyFolder
from egoskin.study.job import FAILED
from egoskin.study.manifest import PlannedRun
from egoskin.study.runner import (
    STOP_TIMEOUT_S,
    Runner,
    end_job,
    how_it_ended,
    start_job,
)

# Timeout for connecting to the address of a cluster [s].
_CONNECT_S = 10.0
# Intervals at which a task polls its job, and tasks are repeatedly cancelled [s].
_POLL_S, _TELL_S = 0.2, 2.0
# Time allowed for a task to report that its job has ended [s].
_ANSWER_S = 10.0
# Without this, a Ray worker that ends (as when the runner is killed) kills its job.
_LET_LIVE = {"RAY_kill_child_processes_on_worker_exit": "false"}


def connect(address: str) -> None:
    """Connect to an existing cluster.

    Args:
        address: Its address, ``host:port``, or "auto": the cluster of this machine.

    Raises:
        ValueError: If there is no cluster at the address.
    """
    handler = signal.getsignal(signal.SIGTERM)
    try:
        if address != "auto":
            host, _, port = address.rpartition(":")
            if not host or not port.isdecimal():
                raise ValueError("host:port, as in 10.0.0.1:6379")
            # Ray itself would keep trying for minutes.
            socket.create_connection((host, int(port)), _CONNECT_S).close()
        ray.init(
            address=address,
            log_to_driver=False,
            logging_level=logging.ERROR,
            # Nodes have egoskin installed: nothing is sent to them.
            runtime_env={"env_vars": {**own_settings(), **_LET_LIVE}},
        )
    except (OSError, ValueError, RuntimeError) as error:
        raise ValueError(
            f"no Ray cluster at {address!r} ({_lines(error)[0]}); start one with: "
            "ray start --head"
        ) from None
    finally:
        # Ray's handler would end this process with another exit status.
        signal.signal(signal.SIGTERM, handler)


class RayRunner(Runner):
    """Runner on the cluster that `connect` has connected to.

    Unless ``parallel`` limits them, Ray gets a task for every run that is left and
    starts as many as there are cores, also when the cluster grows or shrinks.

    Raises:
        ValueError: If no node has enough cores for a run.
    """

    def __init__(self, folder: StudyFolder, **options: Any) -> None:
        # Nodes have other working directories: the path must be absolute.
        super().__init__(StudyFolder(folder.path.resolve()), **options)
        nodes = [node["Resources"] for node in ray.nodes() if node["Alive"]]
        cores = sorted(int(resources.get("CPU", 0)) for resources in nodes)
        if self._cores > max(cores, default=0):
            raise ValueError(
                f"--cores-per-run {self._cores}: the nodes of the cluster have "
                f"{', '.join(map(str, cores))} cores, but a run must fit on one"
            )
        self._tasks: dict[str, ray.ObjectRef] = {}

    def _running(self) -> Collection[str]:
        return self._tasks

    def _begin(self, run: PlannedRun) -> None:
        # Ray itself counts the retries after lost nodes.
        work: Any = _work
        task = work.options(max_retries=self._tries, num_cpus=self._cores)
        path = str(self._folder.path)
        self._tasks[run.name] = task.remote(path, run.name, self._nice, self._cores)

    def _ended(self) -> dict[str, tuple[int, str]]:
        if not self._tasks:
            return {}
        names = {task: name for name, task in self._tasks.items()}
        found = {}
        for task in ray.wait(list(names), num_returns=len(names), timeout=0)[0]:
            name = names[task]
            del self._tasks[name]
            try:
                found[name] = ray.get(task)
            except RayError as error:
                found[name] = FAILED, _lines(error)[-1]
        return found

    def _stop(self) -> None:
        left = list(self._tasks.values())
        self._tasks.clear()
        deadline = time.monotonic() + STOP_TIMEOUT_S + _ANSWER_S
        while left and time.monotonic() < deadline:
            for task in left:
                # A task that waits for cores never starts. A worker that is still
                # importing may miss the request, so it is repeated.
                ray.cancel(task)
            _, left = ray.wait(left, num_returns=len(left), timeout=_TELL_S)


class _Cancel:
    """Context manager that notes whether Ray cancels the task of this worker.

    Ray sends no signal: it asks Python to call the handler of SIGINT. Python does so
    between two instructions, and thus never during an endless blocking system call.
    """

    def __init__(self) -> None:
        self.requested = False

    def __enter__(self) -> _Cancel:
        self._before = signal.signal(signal.SIGINT, self._note)
        return self

    def __exit__(self, *error: object) -> None:
        signal.signal(signal.SIGINT, self._before)

    def _note(self, number: int, frame: FrameType | None) -> None:
        self.requested = True


@ray.remote
def _work(path: str, name: str, nice: int, cores: int) -> tuple[int, str]:
    """Execute a run's job on this node; return (exit status, last error)."""
    folder = StudyFolder(Path(path))
    if not folder.manifest_path.is_file():
        node = ray.util.get_node_ip_address()
        return FAILED, f"node {node} has no access to {path}: share the folder"
    with _Cancel() as cancel:
        job = start_job(folder, name, nice, cores)
        try:
            while job.poll() is None and not cancel.requested:
                time.sleep(_POLL_S)
        finally:
            # The runner stops, or this worker has received SIGTERM.
            if job.poll() is None:
                job.terminate()
                end_job(job, STOP_TIMEOUT_S)
        return job.returncode, how_it_ended(folder, name, job.returncode)


def _lines(error: BaseException) -> list[str]:
    """Return the lines of an error's text, or its type if there is no text."""
    lines = [line.strip() for line in str(error).strip().splitlines()]
    return lines or [type(error).__name__]
