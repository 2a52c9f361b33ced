"""Measure speed and accuracy.

The same as `egoskin bench`:
python scripts/bench.py loop --json loop.json
"""

from __future__ import annotations

from egoskin.commands import run

if __name__ == "__main__":
    run("bench")
