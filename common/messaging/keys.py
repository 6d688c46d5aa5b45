"""The Zenoh keys of a run, all below coop/RUN."""

from __future__ import annotations

import re
from typing import Protocol

from coop.common.errors import BadMessage

_INCARNATION = re.compile("0|[1-9a-f][0-9a-f]{0,15}")  # hexadecimal, as `Node` writes it
REPLAY_SHARD = "0"


class KeySpace(Protocol):
    """A process's place in a run, which determines its keys."""

    def key(self, *parts: str) -> str:
        """A key of this run."""


def run_key(run: str, *parts: str) -> str:
    """A key of a run."""
    return "/".join(("coop", run, *parts))


def replay_key(node: KeySpace, what: str) -> str:
    """Key of one of the replay service's queryables; `what`: insert, sample, stats, limits or snapshot."""
    return node.key("replay", REPLAY_SHARD, what)


def join_key(node: KeySpace, role: str) -> str:
    """Key for joining as a role; the replay service has its own, which access control can reserve for it."""
    return node.key("config", "replay") if role == "replay" else node.key("config")


def weights_key(node: KeySpace, network: int) -> str:
    """Key of the parameters of network 1 or 2, both for broadcasts and for queries."""
    return node.key("weights", str(network))


def role_key(node: KeySpace) -> str:
    """Key of the acting role, for broadcasts and queries like the weights' keys."""
    return node.key("role")


def evaluations_key(node: KeySpace) -> str:
    """Key at which the learner takes the results of evaluators."""
    return node.key("evaluations")


def stop_key(node: KeySpace) -> str:
    """Key at which the learner ends the run."""
    return node.key("stop")


def status_key(node: KeySpace, role: str, incarnation: str = "*") -> str:
    """Key of a process's status for displays; of all processes of the role if no incarnation is given."""
    return node.key("metrics", role, incarnation)


def incarnation_of(key: str) -> int:
    """The incarnation that ends the key of a token or a status; raises BadMessage if none does."""
    last = key.rpartition("/")[2]
    if _INCARNATION.fullmatch(last) is None:
        raise BadMessage("key", f"{last[:32]!r} is no incarnation")
    return int(last, 16)
