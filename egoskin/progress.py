"""How far work is, readable on a terminal and in a file."""

from __future__ import annotations

import errno
import sys
import time
from collections.abc import Mapping

# In a file a line is written this often [s]; a terminal shows every rollout.
_FILE_INTERVAL = 10.0


def counted(number: int, noun: str) -> str:
    """Return a number with its noun: "1 worker", "2 workers"."""
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


def clock(seconds: float) -> str:
    """Return a time as hours, minutes and seconds: "2:10:05"."""
    hours, rest = divmod(round(seconds), 3600)
    return f"{hours:d}:{rest // 60:02d}:{rest % 60:02d}"


class StatusLine:
    """One line on stderr that says how far the work is.

    On a terminal it is written over; in a file a line is written now and then.

    Args:
        text: What the work is, shown at once.
    """

    def __init__(self, text: str) -> None:
        self._live = sys.stderr.isatty()
        self._shown = float("-inf")
        self.show(text)

    def show(self, text: str) -> None:
        """Show how far it is, if it is time to."""
        now = time.monotonic()
        if self._live:
            print(f"\r{text}\x1b[K", end="", file=sys.stderr, flush=True)
        elif now - self._shown >= _FILE_INTERVAL:
            print(text, file=sys.stderr, flush=True)
            self._shown = now

    def finish(self) -> None:
        """Leave the line."""
        if self._live:
            print("\r\x1b[K", end="", file=sys.stderr, flush=True)


class ProgressLine:
    """Frames, time left, speed, survival and success of a training run.

    Args:
        frames: Frames done before.
        total: Frames at the end.

    Attributes:
        is_unread: Whether nobody reads it any more.
        metrics: Those shown last; empty before any.
    """

    def __init__(self, frames: int, total: int) -> None:
        self._first, self._total = frames, total
        self._start = time.monotonic()
        self._shown = float("-inf")
        self._live = sys.stdout.isatty()
        self.is_unread = False
        self.metrics: Mapping[str, float] = {}

    def update(self, metrics: Mapping[str, float]) -> None:
        """Show the state after a rollout."""
        self.metrics = metrics
        now, frames = time.monotonic(), metrics["frames"]
        total = f"{self._total:,}"
        # Before any episode was old enough there is none to tell of.
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
        """Leave the line."""
        if self._live:
            self._print("")

    def _print(self, text: str, end: str = "\n") -> None:
        """Print, and note if nobody reads it: the run is to end with a checkpoint."""
        if self.is_unread:
            return
        try:
            print(text, end=end, flush=True)
        except OSError as error:
            # A closed pipe, a closed terminal.
            if error.errno not in (errno.EPIPE, errno.EIO):
                raise
            self.is_unread = True

    def _left(self, now: float, frames: float) -> str:
        done = frames - self._first
        return clock((now - self._start) * max(self._total - frames, 0) / max(done, 1))
