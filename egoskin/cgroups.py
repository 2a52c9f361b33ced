"""Limits that Linux control groups set for this process: CPU time and memory.

A container or a batch system sets them. The limit of a group holds for all groups in
it, so those of this process's group and of all above it are read. In version 1 of
control groups each controller has a tree of groups of its own, in version 2 all share
one. Inside a container, the groups above its own are not there.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

# Groups of this process, a line "ID:CONTROLLERS:PATH" for each tree, and their folder.
_OWN, _TREES = Path("/proc/self/cgroup"), Path("/sys/fs/cgroup")


def cpu_limit() -> float | None:
    """Return the number of cores whose time this process may use; None: no limit."""
    return min(_cpu_limits(), default=None)


def memory_limit() -> int | None:
    """Return the largest amount of memory of this process [bytes]; None: no limit."""
    return min(_memory_limits(), default=None)


def _cpu_limits() -> Iterator[float]:
    for group in _groups("cpu"):
        # Time per period [us]; without a limit "max" in version 2 and -1 in version 1.
        with suppress(OSError, ValueError):
            quota, period = map(int, (group / "cpu.max").read_text().split())
            yield quota / period
        with suppress(OSError, ValueError):
            quota = int((group / "cpu.cfs_quota_us").read_text())
            if quota > 0:
                yield quota / int((group / "cpu.cfs_period_us").read_text())


def _memory_limits() -> Iterator[int]:
    for group in _groups("memory"):
        # Without a limit "max" in version 2 and about 2^63 in version 1.
        for name in ("memory.max", "memory.limit_in_bytes"):
            with suppress(OSError, ValueError):
                yield int((group / name).read_text())


def _groups(controller: str) -> Iterator[Path]:
    """Return the folders of this process's group and of all above it."""
    try:
        lines = _OWN.read_text().splitlines()
    except OSError:
        # Not Linux.
        return
    for line in lines:
        _, controllers, path = line.split(":", 2)
        # Version 2 has an empty list of controllers.
        if not controllers:
            tree = _TREES
        elif controller in controllers.split(","):
            tree = _TREES / controller
        else:
            continue
        own = Path(path.lstrip("/"))
        yield from (tree / group for group in (own, *own.parents))
