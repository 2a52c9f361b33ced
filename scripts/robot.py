"""Check a robot before training, and draw it.

The same as `egoskin robot`:
python scripts/robot.py check my_robot --out robot.png
"""

from __future__ import annotations

from egoskin.commands import run

if __name__ == "__main__":
    run("robot")
