"""What the pages share: a server for this machine alone, requests and errors.

Contract: requests of visitors arrive on threads of the server; they are queued, and one
thread handles them.
"""

from __future__ import annotations

import html
import queue
import socket
from collections.abc import Callable
from contextlib import redirect_stdout
from io import StringIO
from threading import Thread
from typing import Any

import viser


def slider_value(slider: viser.GuiSliderHandle) -> float:
    """Return the value of a slider, within its limits.

    A number being typed in the box beside a slider arrives at every key, and unchecked.
    """
    return min(max(slider.value, slider.min), slider.max)


class ServedPage:
    """An empty page with a queue of requests and a place for an error text.

    Only this machine can reach it, and it prints nothing.

    Args:
        port: Port of 127.0.0.1; 0 for any free one.

    Raises:
        OSError: If the port cannot be used.
    """

    def __init__(self, port: int) -> None:
        # viser would use another port instead.
        with socket.socket() as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind(("127.0.0.1", port))
            except OSError as error:
                raise OSError(
                    f"port {port} of 127.0.0.1: {error.strerror}; choose another --port"
                ) from error
        with redirect_stdout(StringIO()):
            self.server = viser.ViserServer(host="127.0.0.1", port=port, verbose=False)
        gui = self.server.gui
        gui.configure_theme(
            show_logo=False,
            show_share_button=False,
            control_width="medium",
            brand_color=(28, 126, 214),
        )
        gui.set_panel_label("egoskin")
        self.error = ""
        """Text of the last error; "" if there is none."""
        self._error_text = gui.add_markdown("", visible=False)
        self._commands: queue.Queue[Callable[[], object]] = queue.Queue()

    @property
    def address(self) -> str:
        """URL of the page."""
        return f"http://127.0.0.1:{self.server.get_port()}"

    def close(self) -> None:
        """Close the page for all visitors."""
        with redirect_stdout(StringIO()):
            stopping = Thread(target=self.server.stop, daemon=True)
            stopping.start()
            # viser waits longer for a visitor that is suspended.
            stopping.join(2.0)

    def show_error(self, text: str) -> None:
        """Show an error text; "" hides it."""
        self.error = text
        self._error_text.visible = bool(text)
        if text:
            self._error_text.content = f"**Error.** {html.escape(text)}"

    def _ask(self, request: Callable[..., object], *args: Any) -> None:
        """Queue a function; any thread may call this."""
        self._commands.put(lambda: request(*args))

    def _do(self, request: Callable[[], object]) -> None:
        """Call a function; an exception is shown on the page and does not end it."""
        try:
            request()
        # A policy, a file or a robot that does not fit may raise anything.
        except Exception as error:
            self.show_error(f"{type(error).__name__}: {error}")
