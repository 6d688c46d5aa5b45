"""Serves a few documents over HTTP, from threads of its own."""

from __future__ import annotations

import sys
import threading
from collections.abc import Callable, Mapping
from http.server import BaseHTTPRequestHandler
from socketserver import ThreadingTCPServer
from typing import NamedTuple

from coop.common.errors import UsageError
from coop.common.process.ports import family, http_address

# A page carries its script and styles, and loads nothing from elsewhere.
POLICY = "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src data:; connect-src 'self'"


class Document(NamedTuple):
    """An answer. kind: its content type."""

    kind: str
    body: bytes
    status: int = 200


Documents = Mapping[str, Callable[[], Document]]


class WebServer:
    """Answers GET until it is closed.

    Args:
        flag, address: PORT or HOST:PORT, and the flag that gave it.
        documents: functions that give the answers, by path; they are called from several threads.

    Attributes:
        port: it listens there.
        url: of the path "/".

    Raises:
        UsageError: it can't listen there.
    """

    def __init__(self, flag: str, address: str, documents: Documents) -> None:
        host, port = http_address(flag, address)

        class Handler(_Handler):
            served = documents

        class Server(_Server):
            address_family = family(host)

        try:
            self._server = Server((host, port), Handler)
        except OSError as error:
            raise UsageError(f"{flag} {address}: {error.strerror or error}") from error
        self.port: int = self._server.server_address[1]
        named = f"[{host}]" if ":" in host else host
        self.url = f"http://{named}:{self.port}/"
        self._thread = threading.Thread(target=self._server.serve_forever, args=(0.1,), name="web server")
        self._thread.start()

    def close(self) -> None:
        """Stop serving."""
        self._server.shutdown()
        self._thread.join()
        self._server.server_close()


class _Server(ThreadingTCPServer):
    allow_reuse_address = True
    daemon_threads = True
    block_on_close = False

    def handle_error(self, request: object, client_address: object) -> None:
        """Say nothing of a browser that has gone."""
        if not isinstance(sys.exception(), ConnectionError):
            super().handle_error(request, client_address)  # type: ignore[arg-type]


class _Handler(BaseHTTPRequestHandler):
    served: Documents
    timeout = 10.0  # seconds

    def do_GET(self) -> None:
        """Answer one request."""
        if self.path not in self.served:
            self.send_error(404)
            return
        document = self.served[self.path]()
        self.send_response(document.status)
        for name, value in (
            ("Content-Type", document.kind),
            ("Content-Length", str(len(document.body))),
            ("Cache-Control", "no-store"),
            ("Content-Security-Policy", POLICY),
        ):
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(document.body)

    def log_message(self, *_: object) -> None:
        """Say nothing: the terminal shows the run."""
