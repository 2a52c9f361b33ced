"""Clear errors: failures and signals become one line and an exit status."""

from __future__ import annotations

import importlib.util
import select
import signal
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from types import FrameType
from typing import Any

import tyro
from tyro.constructors import (
    ConstructorRegistry,
    PrimitiveConstructorSpec,
    PrimitiveTypeInfo,
)

from egoskin.hints import unknown_command
from egoskin.interrupts import (
    ENDING,
    end_next_time,
    end_now,
    say,
    take,
    unread_output,
)
from egoskin.memory import is_out_of_memory
from egoskin.parallel import WorkerError
from egoskin.progress import note

NUMBERS = ConstructorRegistry()
"""Rules for reading options while it is entered: integers also as 1e6."""


@NUMBERS.primitive_rule
def _whole_number(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[int] | None:
    if info.type is not int:
        return None
    return PrimitiveConstructorSpec(
        nargs=1,
        metavar="INT",
        instance_from_str=lambda texts: _read_whole(texts[0]),
        is_instance=lambda value: isinstance(value, int),
        str_from_instance=lambda value: [str(value)],
    )


def _read_whole(text: str) -> int:
    """Return a whole number from "1000000", "1_000_000" or "1e6"."""
    with suppress(ValueError):
        return int(text)
    with suppress(ValueError):
        number = float(text)
        # Beyond this, not every whole number has an exact float.
        if number.is_integer() and abs(number) < 2**53:
            return int(number)
    raise ValueError(f"expected a whole number, got {text}")


class _Ended(KeyboardInterrupt):
    """Raised when a signal arrives; its argument is the signal number."""


@contextmanager
def clear_errors() -> Iterator[None]:
    """Turn failures and signals into one line on stderr and an exit status.

    Inside the context, options are read by `NUMBERS`.

    Errors that the user can fix have status 2: ValueError (bad input), OSError (files),
    too little memory, input that is too large or too deeply nested. The end of a worker
    has status 1, and a signal 128 plus its number. A closed output pipe is not reported
    as an error. Any other exception is a bug in egoskin and keeps its traceback.
    """
    before = {number: signal.getsignal(number) for number in ENDING}
    hook, sys.unraisablehook = sys.unraisablehook, _end_if_lost
    take(_raise, *ENDING)
    try:
        try:
            with NUMBERS:
                yield
        finally:
            sys.stdout.flush()
    except WorkerError as error:
        note(f"error: {error}")
        raise SystemExit(1) from None
    except Exception as error:
        if is_out_of_memory(error):
            first, *_ = str(error).splitlines() or ["out of memory"]
            if "cuda" in first.lower():
                first += "; for fewer robots: --num-envs, --episodes or --worlds"
            note(f"error: too little memory: {first}")
            raise SystemExit(2) from None
        if not isinstance(error, (ValueError, OSError, OverflowError, RecursionError)):
            raise
        if isinstance(error, BrokenPipeError) and _nobody_reads():
            raise unread_output() from None
        note(f"error: {error}")
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


def check_packages(what: str, extra: str, *packages: str) -> None:
    """Raise ValueError if a required package is missing.

    Args:
        what: Name of the feature that needs the packages, for the error text.
        extra: The extra of egoskin that installs them.
        packages: Names of the packages.
    """
    for package in packages:
        if importlib.util.find_spec(package) is None:
            raise ValueError(
                f"{what} needs {package}: `pip install 'egoskin[{extra}]'`"
            )


def _nobody_reads() -> bool:
    """Return whether the reading end of the output pipe is closed."""
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
    """Exit if a signal arrived where exceptions are ignored, as in a destructor."""
    if isinstance(lost.exc_value, KeyboardInterrupt):
        end_now(_number(lost.exc_value))
    sys.__unraisablehook__(lost)


def parse_subcommand(
    kinds: Mapping[str, type], args: Sequence[str], description: str | None = None
) -> Any:
    """Return the configuration of the subcommand that the arguments name.

    Args:
        kinds: Dataclass of each subcommand.
        args: Arguments, the subcommand first.
        description: Help text; None: that of the subcommands.

    Raises:
        ValueError: If there is no such subcommand; the text names the nearest.
    """
    if args and not args[0].startswith("-") and args[0] not in kinds:
        raise ValueError(unknown_command(args[0], kinds))
    return tyro.extras.subcommand_cli_from_dict(
        dict(kinds), args=args, description=description
    )
