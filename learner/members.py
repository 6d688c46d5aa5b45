"""The run's members by name: joins, farewells and liveliness tokens become events. Time is an argument."""

from __future__ import annotations

import threading
from collections.abc import Callable

from common.messaging.messages.join import Join

FORGOTTEN = 60.0  # seconds after which a lost member is no longer listed as missing


class MemberTracker:
    """Names the members of a run and reports their coming and going; thread-safe.

    Args:
        event: called with a line for each event.
    """

    def __init__(self, event: Callable[[str], None]) -> None:
        self._event = event
        self._lock = threading.RLock()  # keeps events in order
        self._names: dict[int, str] = {}
        self._leaving: set[int] = set()
        self._away: set[int] = set()
        self._roles: dict[int, str] = {}
        self._lost: dict[int, float] = {}  # members away that no other has replaced, and since when

    def joined(self, request: Join, name: str) -> None:
        """Note a join: the first of a process, or one after the learner's restart."""
        with self._lock:
            who = request.incarnation
            if who in self._names:
                return
            self._names[who], self._roles[who] = f"{name} on {request.origin}", request.role
            replaced = next((lost for lost in self._lost if self._roles[lost] == request.role), None)
            if replaced is not None:
                del self._lost[replaced]
            listens = f"; it listens on {', '.join(request.endpoints)}" if request.endpoints else ""
            self._event(f"{self._names[who]} {'joined' if request.index < 0 else 'is back'}{listens}")

    def leaving(self, incarnation: int) -> None:
        """Note that a process is about to end properly."""
        with self._lock:
            self._leaving.add(incarnation)

    def token(self, incarnation: int, there: bool, now: float) -> None:
        """Note that a process's liveliness token has appeared or disappeared."""
        with self._lock:
            name = self._names.get(incarnation)
            if name is None:
                return
            if there and incarnation in self._away:
                self._away.discard(incarnation)
                self._lost.pop(incarnation, None)
                self._event(f"{name} is back")
            elif not there and incarnation in self._leaving:
                self._leaving.discard(incarnation)
                del self._names[incarnation], self._roles[incarnation]
                self._event(f"{name} left")
            elif not there and incarnation not in self._away:
                self._away.add(incarnation)
                self._lost[incarnation] = now
                self._event(f"{name} does not answer")

    def missing(self, now: float) -> list[str]:
        """Names of the lost members that no other of their role has replaced."""
        with self._lock:
            return [self._names[who] for who, since in self._lost.items() if now - since < FORGOTTEN]
