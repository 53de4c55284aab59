"""Web server on this machine."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, SimpleHTTPRequestHandler, ThreadingHTTPServer
from typing import Any


class QuietHandler(SimpleHTTPRequestHandler):
    """Handler that serves a folder, its argument ``directory``, without logging."""

    def log_message(self, *_: object) -> None:
        """Ignore the message."""


@contextmanager
def running_server(handler: Callable[..., BaseHTTPRequestHandler]) -> Iterator[str]:
    """Run a server within the context.

    Args:
        handler: Class that answers requests, or a function that creates its objects.

    Yields:
        Address of the server.
    """
    server = ThreadingHTTPServer(("127.0.0.1", 0), handler)
    # The interval bounds the time that the shutdown takes.
    options: dict[str, Any] = {"poll_interval": 0.02}
    thread = threading.Thread(target=server.serve_forever, kwargs=options, daemon=True)
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_address[1]}"
    finally:
        server.shutdown()
        server.server_close()
        thread.join()
