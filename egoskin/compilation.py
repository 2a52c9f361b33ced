"""C++ where there is a compiler."""

from __future__ import annotations

import contextlib
import ctypes
import functools
import hashlib
import os
import shutil
import subprocess
import tempfile
from pathlib import Path

import torch

# No -ffast-math: results are the same whoever computes them.
_FLAGS = (
    "-std=c++17 -O3 -shared -fPIC -ffp-contract=off -fno-math-errno "
    "-fno-trapping-math -Wno-psabi"
)
# Instruction sets by what PyTorch finds on this machine.
_VECTORS = {
    "AVX2": "-mavx2",
    "AVX512": "-mavx512f -mavx512dq -mavx512vl -mavx512bw -mprefer-vector-width=512",
}


def _compiler() -> str | None:
    """Return the C++ compiler: that of CXX, or the first that is found."""
    names = (os.environ.get("CXX"), "c++", "g++", "clang++")
    return next(filter(None, (shutil.which(name) for name in names if name)), None)


def can_compile() -> bool:
    """Whether there is a C++ compiler."""
    return _compiler() is not None


def _recipe(source: Path) -> tuple[list[str], str]:
    """Return the command that compiles a source, and the name of the result."""
    compiler = _compiler()
    if compiler is None:
        raise RuntimeError("no C++ compiler was found: install g++")
    vectors = _VECTORS.get(torch.backends.cpu.get_cpu_capability(), "")
    command = [compiler, *_FLAGS.split(), *vectors.split()]
    code = source.read_bytes()
    key = hashlib.sha256(" ".join(command).encode() + code).hexdigest()[:16]
    return command, f"{source.stem}-{key}.so"


def _cached(name: str) -> Path:
    """Return where a library of this user is kept."""
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(base) / "egoskin" / name


def is_compiled(source: Path) -> bool:
    """Whether `load_library` finds it compiled.

    Raises:
        RuntimeError: If there is no compiler.
    """
    return _cached(_recipe(source)[1]).exists()


@functools.cache
def load_library(source: Path) -> ctypes.CDLL:
    """Return a C++ source as a library, compiled for this machine once.

    Args:
        source: The file; it includes nothing of its own.

    Raises:
        RuntimeError: If there is no compiler, or it fails.
    """
    command, name = _recipe(source)
    library = _cached(name)
    if library.exists():
        return ctypes.CDLL(str(library))
    try:
        library.parent.mkdir(parents=True, exist_ok=True)
        folder = tempfile.TemporaryDirectory(dir=library.parent)
    except OSError:
        # Nothing can be kept here: compiled in each process.
        folder = tempfile.TemporaryDirectory()
    with folder as path:
        made = Path(path) / name
        ended = subprocess.run(
            [*command, str(source), "-o", str(made)], capture_output=True, text=True
        )
        if ended.returncode:
            raise RuntimeError(f"{' '.join(command)} {source}: {ended.stderr.strip()}")
        loaded = ctypes.CDLL(str(made))
        # Whole or not at all: other processes may be compiling the same.
        with contextlib.suppress(OSError):
            os.replace(made, library)
    return loaded
