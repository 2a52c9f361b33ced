"""Suggestions for unknown names in error messages."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """Return ``", did you mean 'torso_link'?"``, or "" if no name is similar.

    Args:
        name: The unknown name.
        known: The valid names.
    """
    near = difflib.get_close_matches(name, list(known), n=1)
    return f", did you mean {near[0]!r}?" if near else ""


def unknown_command(
    name: str, known: Iterable[str], other: Mapping[str, str] = {}
) -> str:
    """Return the error text for an unknown command, with the nearest known one.

    Args:
        name: The unknown name.
        known: The known names.
        other: Other names that may have been meant, and the known name of each.
    """
    near = difflib.get_close_matches(name, [*known, *other], n=1)
    hint = f", did you mean {other.get(near[0], near[0])!r}?" if near else ""
    return f"there is no command {name!r}{hint} (commands: {', '.join(known)})"
