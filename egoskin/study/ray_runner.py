"""The runs of a study on a Ray cluster, their files in a folder that all nodes see.

Each run is a Ray task on its cores, which starts the run's job and waits for it. Ray
chooses the node, and runs the task again on another one if its node is lost: the run
goes on from its last checkpoint. (Extra `ray`.)
"""

from __future__ import annotations

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
from egoskin.study.job import FAILED
from egoskin.study.manifest import PlannedRun
from egoskin.study.runner import (
    PATIENCE_S,
    Runner,
    end_job,
    how_it_ended,
    start_job,
)
from egoskin.study.store import StudyFolder

# How long the address of a cluster is tried [s].
_CONNECT_S = 10.0
# How often a task looks at its job, and a task that is to stop is told so [s].
_POLL_S, _TELL_S = 0.2, 2.0
# How long a task may take to say that its job has ended [s].
_ANSWER_S = 10.0
# Otherwise a worker that ends, as when the runner is killed, kills its job.
_LET_LIVE = {"RAY_kill_child_processes_on_worker_exit": "false"}


def connect(address: str) -> int:
    """Connect to an existing cluster; return its number of cores.

    Args:
        address: Its address, ``host:port``, or "auto": the one of this machine.

    Raises:
        ValueError: If there is none.
    """
    handler = signal.getsignal(signal.SIGTERM)
    try:
        if address != "auto":
            host, _, port = address.rpartition(":")
            if not host or not port.isdecimal():
                raise ValueError("host:port, as in 10.0.0.1:6379")
            # Ray would ask for minutes.
            socket.create_connection((host, int(port)), _CONNECT_S).close()
        ray.init(
            address=address,
            log_to_driver=False,
            logging_level="ERROR",
            # Nodes have egoskin installed: nothing is sent to them.
            runtime_env={"env_vars": {**own_settings(), **_LET_LIVE}},
        )
    except (OSError, ValueError, RuntimeError) as error:
        raise ValueError(
            f"no Ray cluster at {address!r} ({_lines(error)[0]}); begin one with: "
            "ray start --head"
        ) from None
    finally:
        # Ray's own would end this process with another status.
        signal.signal(signal.SIGTERM, handler)
    return int(ray.cluster_resources().get("CPU", 1))


class RayRunner(Runner):
    """Works on the cluster that `connect` has connected to.

    Raises:
        ValueError: If no node has the cores that each run is to have.
    """

    def __init__(self, folder: StudyFolder, **options: Any) -> None:
        # Nodes have other working folders.
        super().__init__(StudyFolder(folder.path.resolve()), **options)
        cores = [int(n["Resources"].get("CPU", 0)) for n in ray.nodes() if n["Alive"]]
        if self._cores > max(cores, default=0):
            raise ValueError(
                f"--cores-per-run {self._cores}: the nodes of the cluster have "
                f"{', '.join(map(str, cores))} cores, and a run needs one node"
            )
        self._tasks: dict[str, ray.ObjectRef] = {}

    def _running(self) -> Collection[str]:
        return self._tasks

    def _begin(self, run: PlannedRun) -> None:
        # Of a task whose node is lost Ray keeps the count.
        work: Any = _work
        task = work.options(max_retries=self._tries, num_cpus=self._cores)
        path = str(self._folder.path)
        self._tasks[run.name] = task.remote(path, run.name, self._nice, self._cores)

    def _ended(self) -> dict[str, tuple[int, str]]:
        found = {}
        for name, task in list(self._tasks.items()):
            if ray.wait([task], timeout=0)[0]:
                del self._tasks[name]
                try:
                    found[name] = ray.get(task)
                except RayError as error:
                    found[name] = FAILED, _lines(error)[-1]
        return found

    def _stop(self) -> None:
        left = list(self._tasks.values())
        self._tasks.clear()
        deadline = time.monotonic() + PATIENCE_S + _ANSWER_S
        while left and time.monotonic() < deadline:
            for task in left:
                # One that waits for a core never begins. A worker that still imports
                # may miss it.
                ray.cancel(task)
            _, left = ray.wait(left, num_returns=len(left), timeout=_TELL_S)


class _Cancel:
    """Whether Ray cancels the task that this worker runs, while it is entered.

    Ray sends no signal: it asks Python to call the handler of SIGINT, which Python does
    between two instructions, and so never while it waits in the system without end.
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
    """Return (exit status, last error) of a run's job, which runs on this node."""
    folder = StudyFolder(Path(path))
    if not folder.manifest_path.is_file():
        node = ray.util.get_node_ip_address()
        return FAILED, f"node {node} does not see {path}: all nodes need the folder"
    with _Cancel() as cancel:
        job = start_job(folder, name, nice, cores)
        try:
            while job.poll() is None and not cancel.requested:
                time.sleep(_POLL_S)
        finally:
            # The runner stops, or this worker has got a SIGTERM.
            if job.poll() is None:
                job.terminate()
                end_job(job, PATIENCE_S)
        return job.returncode, how_it_ended(folder, name, job.returncode)


def _lines(error: BaseException) -> list[str]:
    """Return the lines of an error's text, its type if it has none."""
    lines = [line.strip() for line in str(error).strip().splitlines()]
    return lines or [type(error).__name__]
