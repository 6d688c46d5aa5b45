"""Answers over HTTP whether this process works, for container engines; run as a module, asks another process.

A role's main loop reports its progress twice a second, also while it waits for another role: a container engine must
not restart an actor because the learner is away.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager

from coop.common.errors import RunError, UsageError
from coop.common.process.console import Console
from coop.common.process.lifecycle import ProcessExit, run_main
from coop.common.process.ports import http_address

STUCK = 60.0  # seconds without a turn of the main loop; a checkpoint or a compilation may take half of that
QUESTION_TIMEOUT = 5.0  # seconds


@contextmanager
def answering(address: str, console: Console) -> Iterator[None]:
    """Answer on PORT or HOST:PORT, in threads of its own; do nothing if that is empty.

    `GET /` has the status 503 once the main loop stands still, else 200; `GET /ready` has 200 only while it runs.

    Raises:
        UsageError: this process can't listen there.
    """
    if not address:
        yield
        return
    from coop.monitor.web import Document, WebServer  # noqa: PLC0415 (most processes answer nobody)

    def answer(well: Callable[[str], bool]) -> Document:
        idle = None if console.reported is None else time.monotonic() - console.reported
        now = state(idle)
        body = json.dumps({"state": now, "idle_seconds": idle}).encode()
        return Document("application/json", body, 200 if well(now) else 503)

    documents = {
        "/": lambda: answer(lambda now: now != "stuck"),
        "/ready": lambda: answer(lambda now: now == "working"),
    }
    with closing(WebServer("--health", address, documents)):
        yield


def state(idle: float | None) -> str:
    """A process's state; idle: seconds since its main loop's last turn, None before the first."""
    if idle is None:
        return "starting"
    return "working" if idle < STUCK else "stuck"


def main() -> None:
    """Ask the process on PORT or HOST:PORT, print its answer, and end with status 0 if it is well."""
    run_main("health", _ask)


def _ask() -> None:
    import http.client  # noqa: PLC0415 (as above)

    if len(sys.argv) != 2:
        raise UsageError("usage: python -m coop.monitor.health [HOST:]PORT")
    connection = http.client.HTTPConnection(*http_address("health", sys.argv[1]), timeout=QUESTION_TIMEOUT)
    with closing(connection):
        try:
            connection.request("GET", "/")
            answer = connection.getresponse()
            print(answer.read().decode())
        except OSError as error:
            raise RunError(f"{sys.argv[1]}: {error.strerror or error}") from error
    raise ProcessExit(int(answer.status != 200))


if __name__ == "__main__":
    main()
