"""What a policy of eviction or sampling is, and what it sees of its table."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from coop.common.errors import UsageError
from coop.common.registry import loaded
from coop.common.settings.policies import EVICTIONS, SAMPLERS, EvictionPolicy, SamplingPolicy

Rows = NDArray[np.intp]
Floats = NDArray[np.float64]

PRIORITY_EXPONENT = 0.6
IMPORTANCE_EXPONENT = 0.4


@dataclass(frozen=True, slots=True)
class TableView:
    """A table as its policies see it. The arrays are the table's own: policies read them, and the table changes them.

    A policy takes its random numbers from `rng` and keeps nothing that it could not compute from these arrays: then a
    restored table goes on as the saved one would have.

    Attributes:
        rng: the table's generator, a part of its state.
        ids: int64 [capacity], the number of each transition in order of insertion.
        reuse: int32 [capacity], how often it has been drawn.
        rewards: float32 [capacity].
        terminated: bool [capacity].
        priorities: float64 [capacity], empty if no policy of the table uses them.
        priority_exponent: alpha of prioritized sampling.
        importance_exponent: beta of prioritized sampling.
        replacement: whether a batch may hold a transition twice.
    """

    rng: np.random.Generator
    ids: NDArray[np.int64]
    reuse: NDArray[np.int32]
    rewards: NDArray[np.float32]
    terminated: NDArray[np.bool_]
    priorities: Floats
    priority_exponent: float = PRIORITY_EXPONENT
    importance_exponent: float = IMPORTANCE_EXPONENT
    replacement: bool = True

    @property
    def capacity(self) -> int:
        """Rows of the table."""
        return len(self.ids)


class Eviction(ABC):
    """Assigns every new transition a row of the table, or none.

    Rows 0..capacity-1 are first filled in order, so after `first` insertions a table holds min(first, capacity)
    transitions in its lowest rows.
    """

    def __init__(self, table: TableView) -> None:
        self.table = table

    @abstractmethod
    def place(self, first: int, count: int) -> tuple[Rows, slice | Rows]:
        """Assign rows to the transitions numbered first..first+count-1 of all ever inserted.

        Returns (rows, kept): distinct rows, and the (ascending) positions in the segment of the transitions
        that go there. The previous content of a row is evicted; a new transition without a row is not kept.
        """

    def prioritise(self, rows: Rows) -> None:  # noqa: B027 (most policies need nothing)
        """Note that ids or priorities of these rows have changed; called if a policy of the table uses priorities."""


class Sampling(ABC):
    """Draws rows of the table, with importance-sampling weights."""

    def __init__(self, table: TableView) -> None:
        self.table = table

    @abstractmethod
    def draw(self, count: int, size: int) -> tuple[Rows, NDArray[np.float32]]:
        """Draw rows intp [count] among 0..size-1, with weights float32 [count] (largest: 1)."""

    def prioritise(self, rows: Rows, priorities: Floats) -> None:  # noqa: B027
        """Set the priorities of these rows; called if a policy of the table uses priorities."""


def make_policies(eviction: EvictionPolicy, sampling: SamplingPolicy, table: TableView) -> tuple[Eviction, Sampling]:
    """Make both policies of a table; raises UsageError if one can't be loaded, or needs replacement and has none."""
    if not (table.replacement or sampling.without_replacement):
        raise UsageError(f"sampling: {sampling.name!r} draws with replacement only")
    evicts, draws = (
        loaded(policy.make, f"{registry.setting} {policy.name!r}")(table)
        for policy, registry in ((eviction, EVICTIONS), (sampling, SAMPLERS))
    )
    return evicts, draws
