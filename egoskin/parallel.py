"""A TorchRL ParallelEnv whose parent sleeps while waiting and explains failures.

TorchRL's parent process polls shared flags in a busy loop, which takes a core away from
the physics. It reports a dead worker without the reason, and waits thousands of seconds
for a worker that hangs. Everything else is unchanged TorchRL.

Contract: no worker and no file of a pool outlives the parent, however the parent ends.
"""

from __future__ import annotations

import atexit
import ctypes
import functools
import os
import resource
import shutil
import signal
import subprocess
import tempfile
import time
import traceback
import weakref
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from multiprocessing import (
    active_children,
    current_process,
    forkserver,
    resource_tracker,
    set_forkserver_preload,
    util,
)
from multiprocessing.connection import wait
from multiprocessing.process import BaseProcess
from pathlib import Path
from threading import Event, Thread
from typing import Any, BinaryIO, NoReturn, TypeVar

import torch
import torchrl._utils
from tensordict import TensorDictBase
from torch import Tensor
from torchrl._utils import seed_generator
from torchrl.envs import EnvBase, ParallelEnv, Transform, TransformedEnv

from egoskin.cgroups import cpu_limit
from egoskin.interrupts import ENDING, end_with_parent
from egoskin.memory import is_out_of_memory

# Interval at which the parent polls a worker that copies its results [s].
_POLL = 2e-4
# Interval between checks that the workers are alive [s].
_CHECK_INTERVAL = 0.2
# A worker that does not answer for this long counts as hanging [s]. The limit is high
# because a worker that computes, compiles or waits for a core looks the same. Time is
# counted in checks, so suspension of all processes (SIGSTOP, sleep) does not count.
HANG_LIMIT = 600.0
# Time in which the server reports a death after the worker's channel closes [s].
_DEATH_NOTICE = 5.0


T = TypeVar("T")

# Exit status of a worker that would start workers itself, and the error message.
_UNGUARDED = 97
_GUARD = (
    "error: workers import the script that starts them, and this one would start them "
    'again: put its code into a function, called under `if __name__ == "__main__":`'
)
# Name of a socket in multiprocessing's folder, and the longest path of one [bytes].
_SOCKET, _LONGEST_SOCKET = "/listener-12345678", 107
# Files that a process with a pool has open, in total and for each worker: its pipes
# and, while a checkpoint is made, the tensors of its state in shared memory.
_FILES, _FILES_PER_WORKER = 128, 20
# Exit priority at which multiprocessing removes its folder; lower runs later.
_REMOVES_FOLDER = -100
# Workers to kill when this process ends.
_processes: weakref.WeakSet[BaseProcess] = weakref.WeakSet()

# Parameters of glibc mallopt, and a threshold that all versions accept [bytes].
_TRIM_THRESHOLD, _MMAP_THRESHOLD, _MMAP_MOST = -1, -3, 2**25


class WorkerError(RuntimeError):
    """A worker died, raised or hung; the text holds its traceback or signal."""


def available_cores() -> int:
    """Return the number of cores that this process may use."""
    # macOS has no affinity.
    affinity = getattr(os, "sched_getaffinity", None)
    cores = len(affinity(0)) if affinity else os.cpu_count() or 1
    limit = cpu_limit()
    return cores if limit is None else min(cores, max(int(limit), 1))


def default_num_workers(num_envs: int, cores: int | None = None) -> int:
    """Return the largest divisor of the number of agents not above the cores.

    Args:
        num_envs: Number of agents.
        cores: Number of cores; by default those that this process may use.
    """
    cores = available_cores() if cores is None else cores
    return max(n for n in range(1, cores + 1) if num_envs % n == 0)


def allow_open_files(num_workers: int) -> None:
    """Raise this process's soft limit of open files to what its workers need.

    It is often 1,024, which more than some 60 workers exceed.

    Raises:
        ValueError: If the hard limit is lower.
    """
    needed = _FILES + _FILES_PER_WORKER * num_workers
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if soft == resource.RLIM_INFINITY or needed <= soft:
        return
    if hard != resource.RLIM_INFINITY and needed > hard:
        raise ValueError(
            f"{num_workers} workers need up to {needed} open files, but the limit is "
            f"{hard}: raise it (ulimit -n), or use fewer workers (--num-workers)"
        )
    resource.setrlimit(resource.RLIMIT_NOFILE, (needed, hard))


def keep_freed_memory() -> None:
    """Make glibc's malloc keep freed memory, for this process.

    Every step and update allocates the same megabytes again; getting fresh pages from
    the system each time costs as much as the policy.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    # Other C libraries do not have this function.
    if mallopt is not None:
        mallopt(_TRIM_THRESHOLD, 2**31 - 1)
        if not mallopt(_MMAP_THRESHOLD, 2**30):
            mallopt(_MMAP_THRESHOLD, _MMAP_MOST)


class WorkerEnv(TransformedEnv):
    """A transformed environment that writes the traceback of a failure to a file.

    Args:
        env: The batched environment of this worker.
        transform: Its transforms.
        report: File for the traceback.
    """

    def __init__(self, env: EnvBase, transform: Transform, report: Path) -> None:
        super().__init__(env, transform)
        self._report = report
        # Number of calls in progress; a step resets rows.
        self._depth = 0
        self._bell: BinaryIO | None = None
        self._state: dict[str, Tensor] = {}

    def open_bell(self) -> None:
        """Write a byte to the pool's pipe at the end of each step and reset."""
        self._bell = _bell(self._report.parent).open("wb", buffering=0)

    def step(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Return TorchRL's result of a step."""
        with self._computing():
            return super().step(tensordict)

    def step_and_maybe_reset(
        self, tensordict: TensorDictBase
    ) -> tuple[TensorDictBase, TensorDictBase]:
        """Return TorchRL's (step, next root) pair."""
        with self._computing():
            return super().step_and_maybe_reset(tensordict)

    def reset(
        self, tensordict: TensorDictBase | None = None, **kwargs: object
    ) -> TensorDictBase:
        """Return the reset tensordict."""
        with self._computing():
            return super().reset(tensordict, **kwargs)

    @contextmanager
    def _computing(self) -> Iterator[None]:
        """Report a failure, or the end of the outermost call."""
        self._depth += 1
        with _reported(self._report):
            yield
        self._depth -= 1
        if not self._depth and self._bell is not None:
            self._bell.write(b".")

    def simulation_state(self) -> dict[str, Tensor]:
        """Return the base environment's state, in memory that the next call reuses.

        The memory is shared, so it is not copied on its way to the parent. New memory
        for every checkpoint would leave holes of some megabytes in the heap.
        """
        base: Any = self.base_env
        with _reported(self._report):
            state = base.simulation_state()
        for key, value in state.items():
            if key not in self._state:
                self._state[key] = torch.empty_like(value).share_memory_()
            self._state[key].copy_(value)
        return self._state

    def load_simulation_state(self, state: dict[str, Tensor]) -> None:
        """Load the state of all rows, of which this environment uses its own."""
        base: Any = self.base_env
        with _reported(self._report):
            base.load_simulation_state(state)


@contextmanager
def _reported(report: Path) -> Iterator[None]:
    try:
        yield
    except Exception as error:
        plain = is_out_of_memory(error)
        report.write_text(f"{error}" if plain else traceback.format_exc())
        raise


class _Build:
    """Builds the environment of one worker; picklable for the worker process."""

    def __init__(self, build: Callable[[], EnvBase], report: Path) -> None:
        self._build, self._report = build, report
        self._parent = os.getpid()
        # A worker inherits those of the server that forks it, which may be outdated.
        self._settings = own_settings()

    def __call__(self) -> WorkerEnv:
        # TorchRL also builds one in the parent, to read its specs.
        in_worker = os.getpid() != self._parent
        if in_worker:
            keep_freed_memory()
            for name in own_settings():
                del os.environ[name]
            os.environ.update(self._settings)
            end_with_parent()
            # A worker ends with its parent, not after 10,000 s without a command.
            torchrl._utils.BATCHED_PIPE_TIMEOUT = None
        with _reported(self._report):
            env = self._build()
            assert isinstance(env, TransformedEnv)
            base, transform = env.base_env, env.transform.clone()
            built = WorkerEnv(base, transform, self._report)
        if in_worker:
            built.open_bell()
            _ready(self._report).touch()
        return built


def own_settings() -> dict[str, str]:
    """Return the package's own environment variables."""
    return {k: v for k, v in os.environ.items() if k.startswith("EGOSKIN_")}


def start_server() -> None:
    """Start the server that forks the workers, if it does not run yet.

    The server imports all modules once, in the background. Workers are forked from it,
    so they copy no thread of this process and do not repeat the imports.
    """
    _check_guarded()
    _temporary_folder()
    set_forkserver_preload(["egoskin.preload"])
    # Ctrl-C, a batch system's SIGTERM and a closed terminal reach the whole process
    # group, but the parent decides when to end. The server and the workers inherit the
    # signal mask. The tracker starts first: its start unblocks the signals it ignores.
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGHUP})
    try:
        resource_tracker.ensure_running()
        signal.pthread_sigmask(signal.SIG_BLOCK, ENDING)
        forkserver.ensure_running()
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)


def _check_guarded() -> None:
    """End this process if it is a worker that would start workers on import."""
    # multiprocessing sets the attribute while it imports the parent's script.
    if hasattr(current_process(), "_inheriting"):
        os._exit(_UNGUARDED)


@functools.cache
def _temporary_folder() -> str:
    """Return a folder that is removed when this process ends, however it ends.

    It is the folder of multiprocessing, with the socket of the server that forks the
    workers. A killed process cannot remove it, so a shell waits on a pipe: it receives
    a line if multiprocessing has removed the folder. At end of file instead, the shell
    removes the folder, and the semaphores that multiprocessing's tracker has left.
    """
    folder = util.get_temp_dir()
    _check_socket_path(folder)
    # Prefix of the names of this process's semaphores in multiprocessing.
    name = Path(folder).name
    current_process()._config["semprefix"] = f"/{name}"
    script = """trap "" INT TERM HUP
        read -r line || { rm -rf -- "$0"; sleep 2; rm -f /dev/shm/sem."$1"-*; }"""
    shell = subprocess.Popen(
        ["/bin/sh", "-c", script, folder, name],
        stdin=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        # A SIGKILL may go to the whole process group.
        start_new_session=True,
    )
    # Runs after multiprocessing has removed the folder.
    after = _REMOVES_FOLDER - 1
    util.Finalize(None, shell.communicate, [b"\n"], exitpriority=after)
    # Runs before multiprocessing waits for the workers.
    atexit.register(_kill, _processes)
    return folder


def _check_socket_path(folder: str) -> None:
    """Raise ValueError if the path of a folder is too long for sockets in it."""
    excess = len(os.fsencode(folder + _SOCKET)) - _LONGEST_SOCKET
    if excess > 0:
        raise ValueError(
            f"the path of the folder for temporary files, {tempfile.gettempdir()}, is "
            f"{excess} bytes too long for sockets: set TMPDIR to a shorter one"
        )


def _kill(processes: Iterable[BaseProcess]) -> None:
    """Kill the processes that are still alive."""
    for process in processes:
        if process.is_alive():
            process.kill()


def _ready(report: Path) -> Path:
    """Return the marker file of a worker that has built its environment."""
    return report.with_suffix(".ready")


def _bell(reports: Path) -> Path:
    """Return the named pipe in which workers report the end of a computation."""
    return reports / "bell"


class WorkerPool(ParallelEnv):
    """A ParallelEnv of batched environments, one process each.

    Args:
        builders: Functions that build the transformed environment of each worker.
    """

    def __init__(self, builders: Sequence[Callable[[], EnvBase]]) -> None:
        _check_guarded()
        self._reports = Path(tempfile.mkdtemp(dir=_temporary_folder()))
        keep_freed_memory()
        threads = torch.get_num_threads()
        super().__init__(
            len(builders),
            [_Build(b, self._report(i)) for i, b in enumerate(builders)],
            mp_start_method="forkserver",
        )
        # TorchRL permanently lowers the parent's threads when the workers start.
        self.num_threads = threads

    def set_seed(
        self, seed: int | None = None, static_seed: bool = False
    ) -> int | None:
        """Set the seed of all workers; return TorchRL's next seed.

        All workers get the same one, as their rows already differ: the results do not
        depend on their number.
        """
        super().set_seed(seed, static_seed=True)
        return seed if static_seed or seed is None else seed_generator(seed)

    def simulation_state(self) -> dict[str, Tensor]:
        """Return the state of all rows, in the order of the workers."""
        states = self._ask("simulation_state")
        return {k: torch.cat([s[k] for s in states]) for k in states[0]}

    def load_simulation_state(self, state: dict[str, Tensor]) -> None:
        """Send the state of all rows to every worker, which loads its own rows."""
        self._ask("load_simulation_state", state)

    def step_and_maybe_reset(
        self, tensordict: TensorDictBase
    ) -> tuple[TensorDictBase, TensorDictBase]:
        """Return TorchRL's (step, next root) pair."""
        with self._death_explained():
            return super().step_and_maybe_reset(tensordict)

    def reset(
        self, tensordict: TensorDictBase | None = None, **kwargs: object
    ) -> TensorDictBase:
        """Return the reset tensordict."""
        with self._death_explained():
            return super().reset(tensordict, **kwargs)

    def _ask(self, method: str, *args: object) -> list:
        """Call a method of every worker's environment; return the results."""
        if self.is_closed:
            self.start()
        channels = self.parent_channels
        with self._death_explained():
            # Tensors are sent in shared memory, so a message never fills the channel.
            for channel in channels:
                channel.send((method, (args, {})))
            self._wait(
                range(len(channels)),
                lambda worker: channels[worker].poll(),
                lambda waiting: wait([channels[i] for i in waiting], _CHECK_INTERVAL),
            )
            return [channel.recv()[1] for channel in channels]

    def _report(self, worker: int) -> Path:
        return self._reports / f"worker-{worker}.txt"

    def _start_workers(self) -> None:
        """Start the workers; raise WorkerError if one cannot."""
        start_server()
        self._reports.mkdir(exist_ok=True)
        os.mkfifo(_bell(self._reports))
        # Also opened for writing, which does not wait for the workers.
        self._bell = _bell(self._reports).open("r+b", buffering=0)
        started = Event()
        self._workers, self._hung = [], set[int]()
        others = set(active_children())
        watch = Thread(target=self._watch_start, args=(started,), daemon=True)
        watch.start()
        try:
            super()._start_workers()
            _processes.update(self._workers)
        except BaseException as error:
            # Also on Ctrl-C: nothing else would end these workers.
            _kill(set(active_children()) - others)
            if not isinstance(error, (EOFError, ConnectionError)):
                raise
            raise WorkerError(
                "a worker, or the server that forks them, ended before it was given "
                "its environment"
            ) from None
        finally:
            started.set()
            watch.join()

    def _watch_start(self, started: Event) -> None:
        """Kill workers that hang during the start, while the parent blocks."""
        checks = 0
        while not started.wait(_CHECK_INTERVAL):
            checks += 1
            if checks * _CHECK_INTERVAL > HANG_LIMIT:
                for worker, process in enumerate(list(self._workers)):
                    if not _ready(self._report(worker)).exists():
                        self._hung.add(worker)
                        process.kill()

    def _cleanup_failed_worker_startup(self) -> None:
        """Raise WorkerError; TorchRL calls this if a worker ends during its start."""
        self._explain_death()

    def _wait_for_workers(self, workers_range: Iterable[int]) -> None:
        """Sleep until the workers have set their flags; raise if one fails."""
        workers, flags = list(workers_range), self._shm_done_flags
        computing = len(workers)

        def sleep(_: object) -> None:
            nonlocal computing
            if computing > 0:
                if wait([self._bell.fileno()], _CHECK_INTERVAL):
                    computing -= len(self._bell.read(computing))
            else:
                # All copy their results to shared memory and set their flags.
                time.sleep(_POLL)

        self._wait(workers, lambda worker: bool(flags[worker]), sleep)
        # Bytes of workers that had set their flags before the parent looked: left in
        # the pipe, they would add up until it is full and blocks the workers.
        while computing > 0 and wait([self._bell.fileno()], 0):
            computing -= len(self._bell.read(computing))
        for worker in workers:
            flags[worker] = 0

    def _wait(
        self,
        workers: Iterable[int],
        answered: Callable[[int], bool],
        sleep: Callable[[Sequence[int]], object],
    ) -> None:
        """Wait until the workers have answered a command; raise if one fails.

        Args:
            workers: The workers that received it.
            answered: Returns whether a worker has answered.
            sleep: Sleeps until one of the given workers may have answered, at most
                for the interval of the checks.
        """
        waiting, checks = list(workers), 0
        checked_at = time.monotonic()
        while waiting := [worker for worker in waiting if not answered(worker)]:
            now = time.monotonic()
            if now - checked_at > _CHECK_INTERVAL:
                checked_at, checks = now, checks + 1
                for worker in waiting:
                    if not self._workers[worker].is_alive() and not answered(worker):
                        self._fail(worker, self._death(worker))
                if checks * _CHECK_INTERVAL > HANG_LIMIT:
                    self._fail(waiting[0], f"hung: no answer in {HANG_LIMIT:g} s")
            sleep(waiting)

    @contextmanager
    def _death_explained(self) -> Iterator[None]:
        """Report how a worker ended, where TorchRL only reports that it did."""
        if not self.is_closed:
            for worker, process in enumerate(self._workers):
                if not process.is_alive():
                    self._fail(worker, self._death(worker))
        try:
            yield
        except (EOFError, ConnectionError):
            self._explain_death()
        except KeyboardInterrupt:
            # Otherwise the next command would receive the answers to this one.
            self._end()
            raise

    def _explain_death(self) -> NoReturn:
        """Raise WorkerError with the worker that ended and the reason."""
        deadline = time.monotonic() + _DEATH_NOTICE
        while time.monotonic() < deadline:
            for worker, process in enumerate(self._workers):
                if not process.is_alive():
                    self._fail(worker, self._death(worker))
            time.sleep(_POLL)
        self._end()
        raise WorkerError("the connection to a worker broke; all were ended")

    def _death(self, worker: int) -> str:
        if worker in self._hung:
            return f"hung while it started: no answer in {HANG_LIMIT:g} s"
        report = self._report(worker)
        if report.exists():
            return f"raised\n{report.read_text()}"
        code = self._workers[worker].exitcode
        if code == _UNGUARDED:
            self._end()
            raise SystemExit(_GUARD)
        if code is not None and code < 0:
            # The system does so if a machine, container or job runs out of memory.
            hint = " (out of memory?)" * (-code == signal.SIGKILL)
            return f"was killed by {signal.Signals(-code).name}{hint}"
        return f"ended with exit status {code}"

    def _fail(self, worker: int, reason: str) -> NoReturn:
        """Kill the workers and raise WorkerError."""
        self._end()
        raise WorkerError(f"worker {worker} of {self.num_workers} {reason}")

    def _end(self) -> None:
        """Kill all workers."""
        for process in self._workers:
            process.kill()
        for process in self._workers:
            process.join()
        for channel in self.parent_channels:
            channel.close()
        # Nothing is left to close; TorchRL would wait for answers from killed workers.
        self.is_closed = True
        self._bell.close()
        if self._owns_workers:
            shutil.rmtree(self._reports, ignore_errors=True)

    def close(self, *, raise_if_closed: bool = False) -> None:
        """End the workers; closing twice is allowed."""
        if not self.is_closed:
            if all(process.is_alive() for process in self._workers):
                super().close(raise_if_closed=raise_if_closed)
                self._bell.close()
            else:
                self._end()
        shutil.rmtree(self._reports, ignore_errors=True)
