"""An actor's connection to the replay service: a separate session, for Zenoh accepts no new endpoints at run time."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from typing import Self

import zenoh

from common.messaging.transport import Node, Pending


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

    def begin(self, key: str, payload: bytearray, timeout: float) -> Pending:
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
        old.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._node.close()

    def _open(self, endpoints: Sequence[str]) -> Node:
        return Node(self._open_route(endpoints), self.run, "route", self._incarnation)
