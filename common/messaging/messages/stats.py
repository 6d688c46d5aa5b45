"""The replay service's counters, on request."""

from __future__ import annotations

from typing import ClassVar

from coop.common.bounded import Counter, Text
from coop.common.messaging.messages.body import Body


class StatsQuestion(Body, frozen=True):
    """Asks for the counters."""

    kind: ClassVar[str] = "stats"


class ReplayStats(Body, frozen=True):
    """The replay service's counters, in transitions unless stated otherwise.

    drawn: batches. lost: transitions acknowledged to an actor but missing here. duplicates: segments delivered again
    and refused. faults: answers that failed because of a bug in this program.
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
