"""Bugs of the protocol, planted by hand for the simulator to find."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any
from unittest.mock import patch

from coop.actors.weights import WeightsFollower
from coop.common.messaging.insert_client import InsertClient
from coop.common.messaging.sample_client import SampleClient
from coop.common.messaging.wire import Message
from coop.learner.checkpoints import Checkpoints
from coop.learner.join_service import Departure
from coop.learner.service import LearnerService
from coop.replay.core import ReplayCore
from coop.replay.dedup import DuplicateFilter
from coop.replay.limiter import RateLimiter
from coop.replay.persistence.checkpoints import ReplayCheckpoints
from coop.replay.persistence.journal import SEGMENT, Journal
from coop.replay.service import ReplayService

Patches = list[tuple[object, str, Any]]


def _ack_before_write() -> Patches:
    def insert(self: Any, payload: bytes, transitions: int) -> None:  # noqa: ANN401
        self._late.append((SEGMENT, payload, transitions))  # with the next record

    return [(Journal, "insert", insert)]


def _ack_before_flush() -> Patches:
    return [(ReplayService, "_flush", lambda self: None)]


def _forgotten_base() -> Patches:
    follow = ReplayCore._follow

    def keeps_replies(self: Any, request: Any) -> None:  # noqa: ANN401
        with patch.object(self, "_forget", lambda sequences: None):
            follow(self, request)

    return [(ReplayCore, "_follow", keeps_replies)]


def _stale_checkpoint() -> Patches:
    written = ReplayCheckpoints.written

    def any_number(self: Any, number: int) -> bool:  # noqa: ANN401
        return number != self._number or written(self, number)

    return [(ReplayCheckpoints, "written", any_number)]


def _short_window() -> Patches:
    accept = DuplicateFilter.accept

    def only_the_newest(self: Any, incarnation: int, stream: int, sequence: int) -> bool:  # noqa: ANN401
        known = self._streams.get((incarnation, stream))
        return known is not None and sequence == known.highest

    def takes(self: Any, incarnation: int, stream: int, sequence: int) -> bool:  # noqa: ANN401
        return accept(self, incarnation, stream, sequence) or not only_the_newest(self, incarnation, stream, sequence)

    return [(DuplicateFilter, "seen", only_the_newest), (DuplicateFilter, "accept", takes)]


def _ignored_swap() -> Patches:
    follow = WeightsFollower._follow

    def ignores(self: Any, *messages: Any) -> None:  # noqa: ANN401
        acting = self._policy.acting
        follow(self, *messages)
        self._policy.acting = acting

    return [(WeightsFollower, "_follow", ignores)]


def _early_takeover() -> Patches:
    return [("coop.learner.roster", "LEASE", 0.0)]


def _expired_confirmation() -> Patches:
    return [(ReplayService, "confirm", lambda self, until: _confirmed_for_ever(self))]


def _confirmed_for_ever(service: Any) -> None:  # noqa: ANN401
    service._confirmed = float("inf")
    service._changed.notify_all()


def _skipped_batch() -> Patches:
    def ask_all_again(self: Any) -> None:  # noqa: ANN401
        if self._outstanding and len(self._outstanding) > 1:
            self._outstanding.popleft()
        for index, (first, count, _) in enumerate(self._outstanding):
            self._outstanding[index] = self._request(first, count)

    return [(SampleClient, "_ask_all_again", ask_all_again)]


def _early_departure() -> Patches:
    return [(Departure, "ask", lambda self, incarnation: True)]


def _early_seal() -> Patches:
    asking = Checkpoints._asking

    def once(self: Any, question: bytearray) -> Any:  # noqa: ANN401
        answer = yield from asking(self, question)
        return (
            answer if answer.kind != "retry" else Message("ack", answer.run, answer.fields, answer.arrays, answer.table)
        )

    return [(Checkpoints, "_asking", once)]


def _only_the_newest_part() -> Patches:
    drop = ReplayCheckpoints._drop
    return [(ReplayCheckpoints, "_drop", lambda self, keep, covered: drop(self, {max(keep)}, covered))]


def _unflushed_part() -> Patches:
    return [("coop.common.process.files.SyncedFile", "close", lambda self: self._file.close())]


def _retry_as_ack() -> Patches:
    accept = InsertClient._accept

    def believes(self: Any, message: Any, sent: Any) -> bool:  # noqa: ANN401
        if message.kind != "retry":
            return accept(self, message, sent)
        self.acked += sent.steps
        return True

    return [(InsertClient, "_accept", believes)]


def _journal_begins_late() -> Patches:
    roll = Journal.roll
    return [(Journal, "roll", lambda self: roll(self) + 1)]


def _overtaking_draws() -> Patches:
    draw, why_not = ReplayCore.draw, RateLimiter.why_not_sample
    counts = []

    def counted(self: Any, request: Any) -> Any:  # noqa: ANN401
        counts[:] = [max(self.drawn, request.base)]
        return draw(self, request)

    def by_count(self: Any, inserted: int, drawn: int, size: int) -> str | None:  # noqa: ANN401
        return why_not(self, inserted, min([drawn, *counts]), size)

    return [(ReplayCore, "draw", counted), (RateLimiter, "why_not_sample", by_count)]


def _late_acknowledgement() -> Patches:
    real = ReplayService._flush

    def flush(self: Any) -> bytearray | None:  # noqa: ANN401
        refusal = real(self)
        return refusal if self._broken else None

    return [(ReplayService, "_flush", flush)]


def _closing_once() -> Patches:
    def saving(self: Any) -> Any:  # noqa: ANN401
        if self._agent.updates and (yield from self._replay_stats()) is not None:
            yield from self._checkpoints.saving(self._state())

    return [(LearnerService, "_saving", saving)]


def _any_run() -> Patches:
    return [("benchmarks.simulate.node", "check_run", lambda message, run: message)]


PLANTED: dict[str, tuple[str, Callable[[], Patches]]] = {
    "ack-before-write": ("a segment is acknowledged before its record is in the journal", _ack_before_write),
    "ack-before-flush": ("the sync journal acknowledges without a flush", _ack_before_flush),
    "forgotten-base": ("replies of before the learner's base, or of another learner, are kept", _forgotten_base),
    "stale-checkpoint": ("another checkpoint's number counts as written", _stale_checkpoint),
    "short-window": ("of each stream only the newest segment is known as a duplicate", _short_window),
    "ignored-swap": ("an actor ignores which network acts", _ignored_swap),
    "early-takeover": ("a second replay service is admitted before the first one's confirmation ends", _early_takeover),
    "expired-confirmation": ("a replay service acknowledges after its confirmation has expired", _expired_confirmation),
    "skipped-batch": ("a batch whose answer is lost is not asked for again", _skipped_batch),
    "early-departure": ("a replay service may leave before a checkpoint is saved", _early_departure),
    "early-seal": ("a checkpoint is sealed before the replay service's part is written", _early_seal),
    "only-newest-part": ("the parts of older checkpoints go before the new one is sealed", _only_the_newest_part),
    "unflushed-part": ("checkpoints are sealed before their files are on the disk", _unflushed_part),
    "retry-as-ack": ("an actor takes a refusal for an acknowledgement", _retry_as_ack),
    "overtaking-draws": ("as it was: a draw that overtakes another exceeds the ratio", _overtaking_draws),
    "late-acknowledgement": ("as it was: a slow flush outlives the confirmation", _late_acknowledgement),
    "closing-once": ("as it was: a replay service that restarts makes a complete run fail", _closing_once),
    "journal-begins-late": ("a checkpoint names the wrong file of the journal that continues it", _journal_begins_late),
    "any-run": ("as it was: messages of another run of the same name are taken", _any_run),
}


@contextmanager
def planted(name: str) -> Iterator[None]:
    """Run with a planted bug; with none if the name is empty."""
    with ExitStack() as stack:
        for owner, attribute, what in PLANTED[name][1]() if name else ():
            if isinstance(owner, str):
                stack.enter_context(patch(f"{owner}.{attribute}", what))
            else:
                stack.enter_context(patch.object(owner, attribute, what))
        yield
