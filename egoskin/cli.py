"""What the scripts share: clear errors, wording, checks of options."""

from __future__ import annotations

import os
import select
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any

from egoskin.interrupts import ENDING, end_next_time, end_now, say, take
from egoskin.parallel import WorkerError

# Options that have another name now, by the old one.
_RENAMED = {
    "--sensor.localization.hold": "--sensor.keep-last",
    "--sensor.ray.fov": "--sensor.ray.fov-deg, from corner to corner",
    "--coverage": "--visibility",
}


class _Ended(KeyboardInterrupt):
    """Raised where the signal of a number arrives."""


@contextmanager
def clear_errors() -> Iterator[None]:
    """Turn what ends a script into one line on stderr and an exit status.

    An error that the user can mend is ValueError (bad input) or OSError (files): status
    2. A worker's end is status 1, and a signal 128 with its number added. If nobody
    reads the output any more, that is no error. Anything else is a fault of ours and
    keeps its traceback.
    """
    before = {number: signal.getsignal(number) for number in ENDING}
    hook, sys.unraisablehook = sys.unraisablehook, _end_if_lost
    take(_raise, *ENDING)
    try:
        try:
            _check_names(sys.argv[1:])
            yield
        finally:
            sys.stdout.flush()
    except WorkerError as error:
        raise SystemExit(f"error: {error}") from None
    except (ValueError, OSError) as error:
        if isinstance(error, BrokenPipeError) and _nobody_reads():
            # What is left to be written is not tried again.
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            raise SystemExit(128 + signal.SIGPIPE) from None
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(2) from None
    except KeyboardInterrupt as error:
        end_next_time()
        say("stopped")
        raise SystemExit(128 + _number(error)) from None
    finally:
        sys.unraisablehook = hook
        if signal.getsignal(signal.SIGINT) is not end_now:
            for number, handler in before.items():
                signal.signal(number, handler)


def _check_names(args: list[str]) -> None:
    """Raise ValueError for an option that has another name now."""
    for arg in args:
        name = arg.split("=")[0].replace("_", "-")
        if name in _RENAMED:
            raise ValueError(f"{name} is now {_RENAMED[name]}")


def _nobody_reads() -> bool:
    """Whether the other end of the output's pipe is closed."""
    poll = select.poll()
    poll.register(sys.stdout.fileno(), 0)
    return bool(poll.poll(0))


def _raise(number: int, frame: FrameType | None) -> None:
    """Handle the first signal: unwind, and let the next one end the process."""
    end_next_time()
    raise _Ended(number)


def _number(error: BaseException) -> int:
    return error.args[0] if isinstance(error, _Ended) else signal.SIGINT


def _end_if_lost(lost: sys.UnraisableHookArgs) -> None:
    """End if a signal arrived where no exception leads out, as in a destructor."""
    if isinstance(lost.exc_value, KeyboardInterrupt):
        end_now(_number(lost.exc_value))
    sys.__unraisablehook__(lost)


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
    if path is None:
        return
    if not path.parent.is_dir():
        raise ValueError(f"{option}: there is no folder {path.parent}")
    if os.path.isdir(path):
        raise ValueError(f"{option}: {path} is a folder")
    try:
        new = not os.path.lexists(path)
        if new or path.is_file():
            # Appending nothing changes nothing.
            path.open("ab").close()
        if new:
            path.unlink()
    except OSError as error:
        text = f"{option}: {path} cannot be written ({error.strerror})"
        raise ValueError(text) from None
