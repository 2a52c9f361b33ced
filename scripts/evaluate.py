"""Evaluate a policy on a fixed set of throws.

The same as `egoskin evaluate`:
python scripts/evaluate.py runs/NAME --json out.json
"""

from __future__ import annotations

from egoskin.commands import run

if __name__ == "__main__":
    run("evaluate")
