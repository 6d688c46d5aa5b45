"""Answers over HTTP whether this process works, for container engines; run as a module, asks another process.

A role's main loop reports its progress twice a second, also while it waits for another role: a container engine must
not restart an actor because the learner is away.
"""

from __future__ import annotations

import json
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from common.errors import RunError, UsageError
from common.process.console import Console

if TYPE_CHECKING:
    from http.server import BaseHTTPRequestHandler

STUCK = 60.0  # seconds without a turn of the main loop; an epoch or a compilation may take half of that
QUESTION_TIMEOUT = 5.0  # seconds


@contextmanager
def answering(address: str | None, console: Console) -> Iterator[None]:
    """Answer on HOST:PORT, in a thread of its own; do nothing if that is None.

    `GET /` has the status 503 once the main loop stands still, else 200; `GET /ready` has 200 only while it runs.

    Raises:
        UsageError: the address is not HOST:PORT.
        RunError: this process can't listen there.
    """
    if address is None:
        yield
        return
    from http.server import HTTPServer  # noqa: PLC0415 (most processes answer nobody)

    try:
        server = HTTPServer(host_and_port(address), _handler(console))
    except OSError as error:
        raise RunError(f"--health {address}: {error.strerror or error}") from error
    thread = threading.Thread(target=server.serve_forever, name="health", daemon=True)
    thread.start()
    try:
        yield
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


def host_and_port(address: str) -> tuple[str, int]:
    """The parts of HOST:PORT; raises UsageError."""
    host, _, port = address.rpartition(":")
    if not (host and port.isdecimal() and int(port) < 2**16):
        raise UsageError(f"--health {address}: HOST:PORT with a port from 0 to 65535 is needed")
    return host, int(port)


def state(idle: float | None) -> str:
    """A process's state; idle: seconds since its main loop's last turn, None before the first."""
    if idle is None:
        return "starting"
    return "working" if idle < STUCK else "stuck"


def _handler(console: Console) -> type[BaseHTTPRequestHandler]:
    from http.server import BaseHTTPRequestHandler  # noqa: PLC0415 (as above)

    class Handler(BaseHTTPRequestHandler):
        timeout = QUESTION_TIMEOUT

        def do_GET(self) -> None:
            reported = console.reported
            idle = None if reported is None else time.monotonic() - reported
            now = state(idle)
            well = now == "working" if self.path == "/ready" else now != "stuck"
            body = json.dumps({"state": now, "idle_seconds": idle}).encode()
            self.send_response(200 if well else 503)
            self.send_header("Content-Type", "application/json")
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, *_: object) -> None:
            """Say nothing: the console is the role's."""

    return Handler


def main() -> None:
    """Ask the process on HOST:PORT, print its answer, and end with status 0 if it is well."""
    import http.client  # noqa: PLC0415 (as above)

    if len(sys.argv) != 2:
        sys.exit("usage: python -m common.process.health HOST:PORT")
    connection = http.client.HTTPConnection(*host_and_port(sys.argv[1]), timeout=QUESTION_TIMEOUT)
    try:
        connection.request("GET", "/")
        answer = connection.getresponse()
        print(answer.read().decode())
        sys.exit(answer.status != 200)
    except OSError as error:
        sys.exit(f"{sys.argv[1]}: {error.strerror or error}")
    finally:
        connection.close()


if __name__ == "__main__":
    main()
