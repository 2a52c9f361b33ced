"""Available memory, checks against it, and detection of out-of-memory errors."""

from __future__ import annotations

import os
import resource
from collections.abc import Mapping

import torch

from egoskin.cgroups import memory_limit

_SHARED = "/dev/shm"
# Texts of out-of-memory errors that have no exception class of their own.
_OUT_OF_MEMORY = (
    "can't allocate memory",
    "Cannot allocate memory",
    "not enough memory",
    "unable to allocate shared memory",
    "can't start new thread",
    # Warp, and CUDA's own text in other errors.
    "Failed to allocate",
    "CUDA error: out of memory",
)


def machine_memory() -> int:
    """Return the largest amount of memory this process can use [bytes]."""
    limits = [os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")]
    limit = memory_limit()
    if limit is not None:
        limits.append(limit)
    address_space, _ = resource.getrlimit(resource.RLIMIT_AS)
    if address_space != resource.RLIM_INFINITY:
        limits.append(address_space)
    return min(limits)


def check_memory(needs: Mapping[str, int]) -> None:
    """Raise ValueError if the machine has too little memory.

    Args:
        needs: Minimum need in bytes, by name; the name says what needs the memory and
            which options determine its size.
    """
    needed, there = sum(needs.values()), machine_memory()
    if needed > there:
        largest = max(needs, key=lambda name: needs[name])
        raise ValueError(
            f"this needs at least {_size(needed)} of memory, but there are "
            f"{_size(there)}; most of it is for {largest}"
        )


def check_shared_memory(needed: int, what: str) -> None:
    """Raise ValueError if there is too little free shared memory.

    Writing beyond it would kill the process without a message (SIGBUS).

    Args:
        needed: Number of bytes.
        what: Their purpose and the options that determine their number.
    """
    # Not all systems have this folder.
    if not os.path.isdir(_SHARED):
        return
    status = os.statvfs(_SHARED)
    free = status.f_bavail * status.f_frsize
    if needed > free:
        raise ValueError(
            f"{_SHARED} has {_size(free)} of shared memory left, but {_size(needed)} "
            f"are needed for {what}; in a container, increase it (docker: --shm-size)"
        )


def is_out_of_memory(error: BaseException) -> bool:
    """Return whether an error reports a lack of memory or shared memory."""
    if isinstance(error, (MemoryError, torch.OutOfMemoryError)):
        return True
    known = isinstance(error, (RuntimeError, OSError))
    return known and any(text in str(error) for text in _OUT_OF_MEMORY)


def _size(number: int) -> str:
    for unit, size in (("GB", 1e9), ("MB", 1e6)):
        if number >= size:
            return f"{number / size:,.1f} {unit}"
    return f"{number:,} bytes"
