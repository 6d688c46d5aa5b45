"""The members of a run: numbers that are given once, the single active replay service, and who is there by name.

Time is an argument. A roster outlives its learner: every decision is on disk before any process learns of it.
"""

from __future__ import annotations

import json
import math
import threading
from collections.abc import Callable, Collection
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from coop.common.errors import BadMessage, RunError
from coop.common.messaging.members import ROLES, Origin
from coop.common.messaging.messages.control import Join
from coop.common.messaging.messages.status import MAX_MISSING, ActorStatus, Member
from coop.common.messaging.timing import FORGOTTEN, LEASE
from coop.common.process.files import sealed, unsealed, write_atomic
from coop.common.process.untrusted import MAX_SETTINGS, read_bytes
from coop.records.run_ids import check_owner

ROSTER = "roster.json"
MOST_KEPT = 4096  # members that are remembered before those that are gone are forgotten
RESERVE = 8  # a roster of n actors saves n / 8 numbers in advance, which a restarted learner leaves out


class AlreadyServed(RunError):
    """Another replay service serves this run, or may still be serving it."""


@dataclass(frozen=True, slots=True)
class _Entries:
    """The roster's state on disk.

    run: id of the run. actors: how many numbers may have been given. replays: how many have been given.
    serving: incarnation of the active replay service, which has the last number; -1 before the first. host, pid: of
    that service.
    """

    run: int = -1
    actors: int = 0
    replays: int = 0
    serving: int = -1
    host: str = ""
    pid: int = 0


class Roster:
    """Numbers the members of a run, and admits one replay service at a time; thread-safe.

    A replay service that receives nothing from the learner for `LEASE` seconds stops acknowledging. So once the learner
    has not confirmed it for that long, and its liveliness token is gone, another one may take over.

    Args:
        folder: where the roster is saved; it is not saved if None.
        run_id: of the run that the folder belongs to.
        now: seconds; the learner must assume that the last replay service was confirmed just before.

    Raises:
        RunError: the file in `folder` cannot be read.
    """

    def __init__(self, folder: Path | None = None, now: float = 0.0, run_id: int = -1) -> None:
        self._path = None if folder is None else folder / ROSTER
        self._lock = threading.Lock()
        self._entries = _Entries(run_id)
        self._confirmed = now
        self._given = 0  # numbers of actors
        self._actors: dict[int, int] = {}  # numbers of the actors known to this learner, by incarnation
        try:
            if self._path is not None and self._path.exists():
                self._entries = _Entries(**json.loads(unsealed(read_bytes(self._path, MAX_SETTINGS))))
                check_owner(self._path, self._entries.run, run_id)
                self._given = self._entries.actors
        except (OSError, ValueError, TypeError, RecursionError) as error:
            raise RunError(f"{self._path}: {error}") from error

    @property
    def serving(self) -> int:
        """Incarnation of the active replay service; -1 before the first."""
        return self._entries.serving

    def actor(self, request: Join) -> int:
        """The number of an actor: its earlier one, or a new one.

        Raises:
            BadMessage: it claims a number that no actor was given.
            RunError: the roster cannot be saved.
        """
        with self._lock:
            if request.index >= self._given:
                raise BadMessage("fields.index", f"{request.index}; {self._given} actors have been numbered")
            if request.index >= 0:
                self._actors[request.incarnation] = request.index
            elif request.incarnation not in self._actors:
                if self._given == self._entries.actors:
                    # Saving takes longer than all else, so of many actors not each one waits for the disk.
                    self._keep(replace(self._entries, actors=self._given + 1 + self._given // RESERVE))
                self._actors[request.incarnation] = self._given
                self._given += 1
            return self._actors[request.incarnation]

    def replay(self, request: Join, now: float, there: Collection[int]) -> int:
        """The number of a replay service, which may serve for another `LEASE` seconds.

        there: incarnations of the replay services whose liveliness tokens exist.

        Raises:
            AlreadyServed: another one serves, or may still be serving.
            RunError: another one has taken over from this one, or the roster cannot be saved.
        """
        with self._lock:
            entries = self._entries
            if request.incarnation != entries.serving:
                other = Origin(entries.host, entries.pid)
                if entries.serving >= 0 and request.index >= 0:
                    raise RunError(f"the replay service on {other} has taken over from this one")
                if entries.serving >= 0 and (entries.serving in there or now - self._confirmed < LEASE):
                    raise AlreadyServed(f"the replay service on {other} serves this run")
                host, pid = request.origin
                self._keep(_Entries(entries.run, entries.actors, entries.replays + 1, request.incarnation, host, pid))
            self._confirmed = now
            return self._entries.replays - 1

    def forget(self, there: Collection[int]) -> None:
        """Forget the actors' numbers but those of these incarnations; an actor that has one names it itself."""
        with self._lock:
            self._actors = {who: number for who, number in self._actors.items() if who in there}

    def dismiss(self, incarnation: int) -> None:
        """Note that a replay service has stopped acknowledging: another one may follow as soon as it is gone."""
        with self._lock:
            if incarnation == self._entries.serving:
                self._confirmed = -math.inf

    def _keep(self, entries: _Entries) -> None:
        """Save the entries and then use them; raises RunError."""
        if self._path is not None:
            try:
                write_atomic(self._path, sealed(json.dumps(asdict(entries)).encode()))
            except OSError as error:
                raise RunError(f"{self._path}: {error.strerror or error}") from error
        self._entries = entries


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
        self._most = MOST_KEPT

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

    def forget(self, present: Callable[[], Collection[int]]) -> Collection[int] | None:
        """Forget those whose tokens are gone, once there are too many members; return the others then.

        present: returns the incarnations whose tokens exist.
        """
        with self._lock:
            if len(self._joined) <= self._most:
                return None
            there = present()
            for who in self._joined.keys() - there:
                del self._joined[who]
                self._actors.pop(who, None)
                self._lost.pop(who, None)
            self._leaving &= self._joined.keys()
            self._away &= self._joined.keys()
            self._most = max(MOST_KEPT, 2 * len(self._joined))
            return there

    def leaving(self, incarnation: int) -> None:
        """Note that a process is about to end properly."""
        with self._lock:
            if incarnation in self._joined:  # of others nothing is kept, whoever announces them
                self._leaving.add(incarnation)

    def token(self, role: str, incarnation: int, there: bool, now: float) -> None:
        """Note that a process's liveliness token has appeared or disappeared; of another role than its own it is none.

        Access control keeps actors from the tokens of other roles, but not from their incarnations in one of theirs.
        """
        with self._lock:
            name = self._joined.get(incarnation)
            if name is None or name.role != role:
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
        """Names of the lost members that no other of their role has replaced, at most `MAX_MISSING`."""
        with self._lock:
            return [str(self._joined[who]) for who in self._missing(now)[:MAX_MISSING]]

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
