"""Tracks which members of a run are connected to this process, by Zenoh's liveliness tokens.

A token disappears within milliseconds after its process ends, or within the lease if the process is frozen or cut off.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

import zenoh

from coop.common.errors import BadMessage
from coop.common.messaging.faults import Faults
from coop.common.messaging.keys import incarnation_of
from coop.common.messaging.members import ROLES, ROUTE


class Presence:
    """The liveliness tokens of a run's members.

    Args:
        now: the process's clock.
    """

    def __init__(self, now: Callable[[], float] = time.monotonic) -> None:
        self._now = now
        self._there: dict[str, set[str]] = {}  # incarnations by role
        self._gone: dict[str, float] = {}  # by role, when its last member disappeared
        self._lock = threading.Lock()
        self._on_change: Callable[[str, int, bool], None] = lambda role, incarnation, there: None
        self._began = now()

    def watch(
        self, session: zenoh.Session, prefix: str, faults: Faults, refuse: Callable[[str, BadMessage], None]
    ) -> None:
        """Follow the tokens of a session.

        Args:
            prefix: key of the tokens, which is followed by ROLE/INCARNATION.
            faults: records bugs of this program in Zenoh's threads.
            refuse: called with the key of a token that names no incarnation, and why it doesn't.
        """

        def on_token(sample: zenoh.Sample) -> None:
            role = str(sample.key_expr).split("/")[-2]
            try:
                self.note(role, incarnation_of(str(sample.key_expr)), sample.kind == zenoh.SampleKind.PUT)
            except BadMessage as error:
                refuse(f"{prefix}/{role}", error)

        for role in (*ROLES, ROUTE):  # one subscriber each: access control may let a process see only some roles
            session.liveliness().declare_subscriber(
                f"{prefix}/{role}/*", faults.guarded("watching who is there", on_token), history=True
            )

    def on_change(self, call: Callable[[str, int, bool], None]) -> None:
        """Call `call(role, incarnation, there)`, in one of Zenoh's threads, whenever a member appears or disappears."""
        self._on_change = call

    def counts(self) -> dict[str, int]:
        """Number of connected processes by role, and of connections of actors by `ROUTE`."""
        with self._lock:
            return {role: len(incarnations) for role, incarnations in self._there.items() if incarnations}

    def members(self, role: str) -> set[str]:
        """Incarnations of a role's connected processes."""
        with self._lock:
            return set(self._there.get(role, ()))

    def absence(self, role: str) -> float:
        """Seconds for which no process of this role has been connected; 0 while one is."""
        with self._lock:
            if self._there.get(role):
                return 0.0
            return self._now() - self._gone.get(role, self._began)

    def note(self, role: str, number: int, there: bool) -> None:
        """Note that the token of an incarnation has appeared or disappeared."""
        incarnation = f"{number:x}"
        with self._lock:
            incarnations = self._there.setdefault(role, set())
            if there:
                incarnations.add(incarnation)
            else:
                incarnations.discard(incarnation)
                self._gone[role] = self._now()
        self._on_change(role, number, there)
