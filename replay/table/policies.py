"""What a policy of eviction or sampling is, and what it sees of its table."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from coop.common.transitions import Segment
from coop.common.types import Array, EnvSpec

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
        actions: int32 [capacity].
        episodes: int64 [capacity], the number of each transition's episode in order of its first transition; empty
            unless a policy of the table says that it uses `episodes`.
        read, held: see `observations` and `size`.
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
    actions: NDArray[np.int32] = field(default_factory=lambda: np.empty(0, np.int32))
    episodes: NDArray[np.int64] = field(default_factory=lambda: np.empty(0, np.int64))
    read: Callable[[Rows, bool], Array] = lambda rows, following: rows
    held: Callable[[], int] = lambda: 0

    def observations(self, rows: Rows) -> Array:
        """A copy of these rows' observations, <frame_dtype>[n, *obs_shape]."""
        return self.read(rows, False)

    def next_observations(self, rows: Rows) -> Array:
        """A copy of these rows' next observations, <frame_dtype>[n, *obs_shape]."""
        return self.read(rows, True)

    @property
    def size(self) -> int:
        """Transitions held, in rows 0..size-1."""
        return self.held()

    @property
    def capacity(self) -> int:
        """Rows of the table."""
        return len(self.ids)


class Incoming:
    """The transitions of a segment that a table is about to insert.

    first: number of the first of all ever inserted. count: how many they are.
    actions, rewards, terminated: of each, as in a `Segment`. episodes: as of a `TableView`, int64 [count].
    """

    def __init__(self, segment: Segment, spec: EnvSpec, first: int, episodes: NDArray[np.int64]) -> None:
        self.first, self.count = first, segment.steps
        self.actions, self.rewards, self.terminated = segment.actions, segment.rewards, segment.terminated
        self.episodes = episodes
        self._segment, self._shape = segment, (-1, *spec.obs_shape)

    def observations(self) -> Array:
        """Their observations, <frame_dtype>[count, *obs_shape]."""
        return self._segment.frames[self._segment.obs_index].reshape(self._shape)

    def next_observations(self) -> Array:
        """Their next observations, <frame_dtype>[count, *obs_shape]."""
        return self._segment.frames[self._segment.next_index].reshape(self._shape)


class Eviction:
    """Assigns every new transition a row of the table, or none; defines `place`, or `admit` to see the transitions.

    Rows 0..capacity-1 are first filled in order, so a table holds `table.size` transitions in its lowest rows; of a
    policy that refuses none before the table is full, that is min(first, capacity).

    Attributes:
        priorities, episodes: whether it uses those of the table, see `TableView`.
    """

    priorities: ClassVar[bool] = False
    episodes: ClassVar[bool] = False

    def __init__(self, table: TableView) -> None:
        self.table = table

    def place(self, first: int, count: int) -> tuple[Rows, slice | Rows]:
        """Assign rows to the transitions numbered first..first+count-1 of all ever inserted.

        Returns (rows, kept): distinct rows, and the (ascending) positions in the segment of the transitions
        that go there. The previous content of a row is evicted; a new transition without a row is not kept.
        """
        raise NotImplementedError

    def admit(self, incoming: Incoming) -> tuple[Rows, slice | Rows]:
        """Assign rows to transitions that it sees, or refuse them; returns as `place`."""
        return self.place(incoming.first, incoming.count)

    def prioritise(self, rows: Rows) -> None:
        """Note that ids or priorities of these rows have changed; called if a policy of the table uses priorities."""


class Sampling(ABC):
    """Draws rows of the table, with importance-sampling weights.

    Attributes:
        priorities, episodes: whether it uses those of the table, see `TableView`.
    """

    priorities: ClassVar[bool] = False
    episodes: ClassVar[bool] = False

    def __init__(self, table: TableView) -> None:
        self.table = table

    @abstractmethod
    def draw(self, count: int, size: int) -> tuple[Rows, NDArray[np.float32]]:
        """Draw rows intp [count] among 0..size-1, with weights float32 [count] (largest: 1)."""

    def prioritise(self, rows: Rows, priorities: Floats) -> None:  # noqa: B027
        """Set the priorities of these rows; called if a policy of the table uses priorities."""
