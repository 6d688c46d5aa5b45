"""The replay service's counters, for who asks."""

from __future__ import annotations

from typing import ClassVar

from common.bounded import Counter, Text
from common.messaging.messages.body import Body


class StatsQuestion(Body, frozen=True):
    """Asks for the counters."""

    kind: ClassVar[str] = "stats"


class ReplayStats(Body, frozen=True):
    """The replay service's counters, in transitions unless named otherwise.

    drawn: batches. lost: acknowledged to an actor and not here. duplicates: segments delivered again and refused.
    faults: answers that failed of an error of this program.
    """

    kind: ClassVar[str] = "stats"

    size: Counter
    inserted: Counter
    drawn: Counter
    evicted: Counter
    evicted_unsampled: Counter
    duplicates: Counter
    lost: Counter
    episodes: Counter
    bad_messages: Counter
    inserts_wait_for: Text
    samples_wait_for: Text
    faults: Counter = 0
