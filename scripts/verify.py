"""Check that training is exact on this machine.

As `egoskin verify`:
python scripts/verify.py --iterations 3
"""

from __future__ import annotations

from egoskin.commands import run

if __name__ == "__main__":
    run("verify")
