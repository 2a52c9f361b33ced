"""Compilation and caching of C++ libraries; without a compiler PyTorch is used instead.

Libraries are cached in a folder that only the user can access. Their file names contain
hashes of the source and of the library, so truncated or modified files are ignored.
"""

from __future__ import annotations

import ctypes
import functools
import hashlib
import logging
import os
import platform
import shutil
import stat
import subprocess
import tempfile
from contextlib import suppress
from multiprocessing import parent_process
from pathlib import Path

import torch

from egoskin.storage.files import write_file

SETTING = "EGOSKIN_COMPILE"
"""Environment variable: 0 disables the C++ kernels, for tests and measurements."""


TRIED = "EGOSKIN_COMPILATION_TRIED"
"""Environment variable of processes whose parent compiles, or has tried."""

_log = logging.getLogger(__name__)

# No -ffast-math: results must equal those of PyTorch.
_FLAGS = (
    "-std=c++17 -O3 -shared -fPIC -ffp-contract=off -fno-math-errno "
    "-fno-trapping-math -Wno-psabi"
)
# Instruction sets by the CPU capability that PyTorch reports.
_VECTORS = {
    "AVX2": "-mavx2",
    "AVX512": "-mavx512f -mavx512dq -mavx512vl -mavx512bw -mprefer-vector-width=512",
}


def _compiler() -> str | None:
    """Return the C++ compiler: CXX, or the first one found."""
    names = (os.environ.get("CXX"), "c++", "g++", "clang++")
    return next(filter(None, (shutil.which(name) for name in names if name)), None)


def can_compile() -> bool:
    """Whether there is a C++ compiler."""
    return _compiler() is not None


def load_library(source: Path) -> ctypes.CDLL | None:
    """Return a C++ source as a library, compiled once per machine, or None.

    It is None if compilation fails, which is logged as one warning, or is disabled.
    Workers (`egoskin.preload`), and child processes whose parent has tried before they
    started, neither compile nor log.

    Args:
        source: The file; it may include only system headers.
    """
    return None if os.environ.get(SETTING) == "0" else _loaded(source)


@functools.cache
def _loaded(source: Path) -> ctypes.CDLL | None:
    """Return the library, or None after logging the reason."""
    is_first = parent_process() is None or TRIED not in os.environ
    os.environ[TRIED] = "1"
    try:
        command, name = _recipe(source)
        folder = _cache()
        found = _find(folder, name)
        if found is None and is_first:
            _log.warning("compiling %s: some seconds, once per machine", source.name)
            found = _keep(folder, name, _compile(command, source))
    # Path.home() raises RuntimeError.
    except (OSError, RuntimeError) as error:
        found = None
        if is_first:
            _log.warning(
                "%s is not compiled: sensors are slower, with the same results (%s)",
                *(source.name, error),
            )
    return found


def _recipe(source: Path) -> tuple[list[str], str]:
    """Return the compile command of a source, and a name with a hash of the two."""
    compiler = _compiler()
    if compiler is None:
        raise RuntimeError("no C++ compiler found: install g++")
    vectors = _VECTORS.get(torch.backends.cpu.get_cpu_capability(), "")
    command = [compiler, *_FLAGS.split(), *vectors.split()]
    recipe = " ".join([platform.machine(), *command]).encode()
    return command, f"{source.stem}-{_digest(recipe + source.read_bytes())}"


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()[:32]


def _cache() -> Path:
    """Return the cache folder of the libraries, which only the user can access."""
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    folder = Path(base) / "egoskin"
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    about = folder.lstat()
    if not stat.S_ISDIR(about.st_mode) or about.st_uid != os.geteuid():
        raise RuntimeError(
            f"{folder} is not a folder of this user: remove it, or set XDG_CACHE_HOME"
        )
    if about.st_mode & 0o077:
        folder.chmod(0o700)
    return folder


def _find(folder: Path, name: str) -> ctypes.CDLL | None:
    """Return the cached library of a name, if there is one and it is intact."""
    for path in sorted(folder.glob(f"{name}-*.so")):
        about = path.lstat()
        own = stat.S_ISREG(about.st_mode) and about.st_uid == os.geteuid()
        if own and path.name == _file_name(name, path.read_bytes()):
            # A library compiled on another system may fail to load.
            with suppress(OSError):
                return ctypes.CDLL(str(path))
    return None


def _file_name(name: str, content: bytes) -> str:
    return f"{name}-{_digest(content)}.so"


def _compile(command: list[str], source: Path) -> bytes:
    """Return the content of the library."""
    with tempfile.TemporaryDirectory() as folder:
        made = Path(folder) / "made.so"
        command = [*command, str(source), "-o", str(made)]
        ended = subprocess.run(
            command, capture_output=True, text=True, errors="replace"
        )
        if ended.returncode:
            lines = ended.stderr.splitlines() or [f"exit status {ended.returncode}"]
            fault = next((line for line in lines if "error" in line), lines[-1])
            raise RuntimeError(f"{command[0]}: {fault.strip()}")
        return made.read_bytes()


def _keep(folder: Path, name: str, content: bytes) -> ctypes.CDLL:
    """Write a library to the cache atomically, and return it."""
    path = folder / _file_name(name, content)
    write_file(path, content)
    try:
        return ctypes.CDLL(str(path))
    except OSError:
        path.unlink()
        raise
