"""The log of ended episodes, as far back as a learner may still ask for them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from coop.common.types import EpisodeRecord

MOST = 131_072  # episodes kept; if a run saves no checkpoint, the oldest are dropped


class EpisodeLog:
    """Episodes in the order in which they ended, numbered from 0.

    first: number of the oldest episode kept. floors: by checkpoint, the first episode for which a learner restored from
    it asks.
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
        if len(self._records) > 2 * MOST:  # seldom, because it copies the kept episodes
            self._drop(self.total - MOST)

    def since(self, number: int, most: int) -> tuple[int, tuple[EpisodeRecord, ...]]:
        """(first, episodes): up to `most` episodes from `number` on, or from the oldest one kept if that is later."""
        first = max(number, self.first)
        start = first - self.first
        return first, tuple(self._records[start : start + most])

    def extend_to(self, total: int) -> None:
        """Make the log end at `total` at least: a learner has received that many, and their numbers must not change."""
        self.first = max(self.first, total - len(self._records))

    def mark(self, checkpoint: int, floor: int, keep: Sequence[int]) -> None:
        """Note the first episode that a learner restored from `checkpoint` needs; drop those that none in `keep` needs.

        If `keep` is empty, a restored learner begins at the first episode.
        """
        self.floors = {number: self.floors.get(number, self.first) for number in keep} | {checkpoint: floor}
        if keep:
            self._drop(min(self.floors.values()))

    def copy(self) -> tuple[EpisodeRecord, ...]:
        """The episodes kept."""
        return tuple(self._records)

    def load(self, first: int, records: Iterable[EpisodeRecord], floors: dict[int, int]) -> None:
        """Restore the log from saved values."""
        self.first, self._records, self.floors = first, list(records), floors

    def _drop(self, before: int) -> None:
        count = min(max(0, before - self.first), len(self._records))
        del self._records[:count]
        self.first += count
