"""A silent web server that only this machine can reach."""

from __future__ import annotations

import socket
from contextlib import redirect_stdout
from io import StringIO

import viser


def open_server(port: int) -> viser.ViserServer:
    """Return a web server that only this machine can reach.

    Args:
        port: Port of 127.0.0.1; 0 for any free one.

    Raises:
        OSError: If the port is taken.
    """
    # viser would use another port instead.
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind(("127.0.0.1", port))
        except OSError as error:
            raise OSError(
                f"port {port} of 127.0.0.1 is already in use: choose another --port"
            ) from error
    with redirect_stdout(StringIO()):
        return viser.ViserServer(host="127.0.0.1", port=port, verbose=False)


def stop_server(server: viser.ViserServer) -> None:
    """Stop a server, which closes its page for all visitors."""
    with redirect_stdout(StringIO()):
        server.stop()
