"""Run commands in this process, because importing takes most of a call.

Also what tests of processes share: waiting, a full disk, a missing package.
"""

from __future__ import annotations

import importlib.util
import io
import resource
import runpy
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import redirect_stderr, redirect_stdout
from importlib import import_module
from pathlib import Path

import pytest

from egoskin.commands.errors import clear_errors
from egoskin.interrupts import ENDING

SCRIPTS = Path(__file__).parents[1] / "scripts"
SMALL = ("--num-envs", "32", "--num-workers", "2", "--ppo.num-mini-batches", "2")
"""Options of a small training."""
SCHEDULES = ("--ppo.noise-correlation-start", "512", "--ppo.entropy-frames", "1024")
"""Options with which a small training reaches the ends of its schedules."""
BATCH = 512
"""Environment steps of one rollout of it: 32 agents x 16 steps."""


def call(name: str, *args: object) -> subprocess.CompletedProcess[str]:
    """Return how a command, or a script (.py), ends, and what it writes."""
    texts = [str(arg) for arg in args]
    out, errors = io.StringIO(), io.StringIO()
    handlers = {number: signal.getsignal(number) for number in ENDING}
    status: object = 0
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(out):
        called = name if name.endswith(".py") else f"egoskin {name}"
        patch.setattr(sys, "argv", [called, *texts])
        try:
            with redirect_stderr(errors):
                if name.endswith(".py"):
                    runpy.run_path(str(SCRIPTS / name), run_name="__main__")
                else:
                    _run(name, texts)
        except SystemExit as end:
            status = end.code or 0
        finally:
            for number, handler in handlers.items():
                signal.signal(number, handler)
    if isinstance(status, str):
        errors.write(status)
        status = 1
    assert isinstance(status, int)
    # tyro draws boxes: join the lines.
    told = errors.getvalue().replace("│", " ")
    return subprocess.CompletedProcess([name, *texts], status, out.getvalue(), told)


def _run(name: str, args: list[str]) -> None:
    with clear_errors():
        import_module(f"egoskin.commands.{name.replace('-', '_')}").main(args)


def succeed(name: str, *args: object) -> str:
    """Return the output of a command, which must succeed."""
    done = call(name, *args)
    assert done.returncode == 0, done.stderr
    return done.stdout


def fail(name: str, *args: object) -> str:
    """Return the error of a command whose input is bad, on one line."""
    done = call(name, *args)
    assert done.returncode == 2, done.stderr
    assert "Traceback" not in done.stderr
    return " ".join(done.stderr.split())


def wait_for(condition: Callable[[], object], seconds: float = 300) -> None:
    """Return as soon as a condition holds."""
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.02)


def limit_file_size(size: int) -> None:
    """Let this process write no file of more bytes, as if the disk were full."""
    _, most = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, most))


def hide(package: str, patch: pytest.MonkeyPatch) -> None:
    """Let a package seem not to be installed."""
    find = importlib.util.find_spec
    patch.setattr(
        importlib.util,
        "find_spec",
        lambda name: None if name == package else find(name),
    )
