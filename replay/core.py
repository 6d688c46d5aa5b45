"""What the replay service decides, without I/O: de-duplication, the limiter's verdicts, draws and the books."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import astuple, dataclass
from typing import Any

import numpy as np

from common.config import RunConfig
from common.experience import MAX_EPISODES, Drawn, EpisodeRecord
from common.types import Batch, EnvSpec, Segment
from replay.dedup import SeenWindow
from replay.limiter import RateLimiter
from replay.table import Table


@dataclass(frozen=True, slots=True)
class Wait:
    """Not now, and why."""

    reason: str


@dataclass(slots=True)
class _Account:
    """Transitions of one actor process: accepted here, and acknowledged according to the actor."""

    accepted: int = 0
    acked: int = 0


class ReplayCore:
    """A table with its limiter and its books. One owner makes all calls."""

    def __init__(self, config: RunConfig, spec: EnvSpec) -> None:
        settings = config.replay
        self.table = Table(
            spec,
            settings.capacity,
            eviction=settings.eviction,
            sampling=settings.sampling,
            rng=np.random.default_rng([config.seed, 1]),
            priority_exponent=settings.priority_exponent,
            importance_exponent=settings.importance_exponent,
        )
        self.limiter = RateLimiter(
            settings.ratio, settings.start, settings.tolerance, config.total_steps, settings.capacity
        )
        self.batch_size = config.learner.batch_size
        # A learner repeats only what it has under way. Keeping more costs memory and the processor's caches.
        self._replies_kept = config.learner.prefetch
        self.drawn = 0
        self.duplicates = 0
        self.inserts_wait_for = ""
        self.samples_wait_for = ""
        self._seen = SeenWindow()
        self._episodes: list[EpisodeRecord] = []
        self._accounts: dict[int, _Account] = {}
        self._replies: OrderedDict[tuple[int, int], tuple[Batch, Drawn]] = OrderedDict()

    @property
    def lost(self) -> int:
        """Transitions that actors hold a receipt for and that never came here; 0 unless something is broken."""
        return sum(max(0, account.acked - account.accepted) for account in self._accounts.values())

    @property
    def episodes_booked(self) -> int:
        """Episodes that ended so far."""
        return len(self._episodes)

    def insert(self, segment: Segment) -> int | Wait:
        """Take a segment, unless an earlier delivery was taken; the count of transitions accepted, or the reason."""
        if self._seen.seen(segment.incarnation, segment.stream, segment.sequence):
            self.duplicates += 1
            return self.table.inserted
        reason = self.limiter.why_not_insert(self.table.inserted, self.drawn)
        self.inserts_wait_for = reason or ""
        if reason:
            return Wait(reason)
        self._seen.accept(segment.incarnation, segment.stream, segment.sequence)
        account = self._accounts.setdefault(segment.incarnation, _Account())
        account.accepted += segment.steps
        account.acked = max(account.acked, segment.acked)
        self._episodes.extend(
            EpisodeRecord(self.table.inserted + end.step_in_segment + 1, segment.incarnation, segment.stream, end)
            for end in segment.episodes
        )
        self.table.insert(segment)
        return self.table.inserted

    def draw(self, incarnation: int, sequence: int, batch_size: int, episodes_from: int) -> tuple[Batch, Drawn] | Wait:
        """Draw a batch, or give the one that this request drew before, or the limiter's reason."""
        known = self._replies.get((incarnation, sequence))
        if known is not None:
            return known
        table = self.table
        reason = self.limiter.why_not_sample(table.inserted, self.drawn, len(table))
        self.samples_wait_for = reason or ""
        if reason:
            return Wait(reason)
        batch = table.sample(batch_size)
        self.drawn += 1
        drawn = Drawn(
            sequence=sequence,
            inserted=table.inserted,
            size=len(table),
            evicted=table.evicted,
            evicted_unsampled=table.evicted_unsampled,
            first_episode=min(episodes_from, len(self._episodes)),
            episodes=tuple(self._episodes[episodes_from : episodes_from + MAX_EPISODES]),
        )
        self._replies[incarnation, sequence] = batch, drawn
        if len(self._replies) > self._replies_kept:
            self._replies.popitem(last=False)
        return batch, drawn

    def books(self) -> dict[str, Any]:
        """Everything but the table, msgpack-able."""
        return {
            "drawn": self.drawn,
            "duplicates": self.duplicates,
            "seen": self._seen.state(),
            "episodes": [astuple(record) for record in self._episodes],
            "accounts": [[actor, account.accepted, account.acked] for actor, account in self._accounts.items()],
        }
