"""Place, import, export and show skins.

The same as `egoskin skin`:
python scripts/skin.py show skin.json --picture skin.png
"""

from __future__ import annotations

from egoskin.commands import run

if __name__ == "__main__":
    run("skin")
