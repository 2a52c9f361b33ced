"""Check that training is reproducible on this machine.

The same as `egoskin verify`:
python scripts/verify.py --iterations 3
"""

from __future__ import annotations

from egoskin.commands import run

if __name__ == "__main__":
    run("verify")
