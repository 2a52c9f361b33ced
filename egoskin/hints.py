"""What to add to the error for a name that is not known."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """Return ``", did you mean 'torso_link'?"``, or nothing if none is like it.

    Args:
        name: What was given.
        known: The names there are.
    """
    near = difflib.get_close_matches(name, list(known), n=1)
    return f", did you mean {near[0]!r}?" if near else ""
