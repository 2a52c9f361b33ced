"""Clear errors: what ends a command becomes one line and an exit status."""

from __future__ import annotations

import os
import select
import signal
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from types import FrameType
from typing import Any

import tyro

from egoskin.commands import unknown
from egoskin.interrupts import ENDING, end_next_time, end_now, say, take
from egoskin.parallel import WorkerError


class _Ended(KeyboardInterrupt):
    """Raised where the signal of a number arrives."""


@contextmanager
def clear_errors() -> Iterator[None]:
    """Turn what ends a command into one line on stderr and an exit status.

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


def parse_subcommand(
    kinds: Mapping[str, type], args: Sequence[str], description: str | None = None
) -> Any:
    """Return the configuration that arguments name and fill, by subcommand.

    Args:
        kinds: Dataclass of each subcommand.
        args: Arguments, the subcommand first.
        description: Text of the help; None: that of the subcommands.

    Raises:
        ValueError: If there is no such subcommand; the text has the nearest name.
    """
    if args and not args[0].startswith("-") and args[0] not in kinds:
        raise ValueError(unknown(args[0], kinds))
    return tyro.extras.subcommand_cli_from_dict(
        dict(kinds), args=args, description=description
    )
