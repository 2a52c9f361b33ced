"""TensorBoard files, written synchronously without a thread.

torch's writer passes events to a thread, which dies with its own traceback on a full
disk. Here the error is raised in the caller, as an OSError.
"""

from __future__ import annotations

import os
import socket
import time
from collections.abc import Mapping
from pathlib import Path

from tensorboard.compat.proto.event_pb2 import Event, SessionLog
from tensorboard.compat.proto.summary_pb2 import Summary
from tensorboard.summary.writer.record_writer import RecordWriter

from egoskin.storage.files import named

_PREFIX = "events.out.tfevents."


class EventFile:
    """A new TensorBoard file of scalars in a run folder.

    Args:
        folder: The folder.
        frames: Environment steps done so far; TensorBoard discards later steps from
            older files.
    """

    def __init__(self, folder: Path, frames: int) -> None:
        # TensorBoard reads files in the order of their names: this one must come last,
        # even if the clock was set back.
        times = [_time_of(path.name) for path in folder.glob(f"{_PREFIX}*")]
        now = max([time.time_ns(), *(ns + 1 for ns in times)])
        name = f"{_PREFIX}{now:019d}.{socket.gethostname()}.{os.getpid()}"
        self._path = folder / name
        # Unbuffered, so that closing has nothing left to write and cannot fail.
        file = open(self._path, "xb", buffering=0)  # noqa: SIM115
        self._writer = RecordWriter(file)
        start = SessionLog(status=SessionLog.START)
        try:
            self._write(Event(file_version="brain.Event:2"))
            self._write(Event(step=frames + 1, session_log=start))
        except OSError:
            self.close()
            raise

    def log(self, metrics: Mapping[str, float]) -> None:
        """Append the metrics of a rollout; "frames" is the x axis."""
        values = [
            Summary.Value(tag=name, simple_value=value)
            for name, value in metrics.items()
            if name != "frames"
        ]
        self._write(Event(step=int(metrics["frames"]), summary=Summary(value=values)))

    def _write(self, event: Event) -> None:
        event.wall_time = time.time()
        try:
            self._writer.write(event.SerializeToString())
        except OSError as error:
            raise named(error, self._path) from error

    def close(self) -> None:
        """Close the file."""
        self._writer.close()


def _time_of(name: str) -> int:
    """Return the time in the name of an event file [ns], 0 if there is none."""
    time_ns = name.removeprefix(_PREFIX).partition(".")[0]
    return int(time_ns) if time_ns.isdecimal() and len(time_ns) == 19 else 0
