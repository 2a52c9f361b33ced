"""Progress reports, readable on a terminal and in a log file."""

from __future__ import annotations

import errno
import os
import sys
import time
from collections.abc import Mapping
from typing import TextIO

# Interval between lines in a file [s]; a terminal shows every rollout.
_FILE_INTERVAL = 10.0


def counted(number: int, noun: str) -> str:
    """Return a number with its noun: "1 worker", "2 workers"."""
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


def can_overwrite(stream: TextIO) -> bool:
    """Return whether a stream is a terminal whose current line can be overwritten."""
    # Terminals inside editors have no control sequences.
    return stream.isatty() and os.environ.get("TERM") != "dumb"


def note(text: str) -> None:
    """Print a line to stderr; on a terminal in place of an unfinished progress line."""
    clear = "\r\x1b[K" if can_overwrite(sys.stderr) else ""
    print(f"{clear}{text}", file=sys.stderr, flush=True)


def duration(seconds: float | None) -> str:
    """Return a time as text: "3 d 04 h", "2 h 05 min", "40 s", "-" for None."""
    if seconds is None:
        return "-"
    minutes, s = divmod(round(seconds), 60)
    hours, m = divmod(minutes, 60)
    days, h = divmod(hours, 24)
    if days:
        return f"{days} d {h:02d} h"
    if hours:
        return f"{hours} h {m:02d} min"
    return f"{m} min" if minutes >= 5 else f"{60 * m + s} s"


class StatusLine:
    """One line on stderr with the progress of the work.

    On a terminal the line is overwritten; elsewhere a line is added every 10 s.

    Args:
        text: Description of the work, shown at once.
    """

    def __init__(self, text: str) -> None:
        self._live = can_overwrite(sys.stderr)
        self._shown = float("-inf")
        self.show(text)

    def show(self, text: str) -> None:
        """Show the progress; in a file only if the last line is old enough."""
        now = time.monotonic()
        if self._live:
            print(f"\r{text}\x1b[K", end="", file=sys.stderr, flush=True)
        elif now - self._shown >= _FILE_INTERVAL:
            print(text, file=sys.stderr, flush=True)
            self._shown = now

    def finish(self) -> None:
        """Clear the line on a terminal."""
        if self._live:
            print("\r\x1b[K", end="", file=sys.stderr, flush=True)


class ProgressLine:
    """Frames, time left, speed, survival and success of a training run.

    Args:
        frames: Frames done so far.
        total: Frames at the end.

    Attributes:
        is_unread: Whether the output was closed by its reader.
        metrics: Metrics of the last update; empty before the first.
    """

    def __init__(self, frames: int, total: int) -> None:
        self._first, self._total = frames, total
        self._start = time.monotonic()
        self._shown = float("-inf")
        self._live = can_overwrite(sys.stdout)
        self.is_unread = False
        self.metrics: Mapping[str, float] = {}

    def update(self, metrics: Mapping[str, float]) -> None:
        """Show the state after a rollout."""
        self.metrics = metrics
        now, frames = time.monotonic(), metrics["frames"]
        total = f"{self._total:,}"
        # NaN until an episode has lasted long enough.
        success = f"{metrics['episode/success']:6.1%}".replace("nan%", "   -")
        text = (
            f"{frames:{len(total)},.0f} / {total} frames  "
            f"{frames / self._total:6.1%}  ETA {self._left(now, frames)}  "
            f"{metrics['time/steps_per_s']:8,.0f} steps/s  "
            f"survival {metrics['episode/survival_s']:5.2f} s  "
            f"success {success}  "
            f"reward {metrics['reward/mean']:+.4f}"
        )
        if self._live:
            self._print(f"\r{text}\x1b[K", end="")
        elif now - self._shown >= _FILE_INTERVAL or frames >= self._total:
            self._print(text)
            self._shown = now

    def finish(self) -> None:
        """End the line on a terminal."""
        if self._live:
            self._print("")

    def _print(self, text: str, end: str = "\n") -> None:
        """Print; set `is_unread` on a closed output, so that training stops."""
        if self.is_unread:
            return
        try:
            print(text, end=end, flush=True)
        except OSError as error:
            # A closed pipe or a closed terminal.
            if error.errno not in (errno.EPIPE, errno.EIO):
                raise
            self.is_unread = True

    def _left(self, now: float, frames: float) -> str:
        left, done = max(self._total - frames, 0), max(frames - self._first, 1)
        return duration((now - self._start) * left / done)
