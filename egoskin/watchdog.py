"""Tells a process that hangs from one that waits for a core.

Wall time cannot: on an overloaded machine a process answers late through no fault of
its own, and after the whole group was suspended (SIGSTOP, a closed laptop) every
answer is late. What counts instead is the time that a process spends on one command,
computing or asleep, while this process is awake to see it; time spent waiting for a
core does not count. Where there is no /proc, it is all time that this process is awake.
"""

from __future__ import annotations

import os
import time
from pathlib import Path

# How often processes are looked at [s].
INTERVAL = 0.2
# A process that spends longer than this on one command hangs [s].
LIMIT = 25.0

_STATES = {"R": "running", "S": "asleep", "D": "waiting for a disk", "T": "stopped"}


class Watch:
    """Watches one process from the moment it is given a command.

    Args:
        pid: Its process id.
    """

    def __init__(self, pid: int) -> None:
        self._pid = pid
        self._last = time.monotonic()
        self._before: float | None = None
        self._cpu = self._spent = 0.0
        self._state = "?"

    def look(self) -> None:
        """Count the time since the last look; call it about every `INTERVAL`."""
        now = time.monotonic()
        # However long this process was suspended or starved, it saw only a slice.
        awake = min(now - self._last, 2 * INTERVAL)
        self._last = now
        cpu, self._state = _usage(self._pid)
        used = 0.0 if self._before is None else max(0.0, cpu - self._before)
        self._before = cpu
        self._cpu += used
        # Ready to run: whatever it did not get of a core, it had to wait for.
        self._spent += min(used, awake) if self._state == "R" else awake

    def hangs(self, limit: float) -> bool:
        """Whether more than ``limit`` [s] were spent on the command."""
        return self._spent > limit

    def describe(self) -> str:
        """Return what was seen."""
        state = _STATES.get(self._state, self._state)
        return (
            f"no answer in {self._spent:.0f} s, {self._cpu:.0f} s of CPU, now {state}"
        )


def _usage(pid: int) -> tuple[float, str]:
    """Return the CPU time of a process [s] and its state, R if any thread is ready.

    Source: proc(5), /proc/PID/stat: state is field 3, utime and stime 14 and 15.
    """
    folder = Path("/proc") / str(pid)
    try:
        state, *fields = _stat(folder / "stat")
        threads = [_stat(file)[0] for file in folder.glob("task/*/stat")]
    except OSError:  # no /proc, or a process or thread that has just ended
        return 0.0, "?"
    ticks = int(fields[10]) + int(fields[11])
    return ticks / os.sysconf("SC_CLK_TCK"), "R" if "R" in threads else state


def _stat(file: Path) -> list[str]:
    # Field 2, the name, may hold spaces and brackets.
    return file.read_text().rpartition(")")[2].split()
