"""The episodes that ended, as far as a learner may still ask for them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from common.messaging.messages.sample import EpisodeRecord

MOST = 131_072  # that are kept; the oldest go where a run saves no epoch


class EpisodeLog:
    """Episodes in the order in which they ended, numbered from 0.

    first: number of the first one that is kept. floors: by epoch, the first one that a learner that goes back there
    asks for.
    """

    def __init__(self) -> None:
        self.first = 0
        self.floors: dict[int, int] = {}
        self._records: list[EpisodeRecord] = []

    @property
    def total(self) -> int:
        """Episodes that ended so far."""
        return self.first + len(self._records)

    def add(self, records: Iterable[EpisodeRecord]) -> None:
        """Append episodes."""
        self._records.extend(records)
        if len(self._records) > 2 * MOST:  # seldom, for it moves what is kept
            self._drop(self.total - MOST)

    def since(self, number: int, most: int) -> tuple[int, tuple[EpisodeRecord, ...]]:
        """Up to `most` episodes from `number` on, or from the first one that is kept; its number, and they."""
        first = max(number, self.first)
        start = first - self.first
        return first, tuple(self._records[start : start + most])

    def known_to_end_at(self, total: int) -> None:
        """Let what is here end at `total` at least: a learner knows of that many, and their numbers stay."""
        self.first = max(self.first, total - len(self._records))

    def mark(self, epoch: int, floor: int, keep: Sequence[int]) -> None:
        """Note from where on a learner that goes back to `epoch` asks, and drop what those of `keep` don't need.

        While there are none in `keep`, a learner that comes back begins at the first episode.
        """
        self.floors = {number: self.floors.get(number, self.first) for number in keep} | {epoch: floor}
        if keep:
            self._drop(min(self.floors.values()))

    def copy(self) -> tuple[EpisodeRecord, ...]:
        """What is kept."""
        return tuple(self._records)

    def load(self, first: int, records: Iterable[EpisodeRecord], floors: dict[int, int]) -> None:
        """Go on from what was kept before."""
        self.first, self._records, self.floors = first, list(records), floors

    def _drop(self, before: int) -> None:
        count = min(max(0, before - self.first), len(self._records))
        del self._records[:count]
        self.first += count
