"""Film an episode, with a contact sheet of its moments.

The same as `egoskin film`:
python scripts/render.py runs/NAME --out a.mp4
"""

from __future__ import annotations

from egoskin.commands import run

if __name__ == "__main__":
    run("film")
