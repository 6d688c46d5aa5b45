"""Joining a run: a replay service or an actor asks the learner for all that it needs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Self

import msgspec

from coop.common.errors import BadMessage, JoinError
from coop.common.messaging.conversation import Conversation, asking, drive
from coop.common.messaging.endpoints import unknown_hosts
from coop.common.messaging.keys import join_key
from coop.common.messaging.messages.answers import Retry
from coop.common.messaging.messages.control import Join, JoinReply, Leave
from coop.common.messaging.timing import (
    ASK_EVERY,
    HANDOVER_TIMEOUT,
    IDLE_ASK_EVERY,
    JOIN_ANSWER,
    LEAVE_WITHIN,
    RETRY_PAUSE,
)
from coop.common.messaging.transport import NoAnswer, Node, Refused, Unreadable
from coop.common.process.console import PeerMonitor, StallDetector
from coop.common.process.lifecycle import Stop
from coop.common.settings.tables import first_difference, identity


def join(
    node: Node,
    stop: Stop,
    request: Join,
    connect: Sequence[str],
    timeout: float,
    *,
    need_replay: bool = False,
    event: Callable[[str], None] = lambda text: None,
) -> JoinReply | None:
    """Ask the learner until it answers; return None if a stop was requested first.

    need_replay: also wait until the learner knows where the replay service listens.
    event: called once, with a line that says what a long wait is for.

    Raises:
        JoinError: no learner (or no replay service) answered within `timeout` seconds, the learner refused this
            process, or another replay service serves the run.
    """
    if stop.is_set():
        return None
    return drive(joining(node, request, connect, timeout, need_replay=need_replay, event=event), stop)


def joining(
    node: Node,
    request: Join,
    connect: Sequence[str],
    timeout: float,
    *,
    need_replay: bool = False,
    event: Callable[[str], None] = lambda text: None,
) -> Conversation[JoinReply | None]:
    """See `join`."""
    where = _where(connect)
    deadline = node.now() + timeout
    stall = StallDetector()
    vacant_by: float | None = None
    answered = False
    while True:
        try:
            answer = yield from _ask_to_join(node, request)
        except NoAnswer:
            vacant_by = None
        else:
            answered = True
            if isinstance(answer, str):
                vacant_by = vacant_by or node.now() + HANDOVER_TIMEOUT
                if node.now() > vacant_by:
                    raise JoinError(f"run {node.run_name!r}: {answer}")
            elif answer.replay_endpoints or not need_replay:
                node.belong(answer.run_id)
                return answer
        if node.now() > deadline and vacant_by is None:
            if answered:
                raise JoinError(f"no replay service of run {node.run_name!r} found at {where} within {timeout:g} s")
            raise JoinError(no_learner(node, connect, timeout))
        awaited = (
            f"a replay service of run {node.run_name!r}"
            if answered
            else f"the learner of run {node.run_name!r} at {where}"
        )
        if text := stall.check(node.now(), 0, f"waiting for {awaited}"):
            event(text)
        if (yield RETRY_PAUSE):
            return None


def _ask_to_join(node: Node, request: Join) -> Conversation[JoinReply | str]:
    """Ask the learner once; return its answer, or the reason why this process cannot join now.

    Raises:
        NoAnswer: the learner does not answer.
        JoinError: the learner refused this process.
    """
    try:
        message = yield from asking(node, join_key(node, request.role), request.encode(node.run), JOIN_ANSWER)
        return Retry.decode(message).reason if message.kind == Retry.kind else JoinReply.decode(message)
    except (Refused, BadMessage) as error:
        raise JoinError(f"the learner of run {node.run_name!r} refused: {error}") from error


def leave_run(node: Node, request: Join) -> None:
    """Tell the learner that this process stops, and wait until the learner no longer needs it.

    Returns after `LEAVE_WITHIN` seconds at the latest, and at once if there is no learner.
    """
    drive(leaving(node, request))


def leaving(node: Node, request: Join) -> Conversation[None]:
    """See `leave_run`."""
    deadline = node.now() + LEAVE_WITHIN
    payload = Leave(request.incarnation).encode(node.run)
    while node.now() < deadline:
        try:
            message = yield from asking(node, join_key(node, request.role), payload, JOIN_ANSWER)
            if message.kind != Retry.kind:
                return
        except Unreadable:
            return
        except NoAnswer:
            if not node.presence.members("learner"):
                return
        except (Refused, BadMessage):
            return
        yield RETRY_PAUSE


def no_learner(node: Node, connect: Sequence[str], timeout: float) -> str:
    """That no learner was found within `timeout` seconds, and why that may be."""
    text = f"no learner of run {node.run_name!r} found at {_where(connect)} within {timeout:g} s"
    if unknown := unknown_hosts(connect):
        text = f"{text}; the host {unknown[0]!r} is not known"
    others = other_runs(node)
    return f"{text}; there is run {', '.join(map(repr, others))}" if others else text


def _where(connect: Sequence[str]) -> str:
    return ", ".join(connect) or "no endpoint (give --connect)"


def other_runs(node: Node) -> list[str]:
    """Names of the runs whose learners this process is connected to."""
    tokens = node.session.liveliness().get("coop/*/alive/learner/*", timeout=1.0)
    return sorted({str(reply.ok.key_expr).split("/")[1] for reply in tokens if reply.ok is not None})


class Membership:
    """Asks the learner repeatedly, beside the process's work, for changes of the run's members.

    Stops the process if the learner belongs to another run, refuses it, or has been gone for `patience` seconds.

    Args:
        request: the request with which this process first joined. reply: the learner's answer to it.
        learned: called with each answer and with the time of the request.
        event: called with a line when a member stops answering, and when it is back.
        replay_there: returns whether a replay service is connected; while none is, this process asks often for the
            next one's endpoints, otherwise seldom. None: this process needs none; it always asks often.
    """

    def __init__(
        self,
        node: Node,
        stop: Stop,
        request: Join,
        reply: JoinReply,
        patience: float,
        learned: Callable[[JoinReply, float], None],
        event: Callable[[str], None],
        replay_there: Callable[[], bool] | None = None,
    ) -> None:
        self._node = node
        self._stop = stop
        self._request = msgspec.structs.replace(request, index=reply.index)
        self._reply = reply
        self._patience = patience
        self._learned = learned
        self._event = event
        self._replay_there = replay_there
        self._task = node.start("membership", self._staying(), stop)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set("this process ends")  # if nothing else has stopped it
        self._task.join()

    def _staying(self) -> Conversation[None]:
        learner, replay = PeerMonitor("the learner"), PeerMonitor("the replay service")
        known, asked = self._node.presence.members("learner"), self._node.now()
        while not (yield ASK_EVERY):
            if self._node.presence.absence("learner") > self._patience:
                text = f"the learner of run {self._node.run_name!r} has been gone for {self._patience:g} s"
                self._stop.set(text, failed=True)
                return
            there = self._node.presence.members("learner")
            replay_there = self._replay_there is not None and self._replay_there()
            if there - known or not replay_there or self._node.now() - asked > IDLE_ASK_EVERY:
                asked = self._node.now()
                if (yield from self._ask(asked)):
                    known = there
            for text in (
                learner.check(bool(there & known), str(self._reply.learner)),
                replay.check(replay_there, str(self._reply.replay)),
            ):
                if text and not self._stop.is_set():
                    self._event(text)

    def _ask(self, now: float) -> Conversation[bool]:
        """Ask the learner once; return True if it answered."""
        try:
            answer = yield from _ask_to_join(self._node, self._request)
            problem = answer if isinstance(answer, str) else difference(self._reply, answer)
        except NoAnswer:
            return False
        except JoinError as error:
            problem = str(error)
        if problem:
            self._stop.set(problem, failed=True)
        elif isinstance(answer, JoinReply):
            self._reply = answer
            self._learned(answer, now)
        return True


def difference(mine: JoinReply, theirs: JoinReply) -> str | None:
    """The first difference that keeps a member from following another learner, with both values; None if none does."""
    found = first_difference(_identity(mine), _identity(theirs))
    return found and f"{found[0]} here {found[1]}, the learner's {found[2]}"


def _identity(reply: JoinReply) -> dict[str, Any]:
    return {
        "run id": reply.run_id,
        "environment": msgspec.structs.asdict(reply.spec),
        "network layout": reply.layout,
        "config": identity(reply.config),
    }
