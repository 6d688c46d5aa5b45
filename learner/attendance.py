"""Who of a run is there, by name: joins, farewells and liveliness tokens become events. Time comes in."""

from __future__ import annotations

import threading
from collections.abc import Callable

FORGOTTEN = 60.0  # seconds after which one that is lost is no longer missed


class Attendance:
    """Names the members of a run; safe for threads.

    Args:
        event: told each event, in words.
    """

    def __init__(self, event: Callable[[str], None]) -> None:
        self._event = event
        self._lock = threading.RLock()  # events come in the order in which things happen
        self._names: dict[tuple[str, int], str] = {}
        self._leaving: set[tuple[str, int]] = set()
        self._away: set[tuple[str, int]] = set()
        self._lost: dict[tuple[str, int], float] = {}  # those away that nobody has replaced, and since when

    def joined(self, role: str, incarnation: int, name: str, *, again: bool, listens: str = "") -> None:
        """Note a join, the first of this process or, `again`, one after a restart of the learner."""
        with self._lock:
            who = role, incarnation
            if who in self._names:
                return
            self._names[who] = name
            replaced = next((lost for lost in self._lost if lost[0] == role), None)
            if replaced is not None:
                del self._lost[replaced]
            self._event(f"{name} {'is back' if again else 'joined'}{listens and f'; it listens on {listens}'}")

    def leaving(self, role: str, incarnation: int) -> None:
        """Note that a process is about to end well."""
        with self._lock:
            self._leaving.add((role, incarnation))

    def token(self, role: str, incarnation: int, there: bool, now: float) -> None:
        """Note that the liveliness token of a process has come or gone."""
        with self._lock:
            who = role, incarnation
            name = self._names.get(who)
            if name is None:
                return
            if there and who in self._away:
                self._away.discard(who)
                self._lost.pop(who, None)
                self._event(f"{name} is back")
            elif not there and who in self._leaving:
                self._leaving.discard(who)
                del self._names[who]
                self._event(f"{name} left")
            elif not there and who not in self._away:
                self._away.add(who)
                self._lost[who] = now
                self._event(f"{name} does not answer")

    def missing(self, now: float) -> list[str]:
        """Names of those that are lost, and that no other of their role has replaced."""
        with self._lock:
            return [self._names[who] for who, since in self._lost.items() if now - since < FORGOTTEN]
