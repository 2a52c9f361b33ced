"""What the scripts share: clear errors, wording, checks of options."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from egoskin.workers import WorkerError


@contextmanager
def clear_errors() -> Iterator[None]:
    """Turn errors the user can mend into one line on stderr and exit status 2.

    Those are ValueError (bad input) and OSError (files). A worker's end is one line,
    too, with status 1. Anything else is a fault of ours and keeps its traceback. Ctrl-C
    ends without one.
    """
    try:
        yield
    except WorkerError as error:
        raise SystemExit(f"error: {error}") from None
    except (ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(2) from None
    except KeyboardInterrupt:
        raise SystemExit(130) from None


def counted(number: int, noun: str) -> str:
    """Return a number with its noun: "1 worker", "2 workers"."""
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


def check_counts(config: Any, *names: str) -> None:
    """Raise ValueError if a field that counts something is below 1; None is left."""
    for name in names:
        value = getattr(config, name)
        if value is not None and value < 1:
            raise ValueError(f"{name} must be at least 1, got {value}")


def check_output(path: Path | None, option: str) -> None:
    """Raise ValueError if a file cannot be written there, before the work starts.

    Args:
        path: The file; None is none.
        option: The option that named it, for the error text.
    """
    if path is not None and not path.parent.is_dir():
        raise ValueError(f"{option}: there is no folder {path.parent}")
    if path is not None and path.is_dir():
        raise ValueError(f"{option}: {path} is a folder")
