"""The worker pool: same results, sleeping parent, faults reported with causes."""

from __future__ import annotations

import ctypes
import os
import resource
import signal
import socket
import struct
import subprocess
import sys
import tempfile
import threading
import time
from fcntl import ioctl
from functools import partial
from pathlib import Path
from termios import FIONREAD
from typing import Any

import pytest
import torch
from torchrl.envs import Compose, Transform, TransformedEnv

from calling import wait_for
from egoskin import parallel as workers
from egoskin.envs.dodgeball import DodgeballEnv
from egoskin.make import (
    EnvConfig,
    load_env_state,
    make_env,
    make_worker_env,
    save_env_state,
)
from egoskin.parallel import (
    WorkerEnv,
    WorkerError,
    WorkerPool,
    allow_open_files,
    available_cores,
    default_num_workers,
)
from egoskin.robots.builtin import H1_2
from egoskin.sensors import place_sensors
from egoskin.sensors.kernels.compilation import SETTING
from throwing import TASK, assert_same

NUM_ENVS = 32
CONFIG = EnvConfig(task=TASK)


@pytest.fixture(scope="module")
def skin():
    return place_sensors(H1_2, 8, seed=0)


def make_pool(skin, number: int, num_envs: int = NUM_ENVS) -> WorkerPool:
    return make_env(CONFIG, skin, num_envs=num_envs, seed=5, num_workers=number)


def steps(pool: WorkerPool, root, count: int, seed: int):
    """Step with fixed actions for each global row; return all that came out."""
    generator = torch.Generator().manual_seed(seed)
    seen = []
    for _ in range(count):
        action = torch.randn(NUM_ENVS, 21, generator=generator)
        root["action"] = action.reshape(*root.batch_size, 21)
        data, root = pool.step_and_maybe_reset(root)
        seen.append(data["next"].reshape(-1))
    return torch.stack(seen), root


def test_a_parent_that_comes_late_leaves_nothing_in_the_pipe(skin, monkeypatch):
    pool = make_pool(skin, 2)
    wait = WorkerPool._wait

    def late(self, *args: Any) -> None:
        # Long enough that all have set their flags before the first look at them.
        time.sleep(0.3)
        wait(self, *args)

    try:
        root = pool.reset()
        monkeypatch.setattr(WorkerPool, "_wait", late)
        steps(pool, root, 3, seed=0)
        left = struct.unpack("i", ioctl(pool._bell, FIONREAD, bytes(4)))
        assert left == (0,)
    finally:
        pool.close()


def test_results_do_not_depend_on_the_number_of_workers(skin):
    # 90 steps: the first throws land, robots fall, rows reset at different times.
    results = []
    for number in (1, 2, 4):
        pool = make_pool(skin, number)
        try:
            results.append(steps(pool, pool.reset(), 90, seed=0)[0])
        finally:
            pool.close()
    assert results[0]["done"].any()
    assert_same(results[0], results[1])
    assert_same(results[0], results[2])


def test_a_seed_set_later_does_not_depend_on_the_number_of_workers(skin):
    results = []
    for number in (1, 2, 4):
        pool = make_pool(skin, number)
        try:
            following = pool.set_seed(7)
            found = steps(pool, pool.reset(), 20, seed=0)[0]
            results.append((following, pool.set_seed(7, static_seed=True), found))
        finally:
            pool.close()
    assert len({(following, static) for following, static, _ in results}) == 1
    assert results[0][0] != results[0][1] == 7
    assert_same(results[0][2], results[1][2])
    assert_same(results[0][2], results[2][2])


def test_a_saved_state_continues_bit_for_bit_on_other_workers(skin):
    pool = make_pool(skin, 2)
    try:
        _, root = steps(pool, pool.reset(), 40, seed=1)
        state = save_env_state(pool, root)
        expected, _ = steps(pool, root, 40, seed=2)
    finally:
        pool.close()
    pool = make_pool(skin, 4)
    try:
        found, _ = steps(pool, load_env_state(pool, state), 40, seed=2)
    finally:
        pool.close()
    assert_same(expected, found)


def test_a_bare_env_has_neither_observations_nor_signals(skin):
    # What the row "env" of the loop benchmark measures.
    full, bare = (
        make_worker_env(EnvConfig(), skin, num_envs=2, seed=0, bare=bare)
        for bare in (False, True)
    )
    missing = set(full.observation_spec.keys()) - set(bare.observation_spec.keys())
    assert missing == {"observation", "privileged_observation", "signal"}


def test_the_parent_sleeps_while_the_workers_step(skin):
    pool = make_pool(skin, 1, num_envs=512)
    try:
        root = pool.reset()
        root["action"] = torch.zeros(*root.batch_size, 21)
        pool.step_and_maybe_reset(root.clone())
        wall, cpu = time.perf_counter(), time.process_time()
        for _ in range(10):
            pool.step_and_maybe_reset(root.clone())
        wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    finally:
        pool.close()
    # TorchRL's busy wait would give 1.
    assert cpu < 0.5 * wall


def test_a_killed_worker_is_named_with_its_signal(skin):
    pool = make_pool(skin, 2)
    root = pool.reset()
    processes = list(pool._workers)
    os.kill(processes[1].pid, signal.SIGKILL)
    root["action"] = torch.zeros(*root.batch_size, 21)
    start = time.monotonic()
    # The system does so when memory is short.
    killed = r"worker 1 of 2 was killed by SIGKILL \(out of memory\?\)"
    with pytest.raises(WorkerError, match=killed):
        pool.step_and_maybe_reset(root)
    assert time.monotonic() - start < 10
    assert not any(process.is_alive() for process in processes)
    pool.close()


def test_a_low_soft_limit_of_open_files_is_raised_for_the_workers():
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (256, hard))
    try:
        allow_open_files(2)
        assert resource.getrlimit(resource.RLIMIT_NOFILE) == (256, hard)
        allow_open_files(16)
        assert 256 < resource.getrlimit(resource.RLIMIT_NOFILE)[0] < 512
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


def test_more_workers_than_the_hard_limit_of_open_files_allows_are_refused(monkeypatch):
    monkeypatch.setattr(resource, "getrlimit", lambda kind: (256, 256))
    with pytest.raises(ValueError, match=r"16 workers need .* 256: .*ulimit -n"):
        make_env(CONFIG, num_envs=16, seed=0, num_workers=16)


def test_an_estimate_of_the_open_files_is_not_too_low(skin):
    def count() -> int:
        return len(os.listdir("/dev/fd"))

    before = count()
    pool = make_pool(skin, 4)
    try:
        pool.reset()
        # Held until all have arrived.
        states = pool._ask("simulation_state")
        assert len(states) == 4
        assert count() - before < workers._FILES // 2 + 4 * workers._FILES_PER_WORKER
    finally:
        pool.close()


def test_a_folder_whose_sockets_would_have_too_long_paths_is_refused():
    with tempfile.TemporaryDirectory(prefix="ego-") as parent:
        longest = 107 - len("/listener-12345678") - len(parent) - 1
        for excess, folder in enumerate(("a" * longest, "a" * (longest + 1))):
            os.mkdir(path := f"{parent}/{folder}")
            with socket.socket(socket.AF_UNIX) as server:
                if excess:
                    with pytest.raises(ValueError, match=r"1 bytes too long .*TMPDIR"):
                        workers._check_socket_path(path)
                    with pytest.raises(OSError, match="too long"):
                        server.bind(f"{path}/listener-12345678")
                else:
                    workers._check_socket_path(path)
                    server.bind(f"{path}/listener-12345678")


def test_an_interrupted_pool_ends_its_workers(skin):
    pool = make_pool(skin, 2)
    root, processes = pool.reset(), list(pool._workers)
    root["action"] = torch.zeros(*root.batch_size, 21)
    # It waits for this one.
    os.kill(processes[0].pid, signal.SIGSTOP)

    def step() -> None:
        threading.Timer(1.0, os.kill, (os.getpid(), signal.SIGINT)).start()
        pool.step_and_maybe_reset(root)

    # Started inside, because a busy machine may take long to come here.
    with pytest.raises(KeyboardInterrupt):
        step()
    # Their answers would be taken for those to the next command.
    assert not any(process.is_alive() for process in processes)
    pool.close()


class Faulty(Transform):
    """Raises at the third step."""

    count = 0

    def _step(self, tensordict, next_tensordict):
        self.count += 1
        if self.count == 3:
            raise ZeroDivisionError("the third step")
        return next_tensordict


def build_faulty(skin) -> TransformedEnv:
    env = make_worker_env(EnvConfig(), skin, num_envs=4, seed=0)
    env.append_transform(Faulty())
    return env


def test_a_worker_that_raises_is_reported_with_its_traceback(skin):
    pool = WorkerPool([partial(build_faulty, skin)] * 2)
    root = pool.reset()
    processes = list(pool._workers)
    root["action"] = torch.zeros(*root.batch_size, 21)
    for _ in range(2):
        pool.step_and_maybe_reset(root.clone())
    with pytest.raises(WorkerError, match="ZeroDivisionError: the third step"):
        pool.step_and_maybe_reset(root)
    assert not any(process.is_alive() for process in processes)
    pool.close()


class Stuck(Transform):
    """Never answers from the second step on."""

    count = 0

    def __init__(self, loop: bool) -> None:
        super().__init__()
        self._loop = loop

    def _step(self, tensordict, next_tensordict):
        self.count += 1
        while self.count == 2:
            if not self._loop:
                time.sleep(1000)
        return next_tensordict


def build_stuck(skin, loop: bool) -> TransformedEnv:
    env = make_worker_env(EnvConfig(), skin, num_envs=4, seed=0)
    env.append_transform(Stuck(loop))
    return env


@pytest.mark.parametrize("loop", [False, True])
def test_a_worker_that_hangs_is_ended(skin, loop, monkeypatch):
    stuck = partial(build_stuck, skin, loop)
    pool = WorkerPool([partial(build_faulty, skin), stuck])
    root = pool.reset()
    processes = list(pool._workers)
    root["action"] = torch.zeros(*root.batch_size, 21)
    pool.step_and_maybe_reset(root.clone())
    monkeypatch.setattr(workers, "HANG_LIMIT", 2.0)
    start = time.monotonic()
    with pytest.raises(WorkerError, match="worker 1 of 2 hung: no answer in 2 s"):
        pool.step_and_maybe_reset(root)
    assert 2 < time.monotonic() - start < 30
    assert not any(process.is_alive() for process in processes)
    pool.close()


class Slow(Transform):
    """Takes half a second to step."""

    def _step(self, tensordict, next_tensordict):
        time.sleep(0.5)
        return next_tensordict


def build_slow(skin) -> TransformedEnv:
    env = make_worker_env(EnvConfig(), skin, num_envs=4, seed=0)
    env.append_transform(Slow())
    return env


@pytest.mark.slow
def test_a_suspended_group_goes_on():
    code = f"""
import sys
sys.path.insert(0, {str(Path(__file__).parent)!r})
import test_workers as tests
skin = tests.place_sensors(tests.H1_2, 8, seed=0)
pool = tests.WorkerPool([tests.partial(tests.build_slow, skin)])
root = pool.reset()
tests.workers.HANG_LIMIT = 2.0
root["action"] = tests.torch.zeros(*root.batch_size, 21)
for _ in range(4):
    print("step", flush=True)
    pool.step_and_maybe_reset(root.clone())
pool.close()
print("closed")
"""
    with subprocess.Popen(
        [sys.executable, "-c", code],
        stdout=subprocess.PIPE,
        text=True,
        start_new_session=True,
        # What a worker of TorchRL waits for a command.
        env={**os.environ, "BATCHED_PIPE_TIMEOUT": "1"},
    ) as parent:
        assert parent.stdout is not None
        assert parent.stdout.readline() == "step\n"
        os.killpg(parent.pid, signal.SIGSTOP)
        time.sleep(4)
        os.killpg(parent.pid, signal.SIGCONT)
        # If only the parent is stopped, its workers get no command.
        assert parent.stdout.readline() == "step\n"
        os.kill(parent.pid, signal.SIGSTOP)
        time.sleep(2)
        os.kill(parent.pid, signal.SIGCONT)
        assert parent.stdout.read().split() == ["step", "step", "closed"]


@pytest.mark.slow
def test_a_worker_that_hangs_ends_with_a_killed_parent():
    code = f"""
import sys
sys.path.insert(0, {str(Path(__file__).parent)!r})
import test_workers as tests
pool = tests.WorkerPool([
    tests.partial(tests.build_stuck, tests.place_sensors(tests.H1_2, 8, seed=0), False)
])
root = pool.reset()
root["action"] = tests.torch.zeros(*root.batch_size, 21)
pool.step_and_maybe_reset(root.clone())
print(pool._workers[0].pid, flush=True)
pool.step_and_maybe_reset(root)
"""
    command = [sys.executable, "-c", code]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as parent:
        assert parent.stdout is not None
        worker = Path("/proc") / parent.stdout.readline().strip() / "stat"
        time.sleep(0.5)
        assert worker.exists()
        parent.kill()
    # An ended process is gone, or a zombie until its new parent has noticed.
    wait_for(lambda: not worker.exists() or ") Z " in worker.read_text(), 5)


UNGUARDED = """
from egoskin.make import EnvConfig, make_env
from egoskin.robots.builtin import H1_2
from egoskin.sensors import place_sensors
skin = place_sensors(H1_2, 8, seed=0)
pool = make_env(EnvConfig(), skin, num_envs=8, seed=0, num_workers=2)
pool.reset()
"""


def test_a_script_without_a_guard_is_told_so_in_one_line(tmp_path):
    script = tmp_path / "unguarded.py"
    script.write_text(UNGUARDED)
    done = subprocess.run([sys.executable, script], capture_output=True, text=True)
    assert done.returncode == 1
    assert done.stderr.count("\n") == 1
    assert 'called under `if __name__ == "__main__":`' in done.stderr


@pytest.mark.slow
def test_a_pool_that_nobody_closed_ends_with_its_script():
    # Given as text, it is no file that workers could import.
    command = [sys.executable, "-c", UNGUARDED + "print(pool._workers[0].pid)"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert (done.returncode, done.stderr) == (0, "")
    assert not Path("/proc", done.stdout.strip()).exists()


# By default, that of a training which starts its workers (runs/test_faults.py).
@pytest.mark.slow
def test_ctrl_c_while_the_server_imports_is_one_line():
    body = UNGUARDED.replace("\n", "\n    ")
    code = (
        f"from egoskin.commands.errors import clear_errors\nwith clear_errors():{body}"
    )
    # A socket's path must be short.
    with (
        tempfile.TemporaryDirectory(prefix="ego-") as folder,
        subprocess.Popen(
            [sys.executable, "-c", code],
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
            env={**os.environ, "TMPDIR": folder},
        ) as script,
    ):
        assert script.stderr is not None
        while not list(Path(folder).glob("*/listener-*")):
            assert script.poll() is None
            time.sleep(0.01)
        # It waits for the server to fork the first worker.
        time.sleep(0.5)
        os.killpg(script.pid, signal.SIGINT)
        # When nothing can write there any more, all started processes have ended.
        assert script.stderr.read() == "stopped\n"
    assert script.returncode == 130


@pytest.mark.slow
def test_a_server_killed_at_the_start_is_reported():
    code = """
import os, signal, time
from multiprocessing import forkserver
from threading import Thread

def kill():
    while not (pid := forkserver._forkserver._forkserver_pid):
        time.sleep(0.001)
    # It imports.
    time.sleep(0.3)
    os.kill(pid, signal.SIGKILL)

Thread(target=kill, daemon=True).start()
"""
    command = [sys.executable, "-c", code + UNGUARDED]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert done.returncode == 1
    *_, last = done.stderr.splitlines()
    assert "WorkerError: a worker, or the server that forks them, ended" in last


class AskedEnv(DodgeballEnv):
    """Says what a worker's environment variable is."""

    def variable(self, name: str) -> str | None:
        return os.environ.get(name)


def build_asked() -> TransformedEnv:
    return TransformedEnv(AskedEnv(H1_2, TASK, num_envs=2), Compose())


def test_workers_compile_or_not_as_their_parent_does_now(monkeypatch):
    # The server that forks them was started with one of these settings.
    for value in ("0", None, "1"):
        if value is None:
            monkeypatch.delenv(SETTING)
        else:
            monkeypatch.setenv(SETTING, value)
        pool = WorkerPool([build_asked])
        try:
            assert pool._ask("variable", SETTING) == [value]
        finally:
            pool.close()


def build_badly(parent: int, fault: str, skin) -> TransformedEnv:
    """Fail in a worker, but not where the parent reads the specs."""
    if os.getpid() != parent:
        if fault == "raise":
            raise ZeroDivisionError("while building")
        if fault == "killed":
            os.kill(os.getpid(), signal.SIGKILL)
        time.sleep(1000)
    return make_worker_env(EnvConfig(), skin, num_envs=4, seed=0)


@pytest.mark.parametrize(
    ("fault", "message"),
    [
        ("raise", "raised\n(.|\n)*ZeroDivisionError: while building"),
        ("killed", "was killed by SIGKILL"),
        ("hang", "hung while it started: no answer in 5 s"),
    ],
)
def test_a_worker_that_fails_while_it_starts_is_reported(
    skin, fault, message, monkeypatch
):
    good = partial(make_worker_env, EnvConfig(), skin, num_envs=4, seed=0)
    if fault == "hang":
        # With the imports done, the other one starts in time.
        pool = WorkerPool([good])
        pool.reset()
        pool.close()
        monkeypatch.setattr(workers, "HANG_LIMIT", 5.0)
    pool = WorkerPool([good, partial(build_badly, os.getpid(), fault, skin)])
    with pytest.raises(WorkerError, match=f"worker 1 of 2 {message}"):
        pool.reset()
    assert not any(process.is_alive() for process in pool._workers)
    pool.close()


def test_a_worker_sends_its_state_in_the_same_memory_every_time(skin):
    # New memory for every checkpoint leaves holes: 70 MB in a worker of 2,048 agents.
    plain = make_worker_env(CONFIG, skin, num_envs=4, seed=0)
    env = WorkerEnv(plain.base_env, plain.transform.clone(), Path("unused"))
    root = env.reset()
    first = env.simulation_state()
    pointers = {key: value.data_ptr() for key, value in first.items()}
    assert all(value.is_shared() for value in first.values())
    before = {key: value.clone() for key, value in first.items()}
    root["action"] = torch.zeros(4, 21)
    env.step(root)
    second = env.simulation_state()
    assert {key: value.data_ptr() for key, value in second.items()} == pointers
    assert not torch.equal(second["physics"], before["physics"])
    for key, value in plain.base_env.simulation_state().items():
        assert torch.equal(second[key], value), key


def test_a_worker_that_fails_when_asked_is_reported(skin, monkeypatch):
    pool = make_pool(skin, 2)
    pool.reset()
    state = pool.simulation_state()
    with pytest.raises(WorkerError, match=r"raised\n(.|\n)*KeyError: 'physics'"):
        pool.load_simulation_state(
            {key: state[key] for key in state if key != "physics"}
        )
    pool.close()
    pool = make_pool(skin, 2)
    pool.reset()
    monkeypatch.setattr(workers, "HANG_LIMIT", 1.0)
    os.kill(pool._workers[0].pid, signal.SIGSTOP)
    with pytest.raises(WorkerError, match="worker 0 of 2 hung: no answer in 1 s"):
        pool.simulation_state()
    pool.close()


def test_a_worker_that_dies_between_commands_is_reported(skin):
    pool = make_pool(skin, 2)
    root = pool.reset()
    root["action"] = torch.zeros(*root.batch_size, 21)
    os.kill(pool._workers[0].pid, signal.SIGKILL)
    time.sleep(0.5)
    with pytest.raises(WorkerError, match="worker 0 of 2 was killed by SIGKILL"):
        pool.step_and_maybe_reset(root)
    pool.close()
    pool = make_pool(skin, 2)
    pool.reset()
    processes = list(pool._workers)
    os.kill(processes[0].pid, signal.SIGKILL)
    time.sleep(0.5)
    # Closing raises nothing, as nobody waits for a result.
    pool.close()
    assert not any(process.is_alive() for process in processes)


def test_a_closed_pool_can_be_used_again(skin):
    before = torch.get_num_threads()
    torch.set_num_threads(5)
    try:
        pool = make_pool(skin, 2)
        first = pool.reset()
        pool.close()
        assert_same(first, pool.reset())
        # The parent keeps its threads.
        assert torch.get_num_threads() == 5
        pool.close()
    finally:
        torch.set_num_threads(before)


def test_closing_twice_is_allowed(skin):
    pool = make_pool(skin, 1)
    pool.reset()
    pool.close()
    pool.close()


def test_the_default_number_of_workers_is_the_largest_divisor_not_above_the_cores():
    assert default_num_workers(4096, cores=2) == 2
    assert default_num_workers(4096, cores=12) == 8
    assert default_num_workers(9, cores=2) == 1
    assert default_num_workers(1, cores=64) == 1


@pytest.mark.parametrize(
    ("limit", "cores"), [(None, 2), (0.5, 1), (1.0, 1), (1.9, 1), (2.0, 2), (64.0, 2)]
)
def test_a_container_gets_no_more_cores_than_its_time(limit, cores, monkeypatch):
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: {0, 1}, raising=False)
    monkeypatch.setattr(workers, "cpu_limit", lambda: limit)
    assert available_cores() == cores


def test_a_pool_that_is_closed_leaves_no_files(skin):
    pool = make_pool(skin, 1)
    assert pool._reports.is_dir()
    pool.reset()
    pool.close()
    assert not pool._reports.exists()


def test_a_worker_without_memory_is_reported_without_a_traceback(tmp_path):
    report = tmp_path / "report.txt"
    with pytest.raises(MemoryError), workers._reported(report):
        raise MemoryError("no more")
    assert report.read_text() == "no more"


def test_workers_that_do_not_divide_the_agents_are_refused(skin):
    with pytest.raises(ValueError, match="valid: 1, 2, 4, 8, 16, 32"):
        make_pool(skin, 3)


FAULTS = """
import ctypes, resource, sys
import torch
from egoskin.parallel import keep_freed_memory
if sys.argv[1] == "keep":
    keep_freed_memory()
if sys.argv[1] == "pool":
    from egoskin.make import EnvConfig, make_env
    make_env(EnvConfig(), num_envs=1, seed=0, num_workers=1)

def faults():
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    # As in a rollout: other sizes in between, or malloc learns the one size.
    for size in (2, 40, 8, 60) * 5:
        torch.ones(size * 250_000)
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before

faults()
print(faults())
"""


@pytest.mark.slow
@pytest.mark.skipif(
    not hasattr(ctypes.CDLL(None), "mallopt"), reason="needs glibc's malloc"
)
def test_freed_memory_is_kept():
    counts = {}
    for how in ("keep", "pool", "leave"):
        command = [sys.executable, "-c", FAULTS, how]
        done = subprocess.run(command, capture_output=True, text=True, check=True)
        counts[how] = int(done.stdout)
    assert counts["keep"] < counts["leave"] / 10
    # A pool does so as well.
    assert counts["pool"] < counts["leave"] / 10
