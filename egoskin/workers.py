"""A TorchRL ParallelEnv whose parent sleeps while it waits, and says what failed.

TorchRL's parent polls shared flags in a busy loop, which takes a core away from the
physics; reports of a dead worker only that it is dead; and waits thousands of seconds
for one that hangs. Everything else is TorchRL's.
"""

from __future__ import annotations

import os
import shutil
import signal
import tempfile
import time
import traceback
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from multiprocessing import parent_process, set_forkserver_preload
from pathlib import Path

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase, ParallelEnv, Transform, TransformedEnv

# Shorter than a hundredth of any batched step, long enough to cost no CPU [s].
_POLL = 2e-4
# How often the health of the workers is looked at [s].
_HEALTH_CHECK = 0.2
# A worker that takes longer than this for one command hangs [s].
_HANG = 25.0


class WorkerError(RuntimeError):
    """A worker died, raised or hung; the text holds its own traceback or signal."""


def default_num_workers(num_envs: int, cores: int | None = None) -> int:
    """Return the largest divisor of the number of agents not above the cores.

    Args:
        num_envs: Number of agents.
        cores: Number of cores; those this process may use by default.
    """
    if cores is None:
        # macOS has no affinity.
        affinity = getattr(os, "sched_getaffinity", None)
        cores = len(affinity(0)) if affinity else os.cpu_count() or 1
    return max(n for n in range(1, cores + 1) if num_envs % n == 0)


class WorkerEnv(TransformedEnv):
    """A transformed env that writes the traceback of its own failure to a file.

    Args:
        env: The batched environment of this worker.
        transform: Its transforms.
        report: File for the traceback.
    """

    def __init__(self, env: EnvBase, transform: Transform, report: Path) -> None:
        super().__init__(env, transform)
        self._report = report

    def step_and_maybe_reset(
        self, tensordict: TensorDictBase
    ) -> tuple[TensorDictBase, TensorDictBase]:
        """Return TorchRL's (step, next root) pair."""
        with _reported(self._report):
            return super().step_and_maybe_reset(tensordict)

    def reset(
        self, tensordict: TensorDictBase | None = None, **kwargs: object
    ) -> TensorDictBase:
        """Return the reset tensordict."""
        with _reported(self._report):
            return super().reset(tensordict, **kwargs)


@contextmanager
def _reported(report: Path) -> Iterator[None]:
    try:
        yield
    except Exception:
        report.write_text(traceback.format_exc())
        raise


class _Build:
    """Builds the env of one worker; picklable for the worker's process."""

    def __init__(self, build: Callable[[], WorkerEnv | EnvBase], report: Path) -> None:
        self._build, self._report = build, report

    def __call__(self) -> WorkerEnv:
        if parent_process() is not None:
            # Ctrl-C reaches the whole group; when to end is the parent's decision.
            signal.signal(signal.SIGINT, signal.SIG_IGN)
        with _reported(self._report):
            env = self._build()
            assert isinstance(env, TransformedEnv)
            base, transform = env.base_env, env.transform.clone()
            return WorkerEnv(base, transform, self._report)


class WorkerPool(ParallelEnv):
    """A ParallelEnv of batched environments, one process each.

    Args:
        builders: What builds the transformed environment of each worker.
    """

    def __init__(self, builders: Sequence[Callable[[], EnvBase]]) -> None:
        self._reports = Path(tempfile.mkdtemp(prefix="egoskin-workers-"))
        threads = torch.get_num_threads()
        # Workers are forked from a clean server that has imported everything once:
        # no thread of this process is copied, and no import is paid for per worker.
        set_forkserver_preload(["egoskin.make"])
        super().__init__(
            len(builders),
            [_Build(b, self._report(i)) for i, b in enumerate(builders)],
            mp_start_method="forkserver",
        )
        # TorchRL lowers the parent's threads for good when the workers start.
        self.num_threads = threads

    def simulation_state(self) -> dict[str, Tensor]:
        """Return the state of all rows, in the order of the workers."""
        states = self._ask("simulation_state")
        return {k: torch.cat([s[k] for s in states]) for k in states[0]}

    def load_simulation_state(self, state: dict[str, Tensor]) -> None:
        """Give every worker the state of all rows; each takes its own."""
        self._ask("load_simulation_state", state)

    def _ask(self, method: str, *args: object) -> list:
        """Return what a method of every worker's environment answers."""
        if self.is_closed:
            self.start()
        for channel in self.parent_channels:
            channel.send((method, (args, {})))
        return [channel.recv()[1] for channel in self.parent_channels]

    def _report(self, worker: int) -> Path:
        return self._reports / f"worker-{worker}.txt"

    def _wait_for_workers(self, workers_range: Iterable[int]) -> None:
        """Sleep until the workers have set their flags; raise if one cannot."""
        pending = [self._worker_indices[i] for i in workers_range]
        waited, flags = list(pending), self._shm_done_flags
        start = last_check = time.monotonic()
        while True:
            pending = [i for i in pending if not flags[i]]
            if not pending:
                break
            now = time.monotonic()
            if now - last_check > _HEALTH_CHECK:
                last_check = now
                for worker in pending:
                    if not self._workers[worker].is_alive() and not flags[worker]:
                        self._fail(worker, self._death(worker))
                    if now - start > _HANG:
                        self._fail(worker, f"hung: no answer within {_HANG:.0f} s")
            time.sleep(_POLL)
        for worker in waited:
            flags[worker] = 0

    def _death(self, worker: int) -> str:
        report = self._report(worker)
        if report.exists():
            return f"raised\n{report.read_text()}"
        code = self._workers[worker].exitcode
        if code is not None and code < 0:
            return f"was killed by {signal.Signals(-code).name}"
        return f"ended with exit status {code}"

    def _fail(self, worker: int, reason: str) -> None:
        """End all workers and raise."""
        for process in self._workers:
            process.kill()
        for process in self._workers:
            process.join()
        for channel in self.parent_channels:
            channel.close()
        # Nothing is left to close; TorchRL would wait for answers that never come.
        self.is_closed = True
        shutil.rmtree(self._reports, ignore_errors=True)
        raise WorkerError(f"worker {worker} of {self.num_workers} {reason}")

    def close(self, *, raise_if_closed: bool = False) -> None:
        """End the workers; closing twice is allowed."""
        if not self.is_closed:
            super().close(raise_if_closed=raise_if_closed)
        shutil.rmtree(self._reports, ignore_errors=True)
