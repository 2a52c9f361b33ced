"""The watchdog, on real processes: hanging is told from waiting for a core."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from egoskin import watchdog
from egoskin.watchdog import Watch

LOOP = "while True: pass"
SLEEP = "import time; time.sleep(1000)"
POLL = "import time\nwhile True: time.sleep(0.02)"

pytestmark = pytest.mark.skipif(
    not Path("/proc/self/stat").exists(), reason="reads /proc"
)


@contextmanager
def process(code: str) -> Iterator[int]:
    started = subprocess.Popen([sys.executable, "-S", "-c", code])
    try:
        time.sleep(0.2)
        yield started.pid
    finally:
        started.kill()
        started.wait()


def watched(pid: int, seconds: float) -> Watch:
    watch = Watch(pid)
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        time.sleep(watchdog.INTERVAL)
        watch.look()
    return watch


@pytest.mark.parametrize("code", [SLEEP, POLL], ids=["asleep", "polling"])
def test_a_process_that_sleeps_spends_its_time(code):
    with process(code) as pid:
        watch = watched(pid, 1.5)
    assert watch.hangs(0.8)
    assert not watch.hangs(2.0)
    # One that polls may be caught awake.
    assert code == POLL or "now asleep" in watch.describe()


def test_a_stopped_process_spends_its_time():
    with process(LOOP) as pid:
        os.kill(pid, signal.SIGSTOP)
        watch = watched(pid, 1.5)
    assert watch.hangs(0.8)
    assert "0 s of CPU, now stopped" in watch.describe()


@contextmanager
def starving(pid: int) -> Iterator[None]:
    """Leave a process a three hundredth of one core."""
    core = min(os.sched_getaffinity(0))
    os.sched_setaffinity(pid, {core})
    os.sched_setscheduler(pid, os.SCHED_IDLE, os.sched_param(0))
    with process(LOOP) as hog:
        os.sched_setaffinity(hog, {core})
        yield


def test_an_endless_loop_spends_its_time_and_a_starved_one_does_not():
    with process(LOOP) as pid:
        # Of whatever the machine gives it, nothing is lost.
        before = time.monotonic()
        watch = watched(pid, 2.0)
        used = watchdog._usage(pid)[0]
        assert watch._spent == pytest.approx(watch._cpu, abs=0.4)
        assert used <= time.monotonic() - before + 1.0
        assert "now running" in watch.describe()
        with starving(pid):
            watch = watched(pid, 3.0)
            assert not watch.hangs(0.8), watch.describe()


def test_a_suspended_watcher_counts_one_slice():
    with process(SLEEP) as pid:
        watch = Watch(pid)
        time.sleep(1.5)
        watch.look()
    assert not watch.hangs(2.5 * watchdog.INTERVAL)


def test_without_proc_it_is_the_time_awake():
    gone = subprocess.Popen([sys.executable, "-c", ""])
    gone.wait()
    assert watched(gone.pid, 1.0).hangs(0.6)
