"""Benchmark results in rows, printed and as JSON."""

from __future__ import annotations

import statistics
import sys
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path

from egoskin.progress import can_overwrite
from egoskin.storage.serialization import write_json


@dataclass(frozen=True, kw_only=True)
class Row:
    """One line of the result."""

    name: str
    """Name of the quantity."""
    value: float
    """Its value."""
    unit: str
    """Unit of the value."""
    ratio: float
    """Ratio to the reference that the benchmark's function names; 1 without one."""


def median_row(
    name: str, values: Iterable[float], ratios: Iterable[float], unit: str
) -> Row:
    """Return the row of a benchmark's measurements."""
    value, ratio = statistics.median(values), statistics.median(ratios)
    return Row(name=name, value=value, unit=unit, ratio=ratio)


def show(text: str) -> None:
    """Replace the progress line of a terminal."""
    if can_overwrite(sys.stderr):
        print(f"\r{text}\x1b[K", end="", file=sys.stderr, flush=True)


def report(rows: list[Row], path: Path | None) -> None:
    """Print the rows, and write them as JSON if a path is given."""
    for row in rows:
        number = f"{row.value:,.0f}" if row.value >= 1000 else f"{row.value:.3g}"
        print(f"{row.name:<36} {number:>10} {row.unit}  ratio {row.ratio:.3f}")
    if path is not None:
        content = {"rows": [asdict(row) for row in rows]}
        write_json(path, content)
