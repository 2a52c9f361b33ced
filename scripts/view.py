"""See a policy in the browser, and throw balls at it.

The same as `egoskin view`:
python scripts/view.py field_proximity
"""

from __future__ import annotations

from egoskin.commands import run

if __name__ == "__main__":
    run("view")
