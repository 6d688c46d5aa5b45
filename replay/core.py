"""The replay service's logic, without I/O: de-duplication, limiter, inserts, draws and counters."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, NamedTuple

import msgspec
import numpy as np

from coop.common.errors import RunError
from coop.common.settings.capacity import check_memory
from coop.common.settings.config import RunConfig
from coop.common.transitions import MAX_EPISODES, NO_IDS, NO_PRIORITIES, Batch, Drawn, DrawRequest, Segment
from coop.common.types import Array, EnvSpec, EpisodeRecord
from coop.replay.dedup import DuplicateFilter
from coop.replay.episodes import EpisodeLog
from coop.replay.limiter import RateLimiter
from coop.replay.mirrored import MirroredFrames
from coop.replay.recorder import NullRecorder, Recorder
from coop.replay.table.table import PinnedBatch, Table, TableSnapshot

LEARNERS_KEPT = 64  # superseded learners, which are refused


@dataclass(frozen=True, slots=True)
class RetryLater:
    """The request is not admitted now; `reason` says why."""

    reason: str


class CoreSnapshot(NamedTuple):
    """A core's state at one moment; `table` must be released.

    state: everything except table and episodes, for msgpack. episodes: those that the learner may ask for again; not
    packed yet, because packing would block the core for too long. replies: the draws that it may ask for again.
    """

    state: dict[str, Any]
    episodes: tuple[EpisodeRecord, ...]
    table: TableSnapshot
    replies: list[tuple[Batch, Drawn]]


class Reply(NamedTuple):
    """The answer to a draw; its frames are held until the learner cannot ask for it again."""

    batch: PinnedBatch
    drawn: Drawn


@dataclass(slots=True)
class _Account:
    """Transitions of one actor process: accepted by this core, and acknowledged according to the actor."""

    accepted: int = 0
    acked: int = 0


class ReplayCore:
    """A table with its limiter and counters. One owner makes all calls.

    batch_size: transitions of a draw. segment_steps: of a segment, at most.
    drawn: batches drawn, as the learner counts them: a learner restored from a checkpoint also resets this count.
    mirrored: what the present learner's mirror holds.
    damaged: acknowledged transitions that damaged records of the journal held.
    problem: why no segment can be inserted although the limiter admits it, in words; empty if there is no problem.
    """

    def __init__(
        self, config: RunConfig, spec: EnvSpec, recorder: Recorder | None = None, *, shared_memory: bool = False
    ) -> None:
        self.table = make_table(config, spec, shared_memory=shared_memory)
        self.limiter = make_limiter(config)
        self.recorder: Recorder = recorder or NullRecorder()
        self.batch_size = config.learner.batch_size
        self.segment_steps = config.actor.segment_steps
        self._total_steps, self._offline = config.total_steps, config.replay.offline
        self.drawn = 0
        self.mirrored = MirroredFrames()
        self.duplicates = 0
        self.damaged = 0
        self.problem = ""
        self.inserts_wait_for = ""
        self.samples_wait_for = ""
        self._seen = DuplicateFilter()
        self._episodes = EpisodeLog()
        self._next_episode = 0  # number of the first episode for which the last draw asked
        self._accounts: dict[int, _Account] = {}
        self._learners: list[int] = []  # the last one is the present learner
        self._replies: dict[int, Reply] = {}

    @property
    def lost(self) -> int:
        """Transitions acknowledged to actors but missing here; 0 unless something is broken.

        At most those of the whole run, whatever the actors claim.
        """
        # Of the transitions in damaged records, the accounts tell once their actors send others.
        lost = sum(max(0, account.acked - account.accepted) for account in self._accounts.values())
        return min(max(lost, self.damaged), self._total_steps)

    @property
    def missing_segments(self) -> int:
        """Segments that have not arrived although later ones of their stream have."""
        return self._seen.missing()

    @property
    def episodes_total(self) -> int:
        """Number of episodes that have ended."""
        return self._episodes.total

    def insert(self, segment: Segment, payload: bytes = b"") -> int | RetryLater:
        """Insert a segment unless it is a duplicate; return the number of transitions accepted, or the reason to wait.

        payload: the segment's request, for the recorder.
        """
        if self._seen.seen(segment.incarnation, segment.stream, segment.sequence):
            self.duplicates += 1
            return self.table.inserted
        reason = self.limiter.why_not_insert(self.table.inserted, self.drawn)
        if not reason:
            try:
                self.recorder.insert(payload, segment.steps)
                self.problem = ""
            except OSError as error:
                reason = self.problem = f"the journal can't be written: {error.strerror or error}"
        self.inserts_wait_for = reason or ""
        if reason:
            return RetryLater(reason)
        self.apply_insert(segment)
        return self.table.inserted

    def apply_insert(self, segment: Segment) -> None:
        """Apply an admitted insert, a new one or one from a journal; raises RunError for a duplicate."""
        if not self._seen.accept(segment.incarnation, segment.stream, segment.sequence):
            raise RunError(f"segment {segment.sequence} of actor {segment.incarnation:x} would be inserted twice")
        account = self._accounts.setdefault(segment.incarnation, _Account())
        account.accepted += segment.steps
        account.acked = max(account.acked, segment.acked)
        self._episodes.add(
            EpisodeRecord(self.table.inserted + end.step_in_segment + 1, segment.incarnation, segment.stream, end)
            for end in segment.episodes
        )
        self.table.insert(segment)

    def draws(self, request: DrawRequest) -> list[Reply] | RetryLater:
        """Draw the batches of a request, as many as are admitted; return the reason to wait if none is.

        Raises:
            RunError: another learner has superseded the one that asks.
        """
        replies: list[Reply] = []
        episodes_from = request.episodes_from
        for sequence in range(request.sequence, request.sequence + request.draws):
            one = request
            if replies:
                none = {"ids": NO_IDS, "priorities": NO_PRIORITIES}
                one = msgspec.structs.replace(request, sequence=sequence, episodes_from=episodes_from, **none)
            reply = self.draw(one)
            if isinstance(reply, RetryLater):
                return replies or reply
            replies.append(reply)
            _, drawn = reply
            episodes_from = max(episodes_from, drawn.first_episode + len(drawn.episodes))
            if len(drawn.episodes) == MAX_EPISODES:  # of which a message has no room for more
                break
        return replies

    def draw(self, request: DrawRequest) -> Reply | RetryLater:
        """Draw a batch, or repeat the one of an equal earlier request; return the reason to wait if none is admitted.

        Raises:
            RunError: another learner has superseded the one that asks.
        """
        self._follow(request)
        known = self._replies.get(request.sequence)
        if known is not None:
            return known
        reason = None
        if request.sequence >= self.drawn:
            # Earlier ones may be on their way still: they count as drawn, too.
            reason = self.limiter.why_not_sample(self.table.inserted, request.sequence, len(self.table))
        if reason and self.problem:
            reason = f"{reason}; {self.problem}"
        self.samples_wait_for = reason or ""
        if reason:
            return RetryLater(reason)
        reply = self.apply_draw(request)
        self.recorder.draw(request, reply.batch.columns["ids"])
        return reply

    def apply_draw(self, request: DrawRequest) -> Reply:
        """Apply an admitted draw, a new one or one from a journal, of the first of its batches; raises as `draw`."""
        self._follow(request)
        table = self.table
        if len(request.ids):
            table.update_priorities(request.ids, request.priorities)
        batch = table.sample_pinned(request.batch_size)
        self.drawn = max(self.drawn, request.sequence + 1)
        self._next_episode = request.episodes_from
        first, episodes = self._episodes.since(request.episodes_from, MAX_EPISODES)
        drawn = Drawn(
            sequence=request.sequence,
            inserted=self._stood_for() if self._offline else table.inserted,
            size=len(table),
            evicted=table.evicted,
            evicted_unsampled=table.evicted_unsampled,
            first_episode=first,
            episodes=episodes,
            planned=self.limiter.draws_total or 0,
            terminal=table.terminal,
        )
        self._forget([request.sequence])
        self._replies[request.sequence] = reply = Reply(batch, drawn)
        return reply

    def _stood_for(self) -> int:
        """The steps of an offline run that the batches drawn so far stand for."""
        last = self.drawn >= (self.limiter.draws_total or 0)
        return self._total_steps if last else math.ceil((self.drawn - 0.5) / self.limiter.ratio)

    def limit(self, limiter: RateLimiter) -> None:
        """Change the limiter's settings; raises OSError if they cannot be recorded, RunError if there is no ratio."""
        if self._offline:
            raise RunError("an offline run has no steps, and so no ratio to keep")
        self.recorder.limit(limiter)
        self.limiter = limiter

    def restore_limiter(self, limiter: RateLimiter) -> None:
        """Restore earlier settings, with the run's present length, which may have grown."""
        if not self._offline:
            self.limiter = replace(limiter, total=self._total_steps)

    def snapshot(self, base: int, keep: Sequence[int] = ()) -> CoreSnapshot:
        """Take a snapshot that can serve a learner restored at `base` updates.

        keep: the older checkpoints to which a learner may return. Episodes that none of them needs are dropped.
        """
        again = (drawn.first_episode for _, drawn in self._replies.values() if drawn.sequence >= base)
        self._episodes.mark(base, min(again, default=self._next_episode), keep)
        state = {
            "drawn": self.drawn,
            "duplicates": self.duplicates,
            "damaged": self.damaged,
            "seen": self._seen.state(),
            "first_episode": self._episodes.first,
            "floors": list(self._episodes.floors.items()),
            "accounts": [[actor, account.accepted, account.acked] for actor, account in self._accounts.items()],
            "learners": list(self._learners),
            "limiter": asdict(self.limiter),
        }
        return CoreSnapshot(state, self._episodes.copy(), self.table.snapshot(), self.repeatable(base))

    def repeatable(self, base: int = 0) -> list[tuple[Batch, Drawn]]:
        """The draws from number `base` on for which the learner may ask again."""
        return [(batch.read(), drawn) for batch, drawn in self._replies.values() if drawn.sequence >= base]

    def restore(
        self,
        state: Mapping[str, Any],
        episodes: Iterable[EpisodeRecord],
        meta: dict[str, Any],
        arrays: dict[str, Array],
        replies: Iterable[tuple[Batch, Drawn]],
    ) -> None:
        """Restore a new core from a `snapshot`. Raises UsageError if its table has other settings."""
        self.table.load_state(meta, arrays)
        self.drawn = state["drawn"]
        self.duplicates = state["duplicates"]
        self.damaged = state["damaged"]
        self._seen.load_state(state["seen"])
        self._episodes.load(state["first_episode"], episodes, dict(state["floors"]))
        self._accounts = {actor: _Account(accepted, acked) for actor, accepted, acked in state["accounts"]}
        self._learners = list(state["learners"])
        self.restore_limiter(RateLimiter.from_table(state["limiter"]))
        self._replies = {drawn.sequence: Reply(self.table.pin(batch), drawn) for batch, drawn in replies}

    def _follow(self, request: DrawRequest) -> None:
        """Set the count of draws to the learner's count of updates if either side has returned to a checkpoint."""
        known = self._learners[-1:] == [request.incarnation]
        if not known:
            if request.incarnation in self._learners:
                raise RunError("another learner has taken over this run")
            self._learners = [*self._learners[-LEARNERS_KEPT:], request.incarnation]
            self.mirrored.clear()
            self._forget(list(self._replies))
        if not known or request.base > self.drawn:
            self.drawn = request.base
            self._episodes.extend_to(request.episodes_from)
        # Older replies cannot be asked for again; they would only occupy memory and the processor's caches.
        self._forget([sequence for sequence in self._replies if sequence < request.base])

    def _forget(self, sequences: Iterable[int]) -> None:
        """Drop those of these replies that exist."""
        for sequence in sequences:
            reply = self._replies.pop(sequence, None)
            if reply is not None:
                reply.batch.frames.release()


def make_limiter(config: RunConfig) -> RateLimiter:
    """The limiter of a run; that of an offline one admits no insert, and every planned draw from the start on."""
    replay = config.replay
    if replay.offline:
        return RateLimiter(replay.ratio, 0, replay.tolerance, 0, replay.capacity, (0, config.planned_updates))
    return RateLimiter(replay.ratio, replay.learning_starts, replay.tolerance, config.total_steps, replay.capacity)


def make_table(config: RunConfig, spec: EnvSpec, *, shared_memory: bool = False) -> Table:
    """Make the empty table of a run; raises UsageError if it does not fit into this machine's memory."""
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
        shared_memory=shared_memory,
    )
