"""Who of a run is there, by name: joins, farewells and liveliness tokens become events. Time comes in."""

from __future__ import annotations

import threading
from collections.abc import Callable

from common.messaging.messages.join import Join

FORGOTTEN = 60.0  # seconds after which one that is lost is no longer missed


class Attendance:
    """Names the members of a run; safe for threads.

    Args:
        event: told each event, in words.
    """

    def __init__(self, event: Callable[[str], None]) -> None:
        self._event = event
        self._lock = threading.RLock()  # events come in the order in which things happen
        self._names: dict[int, str] = {}
        self._leaving: set[int] = set()
        self._away: set[int] = set()
        self._roles: dict[int, str] = {}
        self._lost: dict[int, float] = {}  # those away that nobody has replaced, and since when

    def joined(self, request: Join, name: str) -> None:
        """Note a join, the first of this process or one after a restart of the learner."""
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
        """Note that a process is about to end well."""
        with self._lock:
            self._leaving.add(incarnation)

    def token(self, incarnation: int, there: bool, now: float) -> None:
        """Note that the liveliness token of a process has come or gone."""
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
        """Names of those that are lost, and that no other of their role has replaced."""
        with self._lock:
            return [self._names[who] for who, since in self._lost.items() if now - since < FORGOTTEN]
