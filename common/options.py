"""The flags that the roles share."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class RoleOptions:
    """What a process needs to find its run."""

    run: str = "coop"
    """Name of the run."""
    connect: tuple[str, ...] = ("tcp/127.0.0.1:7447",)
    """Endpoints of the learner, for example tcp/head:7447."""
    join_timeout: float = 30.0
    """Seconds to look for the learner before giving up."""
    patience: float = 60.0
    """Seconds to wait for a learner that has gone before giving up."""
    zenoh_config: Path | None = None
    """A Zenoh configuration file (TLS, access control); the endpoints given here still hold."""
    shared_memory: bool = False
    """Carry messages between processes of one machine in shared memory."""
