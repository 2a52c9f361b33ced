"""Plan, run and report many trainings.

The same as `egoskin study`:
python scripts/study.py plan findings
"""

from __future__ import annotations

from egoskin.commands import run

if __name__ == "__main__":
    run("study")
