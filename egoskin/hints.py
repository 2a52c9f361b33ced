"""Names by shell pattern, and suggestions for unknown ones in error messages."""

from __future__ import annotations

import difflib
import fnmatch
from collections.abc import Iterable, Mapping, Sequence


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """Return ``", did you mean 'torso_link'?"``, or "" if no name is similar.

    Args:
        name: The unknown name.
        known: The valid names.
    """
    near = difflib.get_close_matches(name, list(known), n=1)
    return f", did you mean {near[0]!r}?" if near else ""


def matching(
    patterns: Sequence[str], names: Sequence[str], what: str, known: str = ""
) -> tuple[str, ...]:
    """Return the names that match any of some shell patterns, each once.

    Args:
        patterns: Names or shell patterns (``*_elbow_*``).
        names: The known names.
        what: What the names are, for the error text (``"link"``).
        known: What they are together, if that is not the plural of ``what``.

    Returns:
        The matches of the first pattern in the order of ``names``, then those of the
        second that are new, and so on.

    Raises:
        ValueError: If a pattern matches no name; the text has the closest and all.
    """
    known = known or f"{what}s"
    if isinstance(patterns, str):
        # Its letters would be the patterns.
        raise ValueError(f"expected a sequence of {known}, got {patterns!r}")
    found: dict[str, None] = {}
    for pattern in patterns:
        # A name with brackets in it is not a pattern.
        those = [pattern] if pattern in names else fnmatch.filter(names, pattern)
        if not those:
            raise ValueError(
                f"no {what} {pattern!r}{did_you_mean(pattern, names)} "
                f"({known}: {', '.join(names)})"
            )
        found |= dict.fromkeys(those)
    return tuple(found)


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
