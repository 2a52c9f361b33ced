"""Numbers that round alike everywhere, and C++ where there is a compiler."""

from __future__ import annotations

import contextlib
import ctypes
import functools
import hashlib
import math
import os
import shutil
import subprocess
import tempfile
from pathlib import Path

import torch
from torch import Tensor

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


def exact_sqrt(x: Tensor) -> Tensor:
    """Return the correctly rounded square root, which PyTorch's own is not.

    PyTorch takes that of Intel's MKL where it has it, in which one float32 root in
    seven is off by the last bit; compiled, it is exact. Double precision, rounded, is
    exact for float32 in either.

    Args:
        x: Any tensor; float64 is as exact as PyTorch.
    """
    if torch.compiler.is_compiling() or x.dtype != torch.float32:
        return x.sqrt()
    return x.double().sqrt_().float()


# pi/2 = HIGH + MIDDLE + LOW: a few bits each in the first two (Cephes), so that their
# products with a small integer are exact.
_HIGH, _MIDDLE, _LOW = 1.5703125, 4.837512969970703125e-4, 7.54978995489188216e-8


def sincos(x: Tensor) -> tuple[Tensor, Tensor]:
    """Return (sine, cosine) to the last bit or two, by sums and products alone.

    PyTorch's own differ between compiled code, vector code and the tail of an array.

    Args:
        x: Angles [rad] of joints: up to some hundreds.
    """
    # x = n pi/2 + r, |r| <= pi/4
    n = (x * (2 / math.pi)).round()
    r = ((x - n * _HIGH) - n * _MIDDLE) - n * _LOW
    z, terms = r * r, 9 if x.dtype == torch.float64 else 5
    # Taylor's series; the first term left out is below half of the last bit.
    s, c = torch.zeros_like(r), torch.zeros_like(r)
    for i in range(terms - 1, 0, -1):
        s = (s + (-1) ** i / math.factorial(2 * i + 1)) * z
        c = (c + (-1) ** (i + 1) / math.factorial(2 * i + 2)) * z
    s, c = r + r * s, 1 + z * (c - 0.5)
    half = (n * 0.5).floor()
    swapped, sign = n - 2 * half > 0.5, 1 - 2 * (half - 2 * (half * 0.5).floor())
    return torch.where(swapped, c, s) * sign, torch.where(swapped, -s, c) * sign
