"""Claims: one worker at a time, also after crashes, on one host or several."""

from __future__ import annotations

import errno
import fcntl
import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from egoskin.study import claims
from egoskin.study.claims import claimed, is_claimed, is_locked, this_host

HOLD = """
import sys, time
from pathlib import Path
from egoskin.study.claims import claimed
with claimed(Path(sys.argv[1]), "run", heartbeat=0.1) as mine:
    print(mine, flush=True)
    time.sleep(60)
"""


def hold(folder: Path) -> subprocess.Popen[str]:
    """Start a process that claims "run", and wait until it has."""
    process = subprocess.Popen(
        [sys.executable, "-c", HOLD, str(folder)], stdout=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "True\n"
    return process


def elsewhere(folder: Path, age: float, number: int = 1) -> Path:
    """Write the owner file of a process on another host, with an age [s]."""
    folder.mkdir(exist_ok=True)
    path = folder / f"run.owner.{number}"
    path.write_text(json.dumps({"host": "other", "name": "other", "pid": 1}))
    then = time.time() - age
    os.utime(path, (then, then))
    return path


def test_who_may_only_read_sees_claims(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    folder = tmp_path / "claims"
    process = hold(folder)
    (folder / "run.lock").chmod(0o444)
    tmp_path.chmod(0o755)
    # Relative: the folders above may be closed to others.
    monkeypatch.chdir(tmp_path)
    user = os.geteuid()
    if user == 0:
        os.seteuid(65534)
    try:
        assert not os.access("claims/run.lock", os.W_OK, effective_ids=True)
        assert is_claimed(Path("claims"), "run")
    finally:
        os.seteuid(user)
    process.send_signal(signal.SIGKILL)
    process.communicate()
    assert not is_claimed(folder, "run")


def test_those_who_look_do_not_see_each_other(tmp_path: Path):
    process = hold(tmp_path)
    assert is_claimed(tmp_path, "run")
    assert is_locked(tmp_path / "run.lock")
    process.send_signal(signal.SIGKILL)
    process.communicate()
    # Another observer looks at the same moment.
    with claims._lock(tmp_path / "run.lock", create=False) as free:
        assert free
        assert not is_claimed(tmp_path, "run")
        assert not is_locked(tmp_path / "run.lock")


def test_a_claim_is_held_by_one_process_and_freed_by_its_death(tmp_path: Path):
    folder = tmp_path / "claims"
    process = hold(folder)
    assert is_claimed(folder, "run")
    assert not is_claimed(folder, "another")
    with claimed(folder, "run") as mine:
        assert not mine
    process.send_signal(signal.SIGKILL)
    process.communicate()
    # The owner file that it left behind does not count.
    assert list(folder.glob("run.owner.*"))
    assert not is_claimed(folder, "run")
    with claimed(folder, "run") as mine:
        assert mine
        assert is_claimed(folder, "run")
    assert not list(folder.glob("run.owner.*"))


def test_names_that_begin_alike_are_others(tmp_path: Path):
    with claimed(tmp_path, "run") as one, claimed(tmp_path, "run.owner") as two:
        assert one
        assert two


def test_a_living_owner_on_another_host_keeps_its_claim(tmp_path: Path):
    path = elsewhere(tmp_path, age=10)
    assert is_claimed(tmp_path, "run", stale=60)
    with claimed(tmp_path, "run", stale=60) as mine:
        assert not mine
    assert path.exists()


def test_a_dead_owner_on_another_host_loses_its_claim(tmp_path: Path):
    elsewhere(tmp_path, age=100)
    assert not is_claimed(tmp_path, "run", stale=60)
    with claimed(tmp_path, "run", stale=60) as mine:
        assert mine
        (owner,) = tmp_path.glob("run.owner.2")
        assert json.loads(owner.read_text())["host"] == this_host()
    assert not list(tmp_path.glob("run.owner.*"))


@pytest.mark.parametrize("ahead", [-3600, 3600])
def test_the_clocks_of_hosts_need_not_agree(
    ahead: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    # Ages are by the clock of the shared file system.
    living, dead = tmp_path / "living", tmp_path / "dead"
    elsewhere(living, age=10)
    elsewhere(dead, age=100)
    own = time.time
    monkeypatch.setattr(time, "time", lambda: own() + ahead)
    assert is_claimed(living, "run", stale=60)
    assert not is_claimed(dead, "run", stale=60)


def test_an_owner_that_slept_learns_that_its_claim_was_taken(tmp_path: Path):
    lost = threading.Event()
    with claimed(tmp_path, "run", heartbeat=0.02, lost=lost.set) as mine:
        assert mine
        other = elsewhere(tmp_path, age=0, number=2)
        assert lost.wait(10)
    # The other's claim is untouched.
    assert other.exists()
    assert is_claimed(tmp_path, "run")


def test_an_owner_that_slept_knows_another_by_its_content(tmp_path: Path):
    # The other took over as the second owner, ended, removed all files and began again
    # as the first.
    lost = threading.Event()
    with claimed(tmp_path, "run", heartbeat=0.02, lost=lost.set) as mine:
        assert mine
        other = elsewhere(tmp_path, age=0)
        assert lost.wait(10)
    assert other.exists()
    assert is_claimed(tmp_path, "run")


def test_an_owner_whose_file_is_gone_leaves_a_newer_one_alone(tmp_path: Path):
    with claimed(tmp_path, "run", heartbeat=60):
        (tmp_path / "run.owner.1").unlink()
        other = elsewhere(tmp_path, age=0, number=2)
    assert other.exists()


def test_a_heart_beats(tmp_path: Path):
    with claimed(tmp_path, "run", heartbeat=0.02):
        (owner,) = tmp_path.glob("run.owner.*")
        os.utime(owner, (0, 0))
        deadline = time.monotonic() + 10
        while owner.stat().st_mtime < 1:
            assert time.monotonic() < deadline
            time.sleep(0.01)


def test_a_heart_beats_on_after_an_error_of_the_file_system(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    # Such as ESTALE of NFS, once.
    listing, errors = Path.iterdir, [OSError(errno.ESTALE, "stale")]

    def fail_once(path: Path) -> Iterator[Path]:
        if errors and threading.current_thread() is not threading.main_thread():
            raise errors.pop()
        return listing(path)

    monkeypatch.setattr(Path, "iterdir", fail_once)
    with claimed(tmp_path, "run", heartbeat=0.02):
        (owner,) = tmp_path.glob("run.owner.*")
        deadline = time.monotonic() + 10
        while errors:
            assert time.monotonic() < deadline
            time.sleep(0.01)
        os.utime(owner, (0, 0))
        while owner.stat().st_mtime < 1:
            assert time.monotonic() < deadline
            time.sleep(0.01)


def test_of_many_hosts_that_see_a_dead_owner_one_takes_its_claim(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    # Hosts that do not share locks: here each has its own name, and all get the lock.
    monkeypatch.setattr("fcntl.flock", lambda file, operation: None)
    local = threading.local()
    monkeypatch.setattr("egoskin.study.claims.this_host", lambda: local.name)
    elsewhere(tmp_path, age=1000)
    ready, done = threading.Barrier(8), threading.Barrier(8)
    won: list[int] = []

    def take(number: int) -> None:
        local.name = f"host{number}"
        ready.wait()
        with claimed(tmp_path, "run") as mine:
            if mine:
                won.append(number)
            done.wait()

    threads = [threading.Thread(target=take, args=(i,)) for i in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(won) == 1


@pytest.mark.parametrize("name", ["ENOSYS", "EOPNOTSUPP", "ENOLCK"])
def test_a_file_system_without_locks_is_named(name, tmp_path, monkeypatch):
    def refuse(*args):
        raise OSError(getattr(errno, name), "no locks")

    monkeypatch.setattr(fcntl, "flock", refuse)
    text = r"run\.lock: its file system has no locks.*mount it with locks"
    with pytest.raises(ValueError, match=text), claimed(tmp_path, "run"):
        pass
