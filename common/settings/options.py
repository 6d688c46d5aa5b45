"""The flags that processes of a run share."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from coop.common.arguments import check_seconds
from coop.common.imports import permit
from coop.common.process.flags import HttpAddress
from coop.common.process.untrusted import check_run


@dataclass(frozen=True)
class HealthOptions:
    """The flag of processes that container engines watch."""

    health: HttpAddress = ""
    """Answer HTTP on this PORT or HOST:PORT whether this process works, for container engines: GET / and GET /ready."""


def check_waits(join_timeout: float, patience: float) -> None:
    """Raise UsageError for what is no time to wait; infinity is."""
    check_seconds("--join-timeout", join_timeout)
    check_seconds("--patience", patience)


@dataclass(frozen=True)
class RoleOptions:
    """Where and how a process finds its run."""

    run: str = "coop"
    """Name of the run."""
    connect: tuple[str, ...] = ("tcp/127.0.0.1:7447",)
    """Endpoints of the learner, for example tcp/head:7447."""
    join_timeout: float = 30.0
    """Seconds to search for the learner before giving up."""
    patience: float = 60.0
    """Seconds to wait for a lost learner before giving up."""
    zenoh_config: Path | None = None
    """A Zenoh configuration file (TLS, access control); the endpoints given as flags still apply."""
    shared_memory: bool = False
    """Use shared memory between processes on one machine: the learner reads frames in the replay service's."""
    allow_import: tuple[str, ...] = ()
    """Modules, such as my_envs, that may be imported for the run's environment, network, method or policies."""

    def __post_init__(self) -> None:
        """Raise UsageError for a name that no run has, and for what is no time to wait; permit the modules."""
        check_run(self.run)
        check_waits(self.join_timeout, self.patience)
        permit(self.allow_import)
