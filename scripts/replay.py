"""Replay an update that was not finite.

The same as `egoskin replay`:
python scripts/replay.py runs/NAME/not-finite-FRAMES.safetensors
"""

from __future__ import annotations

from egoskin.commands import run

if __name__ == "__main__":
    run("replay")
