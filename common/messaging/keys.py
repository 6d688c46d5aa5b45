"""Where everything is in Zenoh: the keys of a run, all below coop/RUN."""

from __future__ import annotations

from typing import Protocol

REPLAY_SHARD = "0"


class Place(Protocol):
    """A process's place in a run."""

    def key(self, *parts: str) -> str:
        """A key of this run."""


def run_key(run: str, *parts: str) -> str:
    """A key of a run."""
    return "/".join(("coop", run, *parts))


def replay_key(node: Place, what: str) -> str:
    """Key of one of the replay service's queryables: insert, sample, stats, limits or snapshot."""
    return node.key("replay", REPLAY_SHARD, what)


def join_key(node: Place, role: str) -> str:
    """Where a role asks: the replay service, which all others are sent to, at a key that access control can keep."""
    return node.key("config", "replay") if role == "replay" else node.key("config")


def weights_key(node: Place, network: int) -> str:
    """Key of network 1 or 2: its parameters as a broadcast, and as the answer to a question."""
    return node.key("weights", str(network))


def role_key(node: Place) -> str:
    """Key of the acting role, broadcast and answered like the weights."""
    return node.key("role")


def stop_key(node: Place) -> str:
    """Key at which the learner ends the run."""
    return node.key("stop")


def status_key(node: Place, role: str, incarnation: str = "*") -> str:
    """Key of what a process tells displays; of all processes of its role where no incarnation is given."""
    return node.key("metrics", role, incarnation)
