"""Keeps the replay ratio by admitting or refusing inserts and samples, with the reason in words."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from math import ceil, floor, isfinite
from typing import Any

from coop.common.errors import UsageError
from coop.common.numbers import updates_due


@dataclass(frozen=True, slots=True)
class RateLimiter:
    """The limiter's settings; it has no other state, so a running service may replace it.

    ratio: updates (batches drawn) per transition inserted after the first `start`.
    start: transitions inserted before the first sample.
    tolerance: environment steps by which inserts may be ahead of updates, or updates ahead of inserts. At least half an
        update's worth (1 / ratio steps) is always allowed; with less, neither could proceed.
    total: transitions after which no more are admitted; updates end at `due(total)`.
    capacity: of the table, to be checked against the other settings if given.
    origin: (inserted, drawn) from which the ratio holds; `(start, 0)` if None, see `changed`.

    Promise, with ahead = (inserted - origin inserted) - (drawn - origin drawn) / ratio in steps, and
    slack = max(tolerance, 0.5 / ratio): from the origin on, -slack <= ahead <= slack + n where n is the number of
    steps of the longest segment (a segment is admitted whole). And, while the table is not cleared, at least one
    of insert and sample is admitted until the run is complete.
    """

    ratio: float
    start: int
    tolerance: float
    total: int | None = None
    capacity: int | None = None
    origin: tuple[int, int] | None = None

    def __post_init__(self) -> None:
        """Raise UsageError for settings under which the run could not proceed or end."""
        if not (isfinite(self.ratio) and self.ratio > 0):
            raise UsageError(f"ratio: {self.ratio} updates per step, must be above 0")
        if not (isfinite(self.tolerance) and self.tolerance >= 0):
            raise UsageError(f"tolerance: {self.tolerance} steps, must be at least 0")
        if self.start < 0:
            raise UsageError(f"start: {self.start:,} transitions, must be at least 0")
        if self.total is not None and self.start > self.total:
            raise UsageError(f"start: {self.start:,} transitions, must be at most the total of {self.total:,}")
        if self.capacity is not None and self.start > self.capacity:
            raise UsageError(f"start: {self.start:,} transitions, must be at most the capacity of {self.capacity:,}")

    @classmethod
    def from_table(cls, table: Mapping[str, Any]) -> RateLimiter:
        """Build one from its `dataclasses.asdict`, as read from msgpack."""
        return cls(**{**table, "origin": None if table["origin"] is None else tuple(table["origin"])})

    @property
    def draws_total(self) -> int | None:
        """Draws of a complete run; None for a run without an end."""
        return None if self.total is None else self.due(self.total)

    def due(self, inserted: int) -> int:
        """Draws due once so many transitions are inserted: with tolerance 0, all that are admitted."""
        origin_inserted, origin_drawn = self.origin or (self.start, 0)
        return origin_drawn + updates_due(self.ratio, inserted - origin_inserted)

    def why_not_insert(self, inserted: int, drawn: int) -> str | None:
        """None if an insert is admitted, otherwise the reason for refusing it."""
        if self.total is not None and inserted >= self.total:
            return self._complete()
        ahead = self.ahead(inserted, drawn)
        if inserted < self.start or ahead <= self.slack:
            return None
        return f"inserts are {ahead:,.0f} steps ahead of updates"

    def why_not_sample(self, inserted: int, drawn: int, size: int) -> str | None:
        """None if a draw is admitted, otherwise the reason for refusing it. size: transitions in the table."""
        if inserted < self.start:
            return f"waiting for {self.start:,} transitions, have {inserted:,}"
        if size == 0:
            return "waiting for transitions, the table is empty"
        left = None if self.draws_total is None else self.draws_total - drawn
        if self.total is not None and inserted >= self.total:
            return None if left is None or left > 0 else self._complete()
        ahead = self.ahead(inserted, drawn)
        short = 1 / self.ratio - self.slack - ahead
        if short <= 0 and (left is None or left > 0):
            return None
        updates = -ahead * self.ratio
        if updates > 0.5:
            return f"updates are {updates:,.0f} ahead of inserts"
        return f"the next update is due in {ceil(short):,} steps"

    def admitted(self, inserted: int) -> int:
        """The number below which draws are admitted, and remain so while these settings hold, if the table has any."""
        if inserted < self.start:
            return 0
        most = self.draws_total
        if self.total is None or inserted < self.total:
            origin_inserted, origin_drawn = self.origin or (self.start, 0)
            due = floor(origin_drawn + self.ratio * (inserted - origin_inserted + self.slack))
            most = due if most is None else min(due, most)
        return max(0, most or 0)

    def changed(
        self, inserted: int, drawn: int, *, ratio: float, tolerance: float | None = None, total: int | None = None
    ) -> RateLimiter:
        """New settings whose ratio holds only from the present counts (inserted, drawn) on.

        Otherwise the new ratio would also apply to the past, and updates would pause or rush to compensate.
        """
        origin = (inserted, drawn) if inserted >= self.start else None
        return replace(
            self,
            ratio=ratio,
            tolerance=self.tolerance if tolerance is None else tolerance,
            total=self.total if total is None else total,
            origin=origin,
        )

    @property
    def slack(self) -> float:
        """Steps by which inserts may be ahead of updates, or behind them; see the promise above."""
        # (slack)
        return max(self.tolerance, 0.5 / self.ratio)

    def measured(self, inserted: int, drawn: int) -> float | None:
        """Updates per environment step since the ratio holds; None before the first such step."""
        origin_inserted, origin_drawn = self.origin or (self.start, 0)
        steps = inserted - origin_inserted
        return (drawn - origin_drawn) / steps if steps > 0 else None

    def ahead(self, inserted: int, drawn: int) -> float:
        """Environment steps by which inserts are ahead of updates."""
        origin_inserted, origin_drawn = self.origin or (self.start, 0)
        # (ahead)
        return (inserted - origin_inserted) - (drawn - origin_drawn) / self.ratio

    def _complete(self) -> str:
        return f"run complete: {self.total:,} of {self.total:,} steps"
