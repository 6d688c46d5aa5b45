"""Who of a run is connected to this process, and who has gone: told by Zenoh's liveliness tokens.

A token disappears within milliseconds of its process, and within the lease of a process that is frozen or cut off.
"""

from __future__ import annotations

import os
import socket
import threading
import time
from collections import Counter
from collections.abc import Callable
from typing import Annotated, NamedTuple

import zenoh
from msgspec import Meta

from common.bounded import Name
from common.messaging.faults import Faults

ROLES = ("learner", "replay", "actor")
LEASE = 1.5  # seconds of silence after which a link is given up, and the learner's word no longer holds
FORGOTTEN = 60.0  # seconds after which one that has gone is no longer missed


class Origin(NamedTuple):
    """The host and the process id of a member of a run."""

    host: Name
    pid: Annotated[int, Meta(ge=0, le=2**31)]

    @classmethod
    def here(cls) -> Origin:
        """This very process."""
        return cls(socket.gethostname()[:256], os.getpid())

    def __str__(self) -> str:
        """As consoles show it."""
        return f"{self.host} (pid {self.pid})"


class Presence:
    """The tokens of a run.

    Args:
        prefix: key under which the tokens are, as ROLE/INCARNATION.
        faults: told of errors of this program in Zenoh's threads.
    """

    def __init__(self, session: zenoh.Session, prefix: str, faults: Faults) -> None:
        self._there: set[str] = set()
        self._gone: dict[str, float] = {}  # since when
        self._lock = threading.Lock()
        self._on_change: Callable[[], None] = lambda: None
        self._began = time.monotonic()
        for role in ROLES:  # one subscriber each: access control may let a process see some roles only
            session.liveliness().declare_subscriber(
                f"{prefix}/{role}/*", faults.guarded("watching who is there", self._tell), history=True
            )

    def on_change(self, call: Callable[[], None]) -> None:
        """Have `call` called whenever somebody comes or goes, in a thread of Zenoh's."""
        self._on_change = call

    def counts(self) -> dict[str, int]:
        """How many processes of each role are connected."""
        with self._lock:
            return dict(Counter(name.split("/")[0] for name in self._there))

    def missing(self) -> list[str]:
        """Processes that have gone and that no other of their role has replaced, as "ROLE INCARNATION"."""
        now = time.monotonic()
        with self._lock:
            self._gone = {name: since for name, since in self._gone.items() if now - since < FORGOTTEN}
            return [name.replace("/", " ") for name in self._gone]

    def members(self, role: str) -> set[str]:
        """Incarnations of a role that are connected."""
        with self._lock:
            return {name.split("/")[1] for name in self._there if name.startswith(f"{role}/")}

    def absence(self, role: str) -> float:
        """Seconds for which nobody of this role has been connected; 0 while somebody is."""
        with self._lock:
            if any(name.startswith(f"{role}/") for name in self._there):
                return 0.0
            left = max((since for name, since in self._gone.items() if name.startswith(f"{role}/")), default=0.0)
            return time.monotonic() - max(left, self._began)

    def _tell(self, sample: zenoh.Sample) -> None:
        name = "/".join(str(sample.key_expr).split("/")[-2:])
        with self._lock:
            if sample.kind == zenoh.SampleKind.DELETE:
                self._there.discard(name)
                self._gone[name] = time.monotonic()
            else:
                self._there.add(name)
                role = f"{name.split('/')[0]}/"
                replaced = name if name in self._gone else next((old for old in self._gone if old.startswith(role)), "")
                self._gone.pop(replaced, None)
        self._on_change()
