"""The queries that wait for one thread's answers, bounded in number and in bytes.

Zenoh bounds its queue by number alone, and blocks the thread that receives everything else once that is full. So while
an answer takes long, as one that the limiter holds, what arrives meanwhile is taken over here, and what would be too
much is given back unanswered: its sender asks again, as after any loss.
"""

from __future__ import annotations

import contextlib
import threading
from collections import deque
from collections.abc import Callable, Iterable
from typing import Any

import zenoh

from coop.common.errors import BadMessage

QUEUE = 1 << 14  # queries that wait for an answer
MOST_WAITING = 1 << 27  # bytes of them; a single one may have more
LOOK_EVERY = 0.05  # seconds, in which no link brings nearly as much


class Backlog:
    """The queries of one key.

    Args:
        queryable: Zenoh's, with a queue of `QUEUE` queries.
        refuse: called with the reason for each query that is given back.
    """

    def __init__(self, queryable: Any, refuse: Callable[[BadMessage], None]) -> None:  # noqa: ANN401
        self._queryable = queryable
        self._refuse = refuse
        self._lock = threading.Lock()
        self._taken: deque[tuple[Any, int]] = deque()  # queries, older than those in Zenoh's queue, and their bytes
        self._bytes = 0
        self._answering = False

    def next(self) -> Any:  # noqa: ANN401 (zenoh's query)
        """Wait for the next query; raises `zenoh.ZError` once the session is closed."""
        with self._lock:
            self._answering = bool(self._taken)
            if self._taken:
                query, size = self._taken.popleft()
                self._bytes -= size
                return query
        query = self._queryable.recv()
        self._answering = True
        return query

    def relieve(self) -> None:
        """Take over what has arrived while a query is being answered."""
        with self._lock, contextlib.suppress(zenoh.ZError):  # the session was closed
            while self._answering and (query := self._queryable.try_recv()) is not None:
                size = sum(len(part) for part in (query.payload, query.attachment) if part is not None)
                if self._taken and (self._bytes + size > MOST_WAITING or len(self._taken) >= QUEUE):
                    with query:
                        waiting = f"{len(self._taken):,} messages of {self._bytes:,} bytes wait already"
                        self._refuse(BadMessage("payload", f"{size:,} bytes, while {waiting}; it may be sent again"))
                else:
                    self._taken.append((query, size))
                    self._bytes += size


def relieve(backlogs: Iterable[Backlog], closing: threading.Event) -> None:
    """Relieve each of these again and again, until the closing."""
    while not closing.wait(LOOK_EVERY):
        for backlog in backlogs:
            backlog.relieve()
