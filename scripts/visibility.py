"""Show what a skin sees, before any training.

The same as `egoskin visibility`:
python scripts/visibility.py --skin.path skin.json
"""

from __future__ import annotations

from egoskin.commands import run

if __name__ == "__main__":
    run("visibility")
