"""How a replay service or an actor becomes part of a run: it asks the learner for everything."""

from __future__ import annotations

import threading
import time
from collections.abc import Sequence
from dataclasses import asdict, replace
from typing import Any

from common.errors import BadMessage, JoinError
from common.messaging import messages
from common.messaging.messages import Join, Joined
from common.messaging.transport import NoAnswer, Node, Refused
from common.process.lifecycle import Stop
from common.settings.tables import first_difference, identity

RETRY_PAUSE = 0.1  # seconds
LOOK_EVERY = 0.5  # seconds


def join_key(node: Node, role: str) -> str:
    """Where a role asks: the replay service, which all others are sent to, at a key that access control can keep."""
    return node.key("config", "replay") if role == "replay" else node.key("config")


def join(
    node: Node, stop: Stop, request: Join, connect: Sequence[str], timeout: float, *, need_replay: bool = False
) -> Joined | None:
    """Ask the learner until it answers; None if the stop came first.

    need_replay: wait also until the learner knows where the replay service listens.

    Raises:
        JoinError: no learner (or no replay service) within `timeout` seconds, or the learner refused this process.
    """
    deadline = time.monotonic() + timeout
    payload = messages.encode_join(node.run, request)
    answered = False
    while not stop.is_set():
        try:
            joined = messages.decode_joined(node.ask(join_key(node, request.role), payload, timeout=1.0))
        except NoAnswer:
            pass
        except (Refused, BadMessage) as error:
            raise JoinError(f"the learner of run {node.run!r} refused: {error}") from error
        else:
            answered = True
            if joined.replay_endpoints or not need_replay:
                return joined
        if time.monotonic() > deadline:
            where = ", ".join(connect) or "no endpoint (give --connect)"
            missing = "replay service" if answered else "learner"
            text = f"no {missing} of run {node.run!r} found at {where} within {timeout:g} s"
            others = [] if answered else other_runs(node)
            raise JoinError(f"{text}; there is run {', '.join(map(repr, others))}" if others else text)
        stop.wait(RETRY_PAUSE)
    return None


def other_runs(node: Node) -> list[str]:
    """Names of the runs whose learners this process is connected to."""
    tokens = node.session.liveliness().get("coop/*/alive/learner/*", timeout=1.0)
    return sorted({str(reply.ok.key_expr).split("/")[1] for reply in tokens if reply.ok is not None})


class Membership:
    """Joins again whenever a learner comes back, in a thread of its own.

    Stops the process where the learner is another run's, or has been gone for `patience` seconds.

    Args:
        request: as this process joined first. joined: the answer that it got then.
    """

    def __init__(
        self, node: Node, stop: Stop, request: Join, joined: Joined, connect: Sequence[str], patience: float
    ) -> None:
        self._node = node
        self._stop = stop
        self._request = replace(request, index=joined.index)
        self._joined = joined
        self._connect = connect
        self._patience = patience
        self._thread = threading.Thread(target=self._run, name="membership", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Wait for the thread; the stop must have come."""
        self._thread.join()

    def _run(self) -> None:
        known: set[str] = set()
        while not self._stop.wait(LOOK_EVERY):
            if self._node.presence.absence("learner") > self._patience:
                text = f"the learner of run {self._node.run!r} has been gone for {self._patience:g} s"
                self._stop.set(text, failed=True)
            there = self._node.presence.members("learner")
            if there - known:
                self._join_again()
            known = there

    def _join_again(self) -> None:
        try:
            again = join(self._node, self._stop, self._request, self._connect, self._patience)
        except JoinError as error:
            self._stop.set(str(error), failed=True)
            return
        if again is not None and (problem := difference(self._joined, again)):
            self._stop.set(problem, failed=True)


def difference(mine: Joined, theirs: Joined) -> str | None:
    """What keeps a process that has joined from following another learner, with both values; None if nothing does."""
    found = first_difference(_identity(mine), _identity(theirs))
    return found and f"{found[0]} here {found[1]}, the learner's {found[2]}"


def _identity(joined: Joined) -> dict[str, Any]:
    return {
        "run id": joined.run_id,
        "environment": asdict(joined.spec),
        "network layout": joined.layout,
        "config": identity(joined.config),
    }
