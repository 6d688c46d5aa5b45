"""The run's members by name: joins, farewells and liveliness tokens become events. Time is an argument."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass

from coop.common.messaging.members import ROLES, Origin
from coop.common.messaging.messages.join import Join
from coop.common.messaging.messages.status import ActorStatus, Member

FORGOTTEN = 60.0  # seconds after which a lost member is no longer listed as missing


@dataclass(frozen=True, slots=True)
class _Joined:
    """A process that has joined; name: its role, and an actor's number."""

    name: str
    role: str
    origin: Origin

    def __str__(self) -> str:
        return f"{self.name} on {self.origin}"


class MemberTracker:
    """Names the members of a run and reports their coming and going; thread-safe.

    Args:
        event: called with a line for each event.
    """

    def __init__(self, event: Callable[[str], None]) -> None:
        self._event = event
        self._lock = threading.RLock()  # keeps events in order
        self._joined: dict[int, _Joined] = {}
        self._actors: dict[int, ActorStatus] = {}  # the newest statuses
        self._leaving: set[int] = set()
        self._away: set[int] = set()
        self._lost: dict[int, float] = {}  # members away that no other has replaced, and since when

    def add(self, request: Join, name: str) -> None:
        """Note a join: the first of a process, or one after the learner's restart."""
        with self._lock:
            who = request.incarnation
            if who in self._joined:
                return
            self._joined[who] = _Joined(name, request.role, request.origin)
            replaced = next((lost for lost in self._lost if self._joined[lost].role == request.role), None)
            if replaced is not None:
                del self._lost[replaced]
            listens = f"; it listens on {', '.join(request.endpoints)}" if request.endpoints else ""
            self._event(f"{self._joined[who]} {'joined' if request.index < 0 else 'is back'}{listens}")

    def leaving(self, incarnation: int) -> None:
        """Note that a process is about to end properly."""
        with self._lock:
            if incarnation in self._joined:  # of others nothing is kept, whoever announces them
                self._leaving.add(incarnation)

    def token(self, incarnation: int, there: bool, now: float) -> None:
        """Note that a process's liveliness token has appeared or disappeared."""
        with self._lock:
            name = self._joined.get(incarnation)
            if name is None:
                return
            if there and incarnation in self._away:
                self._away.discard(incarnation)
                self._lost.pop(incarnation, None)
                self._event(f"{name} is back")
            elif not there and incarnation in self._leaving:
                self._leaving.discard(incarnation)
                del self._joined[incarnation]
                self._actors.pop(incarnation, None)
                self._event(f"{name} left")
            elif not there and incarnation not in self._away:
                self._away.add(incarnation)
                self._lost[incarnation] = now
                self._event(f"{name} does not answer")

    def report(self, incarnation: int, status: ActorStatus) -> None:
        """Note an actor's status."""
        with self._lock:
            if incarnation in self._joined:
                self._actors[incarnation] = status

    def missing(self, now: float) -> list[str]:
        """Names of the lost members that no other of their role has replaced."""
        with self._lock:
            return [str(self._joined[who]) for who in self._missing(now)]

    def listed(self, now: float, most: int) -> list[Member]:
        """The missing members, the replay service and the other roles, each in the order in which they joined.

        most: members in the list.
        """
        with self._lock:
            lost = set(self._missing(now))
            shown = [who for who in self._joined if who in lost or who not in self._away]
            shown.sort(key=lambda who: (who not in lost, ROLES.index(self._joined[who].role)))
            return [self._member(who, lost=who in lost) for who in shown[:most]]

    def _missing(self, now: float) -> list[int]:
        return [who for who, since in self._lost.items() if now - since < FORGOTTEN]

    def _member(self, who: int, *, lost: bool) -> Member:
        one, status = self._joined[who], self._actors.get(who)
        place = one.name, one.role, one.origin.host, one.origin.pid
        if lost:
            return Member(*place, "lost")
        if one.role == "replay":
            return Member(*place, "serving")
        if status is None:
            return Member(*place, "playing")
        return Member(*place, "waiting" if status.waiting else "playing", status.steps_per_s, status.waiting)
