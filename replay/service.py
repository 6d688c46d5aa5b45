"""The replay service: Zenoh queries in front of a `ReplayCore`.

Inserts, draws and other requests have separate queues, each with its thread; one lock guards the core. A request that
the limiter does not admit waits, but never longer than `HOLD` seconds: then the reply says retry, and why.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np

from coop.common.bounds import MAX_PAYLOAD
from coop.common.errors import BadMessage, CoopError, RunError
from coop.common.messaging.conversation import Conversation
from coop.common.messaging.keys import replay_key
from coop.common.messaging.members import ROUTE
from coop.common.messaging.messages.answers import Ack, Retry
from coop.common.messaging.messages.control import Limit, Limits, LimitsQuestion, Snapshot, Written
from coop.common.messaging.messages.insert import SegmentReader
from coop.common.messaging.messages.sample import Draws, Memory, encode_batch, encode_named, read_request
from coop.common.messaging.messages.status import Ratio, ReplayStats, ReplayStatus, StatsQuestion
from coop.common.messaging.timing import HOLD, STATUS_EVERY
from coop.common.messaging.transport import Node, new_incarnation
from coop.common.messaging.wire import Message
from coop.common.process.console import Console
from coop.common.process.lifecycle import Stop
from coop.common.process.memory import return_freed_memory
from coop.common.transitions import DrawRequest
from coop.replay.core import ReplayCore, Reply, RetryLater
from coop.replay.gate import Gate
from coop.replay.persistence.checkpoints import ReplayCheckpoints
from coop.replay.persistence.journal import Journal

LEAVING = "the replay service is stopping"
UNCONFIRMED = "the learner has not confirmed this replay service lately"
IN_FLIGHT = 256  # segments of all actors together, but at least one of each


class ReplayService:
    """Serves one core on one node until the session closes.

    Args:
        checkpoints: writes the core's part of checkpoints; the core may have been restored from one.
        confirmed: the time on the monotonic clock until which this service may acknowledge and draw (default: for
            ever). Later another one may serve, which a process that was frozen or cut off cannot know.
        synced: a journal that is flushed to the disk before an insert is acknowledged.
    """

    def __init__(
        self,
        node: Node,
        core: ReplayCore,
        checkpoints: ReplayCheckpoints,
        confirmed: float = math.inf,
        synced: Journal | None = None,
    ) -> None:
        self._node = node
        self._core = core
        self._checkpoints = checkpoints
        self._confirmed = confirmed
        self._synced = synced
        self._read_segment = SegmentReader(core.table.spec)
        self._changed = threading.Condition()
        self._inserts = Gate(node.now())
        self._draws = Gate(node.now())
        self._leaving = False
        self._broken = ""  # why the core must no longer be used
        self._table = new_incarnation()  # a process restored from a journal stores the frames in other slots
        self._batch = bytearray()  # the last answer; the next one reuses it: one thread answers, and sending copies

    def start(self) -> None:
        """Begin to answer requests."""
        node = self._node
        flush = self._flush if self._synced else None
        node.serve(replay_key(node, "insert"), self._insert, flush, self._changed, MAX_PAYLOAD)
        node.serve(replay_key(node, "sample"), self._sample, changed=self._changed, most=MAX_PAYLOAD)
        node.serve(replay_key(node, "stats"), self._stats)
        node.serve(replay_key(node, "limits"), self._limits)
        node.serve(replay_key(node, "snapshot"), self._snapshot, changed=self._changed)

    def serving(self, stop: Stop, console: Console) -> Conversation[None]:
        """Publish the status until the stop; from then on save checkpoints, but acknowledge and draw nothing."""
        problem = ""
        while not (yield STATUS_EVERY):
            if self._broken:
                stop.set(self._broken, failed=True)
            if problem != self._core.problem:
                problem = self._core.problem
                console.event(problem or "the journal can be written again")
            stats = self.stats()
            waiting = stats.inserts_wait_for or stats.samples_wait_for
            console.progress(stats.inserted + stats.drawn, waiting, self.progress)
            self._node.publish_status(self._status(self._node.now()))
        with self._changed:
            self._leaving = True
            self._changed.notify_all()

    def progress(self) -> str:
        """The run's progress in one line."""
        stats = self.stats()
        return f"{stats.inserted:,} transitions inserted, {stats.size:,} held, {stats.drawn:,} batches drawn"

    def close(self) -> None:
        """Wait for the checkpoint being written."""
        self._checkpoints.close()

    def confirm(self, until: float) -> None:
        """Permit acknowledging and drawing until then, see `confirmed`."""
        with self._changed:
            self._confirmed = until
            self._changed.notify_all()

    def stats(self) -> ReplayStats:
        """The counters at one moment."""
        with self._changed:
            core, table = self._core, self._core.table
            return ReplayStats(
                size=len(table),
                inserted=table.inserted,
                drawn=core.drawn,
                evicted=table.evicted,
                evicted_unsampled=table.evicted_unsampled,
                duplicates=core.duplicates,
                lost=core.lost,
                episodes=core.episodes_total,
                bad_messages=self._node.bad_messages,
                inserts_wait_for=core.inserts_wait_for,
                samples_wait_for=core.samples_wait_for,
                faults=self._node.faults.count,
            )

    def _status(self, now: float) -> ReplayStatus:
        with self._changed:
            inserted, drawn, limiter = self._core.table.inserted, self._core.drawn, self._core.limiter
            band = -limiter.slack, limiter.slack + self._core.segment_steps
            return ReplayStatus(
                size=len(self._core.table),
                inserted=inserted,
                drawn=drawn,
                ratio=Ratio(limiter.ratio, limiter.measured(inserted, drawn), limiter.ahead(inserted, drawn), *band),
                inserts=self._inserts.held(now),
                samples=self._draws.held(now),
                bad_messages=self._node.bad_messages,
                faults=self._node.faults.count,
            )

    def _insert(self, message: Message) -> Conversation[bytearray]:
        segment = self._read_segment(message)

        def attempt() -> bytearray | RetryLater:
            outcome = self._core.insert(segment, message.payload)
            return outcome if isinstance(outcome, RetryLater) else Ack(outcome, self._window()).encode(self._node.run)

        return self._admitted(self._inserts, attempt)

    def _flush(self) -> bytearray | None:
        """Flush the journal to the disk; return the refusal that leaves in place of acknowledgements, if they may not.

        A disk that fails once may have dropped what a later flush calls written. One that is slow may let a
        confirmation expire: another service may serve now, which does not have these segments.
        """
        assert self._synced is not None
        if not self._broken:
            try:
                self._synced.flush(self._changed)
            except OSError as error:
                self._broken = f"the journal can't be flushed to the disk: {error.strerror or error}"
        refusal = RetryLater(self._broken) if self._broken else self._not_serving()
        return None if refusal is None else Retry(refusal.reason).encode(self._node.run)

    def _window(self) -> int:
        """Segments that each actor may have in flight; behind a router, actors have no connections of their own."""
        there = self._node.presence.counts()
        return max(1, IN_FLIGHT // max(1, there.get(ROUTE, 0), there.get("actor", 0)))

    def _sample(self, message: Message) -> bytearray | Conversation[bytearray]:
        request = read_request(message)
        if request.batch_size != self._core.batch_size:
            raise BadMessage("fields.batch_size", f"{request.batch_size}; this run draws {self._core.batch_size}")
        shared = self._core.table.shared_memory
        if shared and request.memory not in (None, shared):
            return Memory(shared).encode(self._node.run)
        return self._admitted(self._draws, lambda: self._draw(request))

    def _draw(self, request: DrawRequest) -> bytearray | RetryLater:
        """Draw batches as a message; frames that the learner lacks are copied straight into it."""
        replies = self._core.draws(request)
        if isinstance(replies, RetryLater):
            return replies
        memory = self._core.table.shared_memory if request.memory else ""
        if memory or request.mirror:
            return self._named(request, replies, memory)
        ((batch, drawn),) = replies
        return encode_batch(self._node.run, batch.frames, batch.columns, drawn, into=self._batch)

    def _named(self, request: DrawRequest, replies: list[Reply], memory: str) -> bytearray:
        """Answer with the slots of the batches' frames, and those frames that the learner lacks."""
        core, start, carried = self._core, 0, []
        for batch, drawn in replies:
            if not memory:
                pinned = batch.frames
                lacks = core.mirrored.missing(request, drawn.sequence, pinned.slots, pinned.numbers)
                carried.append(start + lacks)
            start += len(batch.frames)
        slots = np.concatenate([batch.frames.slots for batch, _ in replies])
        indices = np.concatenate(carried) if carried else slots[:0]
        draws = Draws(
            table=self._table,
            memory=memory,
            admitted=core.limiter.admitted(core.table.inserted),
            frames=tuple([len(batch.frames) for batch, _ in replies]),
            draws=tuple([drawn for _, drawn in replies]),
        )
        frames = core.table.stored(slots)
        columns = [batch.columns for batch, _ in replies]
        lacking = core.table.stored(slots[indices])
        return encode_named(self._node.run, draws, columns, slots, frames.numbers, indices, lacking, self._batch)

    def _admitted(self, gate: Gate, attempt: Callable[[], bytearray | RetryLater]) -> Conversation[bytearray]:
        """Try, and repeat whenever the core has changed, until the gate's deadline; return the answer."""
        if self._broken:  # senders repeat their requests to the next replay service
            return Retry(self._broken).encode(self._node.run)
        with self._changing():
            while isinstance(outcome := self._not_serving() or attempt(), RetryLater):
                left = gate.refuse(outcome.reason, self._node.now())
                if left <= 0 or self._leaving:
                    return Retry(outcome.reason).encode(self._node.run)
                yield left
            gate.admit(self._node.now())
            self._changed.notify_all()
            return outcome

    @contextmanager
    def _changing(self) -> Iterator[None]:
        """Hold the lock, and note if a bug in this program may have left the core half changed.

        Raises:
            RunError: this has happened before, so the core must no longer be used.
        """
        with self._changed:
            if self._broken:
                raise RunError(self._broken)
            try:
                yield
            except CoopError:
                raise
            except Exception as error:
                self._broken = f"an error of this program may have left the table half changed: {error!r}"
                raise

    def _not_serving(self) -> RetryLater | None:
        """Why this service must neither acknowledge nor draw now; None if it may."""
        if self._leaving:
            return RetryLater(LEAVING)
        return None if self._node.now() < self._confirmed else RetryLater(UNCONFIRMED)

    def _stats(self, message: Message) -> bytearray:
        StatsQuestion.decode(message)
        return self.stats().encode(self._node.run)

    def _limits(self, message: Message) -> bytearray:
        with self._changing():
            core = self._core
            if message.kind == Limit.kind:
                asked = Limit.decode(message)
                try:
                    inserted, drawn = core.table.inserted, core.drawn
                    core.limit(core.limiter.changed(inserted, drawn, ratio=asked.ratio, tolerance=asked.tolerance))
                except OSError as error:
                    raise RunError(f"the journal can't be written: {error.strerror or error}") from error
                self._changed.notify_all()
            else:
                LimitsQuestion.decode(message)
            now = Limits(
                ratio=core.limiter.ratio,
                tolerance=core.limiter.tolerance,
                inserted=core.table.inserted,
                drawn=core.drawn,
                planned=core.limiter.draws_total or 0,
                inserts_wait_for=core.inserts_wait_for,
                samples_wait_for=core.samples_wait_for,
            )
        return now.encode(self._node.run)

    def _snapshot(self, message: Message) -> Conversation[bytearray]:
        if message.kind == Snapshot.kind:
            request = Snapshot.decode(message)
            with self._changing():
                asked = request.learner, request.asked
                self._checkpoints.begin(self._core, self._changed, request.number, request.keep, asked)
            return Ack(self._core.table.inserted).encode(self._node.run)
        number, until = Written.decode(message).number, self._node.now() + HOLD
        while not self._checkpoints.written(number):
            if (left := until - self._node.now()) <= 0:
                return Retry("the replay service is writing its part of the checkpoint").encode(self._node.run)
            yield left
        return_freed_memory()
        return Ack(self._core.table.inserted).encode(self._node.run)
