"""Search for what the body could still do when a ball is in reach.

The same as `egoskin upper-bound`:
python scripts/upper_bound.py runs/NAME
"""

from __future__ import annotations

from egoskin.commands import run

if __name__ == "__main__":
    run("upper-bound")
