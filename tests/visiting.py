"""A client of a page without a browser, which only receives and counts."""

from __future__ import annotations

import threading

import msgspec
import viser
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

_CAMERA = {
    "type": "ViewerCameraMessage",
    "wxyz": (1.0, 0.0, 0.0, 0.0),
    "position": (3.0, 0.0, 1.0),
    "fov": 1.0,
    "near": 0.01,
    "far": 100.0,
    "image_height": 600,
    "image_width": 800,
    "look_at": (0.0, 0.0, 1.0),
    "up_direction": (0.0, 0.0, 1.0),
}


class Visitor:
    """A client that has the page open.

    Args:
        port: Port of the page.
    """

    def __init__(self, port: int) -> None:
        self._socket = connect(
            f"ws://127.0.0.1:{port}",
            subprotocols=[f"viser-v{viser.__version__}"],
            max_size=None,
            compression=None,
        )
        self._socket.send(msgspec.msgpack.encode(_CAMERA))
        self.received = 0
        """Messages so far."""
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        try:
            for _ in self._socket:
                self.received += 1
        except ConnectionClosed:
            pass

    def choose(self, handle: viser.GuiInputHandle, value: object) -> None:
        """Change a control of the panel."""
        message = {
            "type": "GuiUpdateMessage",
            "uuid": handle._impl.uuid,
            "updates": {"value": value},
        }
        self._socket.send(msgspec.msgpack.encode(message))

    def leave(self) -> None:
        """Close the page."""
        self._socket.close()
        self._reader.join(5)

    def vanish(self) -> None:
        """Drop the connection without closing it."""
        self._socket.socket.close()
