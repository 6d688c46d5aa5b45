"""How a replay service or an actor becomes part of a run: it asks the learner for everything."""

from __future__ import annotations

import time
from collections.abc import Sequence

from common import messages
from common.errors import BadMessage, JoinError
from common.lifecycle import Stop
from common.messages import Join, Joined
from common.transport import NoAnswer, Node, Refused

RETRY_PAUSE = 0.1  # seconds


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
            raise JoinError(f"no {missing} of run {node.run!r} found at {where} within {timeout:g} s")
        stop.wait(RETRY_PAUSE)
    return None
