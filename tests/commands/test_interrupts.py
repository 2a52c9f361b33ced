"""Ctrl-C and similar signals: one line at any time, whatever the script does."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

import calling
from egoskin.commands import errors
from egoskin.commands.errors import clear_errors
from egoskin.interrupts import ENDING, say, take

# The main script, and one of those that only call a command (all are alike).
SCRIPTS = [calling.SCRIPTS / "ppo.py", calling.SCRIPTS / "evaluate.py"]


@pytest.fixture(autouse=True)
def handlers() -> Iterator[None]:
    """Restore pytest's signal handlers after each test."""
    before = {number: signal.getsignal(number) for number in ENDING}
    # Ignored signals remain ignored; nohup ignores this one.
    if before[signal.SIGHUP] is signal.SIG_IGN:
        signal.signal(signal.SIGHUP, signal.SIG_DFL)
    say.cache_clear()
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.mark.skipif(not Path("/proc/self/maps").exists(), reason="reads /proc")
@pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: path.stem)
def test_ctrl_c_twice_while_a_script_imports_is_one_line(script: Path):
    process = subprocess.Popen(
        [sys.executable, str(script), "--help-all"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    maps = Path(f"/proc/{process.pid}/maps")
    # The first third-party package that is loaded.
    while "numpy" not in maps.read_text():
        assert process.poll() is None
        time.sleep(0.005)
    for _ in range(2):
        process.send_signal(signal.SIGINT)
    assert process.communicate() == ("", "stopped\n")
    assert process.returncode == 130


class Noting:
    """An object that records that it was closed."""

    def __init__(self, said: list[str]) -> None:
        self._said = said

    def close(self) -> None:
        self._said.append("closed")


@pytest.mark.parametrize("number", ENDING)
def test_a_signal_unwinds_and_is_one_line(number, capfd):
    unwound = []
    with (
        pytest.raises(SystemExit) as ended,
        clear_errors(),
        contextlib.closing(Noting(unwound)),
    ):
        os.kill(os.getpid(), number)
    assert unwound == ["closed"]
    assert ended.value.code == 128 + number
    assert capfd.readouterr().err == "stopped\n"


def test_a_signal_that_arrives_in_a_destructor_is_not_lost(monkeypatch):
    class Tidied:
        def __del__(self) -> None:
            os.kill(os.getpid(), signal.SIGTERM)
            time.sleep(5)

    ended = []
    monkeypatch.setattr(errors, "end_now", ended.append)
    with clear_errors():
        tidied = Tidied()
        del tidied
    assert ended == [signal.SIGTERM]


def test_what_is_ignored_stays_ignored():
    # As under nohup.
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    with clear_errors():
        os.kill(os.getpid(), signal.SIGHUP)
    take(signal.SIG_DFL, *ENDING)
    assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN


def test_handlers_are_given_back():
    before = [signal.getsignal(number) for number in ENDING]
    with clear_errors():
        assert signal.getsignal(signal.SIGHUP) not in before
    with pytest.raises(SystemExit), clear_errors():
        raise ValueError
    assert [signal.getsignal(number) for number in ENDING] == before
