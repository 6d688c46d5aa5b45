"""The members of a run: their roles, and their hosts and process ids."""

from __future__ import annotations

import os
import socket
from typing import Annotated, NamedTuple

from msgspec import Meta

from coop.common.bounded import Name

ROLES = ("learner", "replay", "actor", "evaluator")
ROUTE = "route"  # in place of a role: an actor's own connection to the replay service
# Roles that ask the learner for the run's data; "watch" takes no part.
JOINING = ("replay", "actor", "evaluator", "watch")


class Origin(NamedTuple):
    """The host and the process id of a run's member."""

    host: Name
    pid: Annotated[int, Meta(ge=0, le=2**31)]

    @classmethod
    def here(cls) -> Origin:
        """The origin of this process."""
        return cls(socket.gethostname()[:256], os.getpid())

    def __str__(self) -> str:
        """The text for consoles."""
        return f"{self.host} (pid {self.pid})"
