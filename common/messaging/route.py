"""The way from an actor to the replay service: a session of its own, for Zenoh takes no new endpoints at run time."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from typing import Self

import zenoh

from common.messaging.transport import Node, Pending


class ReplayRoute:
    """Carries queries to the replay service; a new session takes over when that listens elsewhere than before.

    What was under way on the old session remains without an answer, and is to be sent again.

    Args:
        open_route: opens a session with these endpoints.
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
        """Take another way if the replay service listens elsewhere now."""
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
