"""TensorBoard files, written at once and without a thread.

torch's own writer hands events to a thread, which on a full disk dies with a traceback
of its own; here an error is raised where it happens, as an OSError.
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


class EventFile:
    """A new file of scalars in a run folder.

    Args:
        folder: The folder.
        frames: Environment steps done before; TensorBoard forgets what older files
            hold after these.
    """

    def __init__(self, folder: Path, frames: int) -> None:
        stamp = f"{time.time_ns()}.{socket.gethostname()}.{os.getpid()}"
        # Unbuffered: nothing is left that closing could fail to write.
        file = open(folder / f"events.out.tfevents.{stamp}", "xb", buffering=0)  # noqa: SIM115
        self._writer = RecordWriter(file)
        self._write(Event(file_version="brain.Event:2"))
        if frames:
            start = SessionLog(status=SessionLog.START)
            self._write(Event(step=frames + 1, session_log=start))

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
        self._writer.write(event.SerializeToString())

    def close(self) -> None:
        """Close the file."""
        self._writer.close()
