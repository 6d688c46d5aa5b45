"""What the replay service decides, without I/O: de-duplication, the limiter's verdicts, draws and the books."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from common.errors import RunError
from common.messaging.messages.sample import MAX_EPISODES, Drawn, DrawRequest, EpisodeRecord
from common.settings.capacity import check_memory
from common.settings.config import RunConfig
from common.types import Array, Batch, EnvSpec, Segment
from replay.dedup import SeenWindow
from replay.episodes import EpisodeLog
from replay.limiter import RateLimiter
from replay.table.table import PinnedBatch, Table, TableSnapshot

LEARNERS_KEPT = 64  # learners that others have taken over from, and that are refused


@dataclass(frozen=True, slots=True)
class Wait:
    """Not now, and why."""

    reason: str


class Recorder(Protocol):
    """Takes down what changes a core, in order, before anybody hears of it."""

    def insert(self, payload: bytes) -> None:
        """An insert request that is about to be carried out.

        Raises:
            OSError: it could not be taken down, and must not be carried out.
        """

    def draw(self, request: DrawRequest, ids: NDArray[np.int64]) -> None:
        """A draw and the transitions that it gave; never fails, for the draw has happened."""

    def limit(self, limiter: RateLimiter) -> None:
        """New settings of the limiter; raises OSError as `insert`."""


class Unrecorded:
    """The recorder of a core without a journal."""

    def insert(self, payload: bytes) -> None:
        """See `Recorder`."""

    def draw(self, request: DrawRequest, ids: NDArray[np.int64]) -> None:
        """See `Recorder`."""

    def limit(self, limiter: RateLimiter) -> None:
        """See `Recorder`."""


class CoreSnapshot(NamedTuple):
    """A core's state at one moment; `table` must be released.

    books: everything but table and episodes, msgpack-able. episodes: those that may be asked for again; plain, for
    packing them takes longer than the others may wait. replies: the draws that may be asked for again.
    """

    books: dict[str, Any]
    episodes: tuple[EpisodeRecord, ...]
    table: TableSnapshot
    replies: list[tuple[Batch, Drawn]]


class Reply(NamedTuple):
    """The answer to a draw; the frames of its batch are held until the learner can't ask for it again."""

    batch: PinnedBatch
    drawn: Drawn


@dataclass(slots=True)
class _Account:
    """Transitions of one actor process: accepted here, and acknowledged according to the actor."""

    accepted: int = 0
    acked: int = 0


class ReplayCore:
    """A table with its limiter and its books. One owner makes all calls.

    drawn: batches drawn, as the learner counts them: one that comes back from an epoch takes the count back with it.
    problem: why no segment can be taken although the limiter admits it, in words; empty where there is none.
    """

    def __init__(self, config: RunConfig, spec: EnvSpec, recorder: Recorder | None = None) -> None:
        settings = config.replay
        self.table = make_table(config, spec)
        self.limiter = RateLimiter(
            settings.ratio, settings.learning_starts, settings.tolerance, config.total_steps, settings.capacity
        )
        self.recorder: Recorder = recorder or Unrecorded()
        self.batch_size = config.learner.batch_size
        self._total_steps = config.total_steps
        self.drawn = 0
        self.duplicates = 0
        self.problem = ""
        self.inserts_wait_for = ""
        self.samples_wait_for = ""
        self._seen = SeenWindow()
        self._episodes = EpisodeLog()
        self._asked_from = 0  # the episode from which on the last draw asked
        self._accounts: dict[int, _Account] = {}
        self._learners: list[int] = []  # the last one is served
        self._replies: dict[int, Reply] = {}

    @property
    def lost(self) -> int:
        """Transitions that actors hold a receipt for and that never came here; 0 unless something is broken.

        At most those of the whole run: an actor that says more is not to be believed.
        """
        lost = sum(max(0, account.acked - account.accepted) for account in self._accounts.values())
        return min(lost, self._total_steps)

    @property
    def holes(self) -> int:
        """Segments that have not come although later ones of their stream have."""
        return self._seen.missing()

    @property
    def episodes_booked(self) -> int:
        """Episodes that ended so far."""
        return self._episodes.total

    def insert(self, segment: Segment, payload: bytes = b"") -> int | Wait:
        """Take a segment, unless an earlier delivery was taken; the count of transitions accepted, or the reason.

        payload: the request that brought it, for the recorder.
        """
        if self._seen.seen(segment.incarnation, segment.stream, segment.sequence):
            self.duplicates += 1
            return self.table.inserted
        reason = self.limiter.why_not_insert(self.table.inserted, self.drawn)
        if not reason:
            try:
                self.recorder.insert(payload)
                self.problem = ""
            except OSError as error:
                reason = self.problem = f"the journal can't be written: {error.strerror or error}"
        self.inserts_wait_for = reason or ""
        if reason:
            return Wait(reason)
        self.take(segment)
        return self.table.inserted

    def take(self, segment: Segment) -> None:
        """Carry out an insert that was admitted, now or, according to a journal, before."""
        if not self._seen.accept(segment.incarnation, segment.stream, segment.sequence):
            raise RunError(f"segment {segment.sequence} of actor {segment.incarnation:x} would be taken twice")
        account = self._accounts.setdefault(segment.incarnation, _Account())
        account.accepted += segment.steps
        account.acked = max(account.acked, segment.acked)
        self._episodes.add(
            EpisodeRecord(self.table.inserted + end.step_in_segment + 1, segment.incarnation, segment.stream, end)
            for end in segment.episodes
        )
        self.table.insert(segment)

    def draw(self, request: DrawRequest) -> Reply | Wait:
        """Draw a batch, or give the one that this request drew before, or the limiter's reason.

        Raises:
            RunError: another learner has taken over from the one that asks.
        """
        self._follow(request)
        known = self._replies.get(request.sequence)
        if known is not None:
            return known
        reason = None
        if request.sequence >= self.drawn:
            reason = self.limiter.why_not_sample(self.table.inserted, self.drawn, len(self.table))
        if reason and self.problem:
            reason = f"{reason}; {self.problem}"
        self.samples_wait_for = reason or ""
        if reason:
            return Wait(reason)
        reply = self.give(request)
        self.recorder.draw(request, reply.batch.columns["ids"])
        return reply

    def give(self, request: DrawRequest) -> Reply:
        """Carry out a draw that was admitted, now or, according to a journal, before; raises as `draw`."""
        self._follow(request)
        table = self.table
        if request.priorities:
            numbers, priorities = zip(*request.priorities, strict=True)
            table.update_priorities(np.array(numbers, np.int64), np.array(priorities))
        batch = table.sample_pinned(request.batch_size)
        self.drawn = max(self.drawn, request.sequence + 1)
        self._asked_from = request.episodes_from
        first, episodes = self._episodes.since(request.episodes_from, MAX_EPISODES)
        drawn = Drawn(
            sequence=request.sequence,
            inserted=table.inserted,
            size=len(table),
            evicted=table.evicted,
            evicted_unsampled=table.evicted_unsampled,
            first_episode=first,
            episodes=episodes,
            planned=self.limiter.draws_total or 0,
        )
        self._forget([request.sequence])
        self._replies[request.sequence] = reply = Reply(batch, drawn)
        return reply

    def limit(self, limiter: RateLimiter) -> None:
        """Go on under other settings; raises OSError where they can't be recorded."""
        self.recorder.limit(limiter)
        self.limiter = limiter

    def adopt(self, limiter: RateLimiter) -> None:
        """Take over the settings that the run had before; it may be longer now than it was then."""
        self.limiter = replace(limiter, total=self._total_steps)

    def snapshot(self, base: int, keep: Sequence[int] = ()) -> CoreSnapshot:
        """Everything as it is now; a learner that is back at `base` updates can be served from it.

        keep: the older epochs that a learner may go back to. Episodes that none of them asks for again are dropped.
        """
        again = (drawn.first_episode for _, drawn in self._replies.values() if drawn.sequence >= base)
        self._episodes.mark(base, min(again, default=self._asked_from), keep)
        books = {
            "drawn": self.drawn,
            "duplicates": self.duplicates,
            "seen": self._seen.state(),
            "first_episode": self._episodes.first,
            "floors": list(self._episodes.floors.items()),
            "accounts": [[actor, account.accepted, account.acked] for actor, account in self._accounts.items()],
            "learners": list(self._learners),
            "limiter": asdict(self.limiter),
        }
        return CoreSnapshot(books, self._episodes.copy(), self.table.snapshot(), self.repeatable(base))

    def repeatable(self, base: int = 0) -> list[tuple[Batch, Drawn]]:
        """The draws from number `base` on that the learner may ask for again."""
        return [(batch.read(), drawn) for batch, drawn in self._replies.values() if drawn.sequence >= base]

    def restore(
        self,
        books: Mapping[str, Any],
        episodes: Iterable[EpisodeRecord],
        meta: dict[str, Any],
        arrays: dict[str, Array],
        replies: Iterable[tuple[Batch, Drawn]],
    ) -> None:
        """Go on where `snapshot` was called; the core must be new. Raises UsageError for a table of other settings."""
        self.table.load_state(meta, arrays)
        self.drawn = books["drawn"]
        self.duplicates = books["duplicates"]
        self._seen.load_state(books["seen"])
        self._episodes.load(books["first_episode"], episodes, dict(books.get("floors", [])))
        self._accounts = {actor: _Account(accepted, acked) for actor, accepted, acked in books["accounts"]}
        self._learners = list(books["learners"])
        self.adopt(RateLimiter.from_table(books["limiter"]))
        self._replies = {drawn.sequence: Reply(self.table.pin(batch), drawn) for batch, drawn in replies}

    def _follow(self, request: DrawRequest) -> None:
        """Let the learner's count of updates be the count of draws where one of us has come back from an epoch."""
        known = self._learners[-1:] == [request.incarnation]
        if not known:
            if request.incarnation in self._learners:
                raise RunError("another learner has taken over this run")
            self._learners = [*self._learners[-LEARNERS_KEPT:], request.incarnation]
            self._forget(list(self._replies))
        if not known or request.base > self.drawn:
            self.drawn = request.base
            self._episodes.known_to_end_at(request.episodes_from)
        # Keeping more than can be asked for again costs memory and the processor's caches.
        self._forget([sequence for sequence in self._replies if sequence < request.base])

    def _forget(self, sequences: Iterable[int]) -> None:
        """Drop replies, those of them that are there."""
        for sequence in sequences:
            reply = self._replies.pop(sequence, None)
            if reply is not None:
                reply.batch.frames.release()


def make_table(config: RunConfig, spec: EnvSpec) -> Table:
    """The table of a run as it starts; raises UsageError where this machine can't hold it."""
    check_memory(config, spec)
    settings = config.replay
    return Table(
        spec,
        settings.capacity,
        eviction=settings.eviction,
        sampling=settings.sampling,
        rng=np.random.default_rng([config.seed, 1]),
        priority_exponent=settings.priority_exponent,
        importance_exponent=settings.importance_exponent,
        replacement=settings.replacement,
    )
