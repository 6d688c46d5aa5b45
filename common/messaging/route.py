"""An actor's connection to the replay service: a session of its own, or the link that it has to a router.

A session of its own, for Zenoh accepts no new endpoints at run time; behind a router, one link carries everything.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Self

import zenoh

from coop.common.errors import JoinError
from coop.common.messaging.conversation import Answer
from coop.common.messaging.members import ROUTE
from coop.common.messaging.session import open_session
from coop.common.messaging.timing import ASK_TIMEOUT, RETRY_PAUSE
from coop.common.messaging.transport import NoAnswer, Node
from coop.common.process.lifecycle import Stop

CLOSING = "closing a route"  # name of a thread


def open_client(
    router: Sequence[str], zenoh_config: Path | None, shared_memory: bool, timeout: float, stop: Stop
) -> zenoh.Session | None:
    """Open a client's session as soon as a router answers; return None if a stop was requested first.

    Raises:
        JoinError: none has answered within `timeout` seconds.
    """
    deadline = time.monotonic() + timeout
    while not stop.is_set():
        try:
            return open_session((), router, zenoh_config, shared_memory, mode="client")
        except NoAnswer as error:
            if time.monotonic() > deadline:
                raise JoinError(f"{error} within {timeout:g} s") from error
            stop.wait(RETRY_PAUSE)
    return None


class ReplayRoute:
    """Carries queries to the replay service; opens a new session when the service listens elsewhere.

    Queries in flight on the old session remain unanswered, and the caller must send them again.

    Args:
        open_route: opens a session with the given endpoints.
        endpoints: where the replay service listens now.
    """

    def __init__(
        self,
        run: str,
        incarnation: int,
        open_route: Callable[[Sequence[str]], zenoh.Session],
        endpoints: Sequence[str],
    ) -> None:
        self.run = run
        self._incarnation = incarnation
        self._open_route = open_route
        self._endpoints = set(endpoints)
        self._lock = threading.Lock()
        self._node = self._open(endpoints)

    @property
    def is_up(self) -> bool:
        """True while a replay service is connected."""
        return bool(self._node.presence.members("replay"))

    def key(self, *parts: str) -> str:
        """See `Node`."""
        return self._node.key(*parts)

    def now(self) -> float:
        """See `Node`."""
        return self._node.now()

    def begin(self, key: str, payload: bytearray, timeout: float = ASK_TIMEOUT) -> Answer:
        """See `Node`."""
        with self._lock:
            return self._node.begin(key, payload, timeout)

    def follow(self, endpoints: Sequence[str]) -> None:
        """Open a new session if the replay service now listens at other endpoints."""
        if not endpoints or set(endpoints) == self._endpoints:
            return
        node = self._open(endpoints)
        with self._lock:
            old, self._node, self._endpoints = self._node, node, set(endpoints)
        self._retire(old)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._node.close()

    def _retire(self, node: Node) -> None:
        """Close it in a thread of its own, for which the process waits: up to 10 s where nobody answers."""
        threading.Thread(target=node.close, name=CLOSING).start()

    def _open(self, endpoints: Sequence[str]) -> Node:
        return Node(self._open_route(endpoints), self.run, ROUTE, self._incarnation)


class RoutedReplay:
    """What `ReplayRoute` is, behind a router, which knows where the replay service is.

    Args:
        node: of a client's session.
    """

    def __init__(self, node: Node) -> None:
        self.run = node.run
        self.key = node.key
        self.begin = node.begin
        self.now = node.now
        self._node = node

    @property
    def is_up(self) -> bool:
        """True while a replay service is connected to the router."""
        return bool(self._node.presence.members("replay"))

    def follow(self, endpoints: Sequence[str]) -> None:
        """Do nothing: the router follows."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        """Do nothing: the session is the node's."""
