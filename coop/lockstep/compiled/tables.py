"""The replay tables of K lockstep runs as arrays, and what chance decides in them, ahead of the steps."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coop.common.numbers import generator_state, set_generator_state
from coop.common.settings.config import RunConfig
from coop.common.transitions import IN_BATCH, KEPT, Batch, filled
from coop.common.types import Array, EnvSpec
from coop.lockstep.compiled import loops
from coop.lockstep.memory import TableMemory
from coop.replay.table.put import REUSE_BUCKETS

Ints = NDArray[np.int64]

_COLUMNS = ("actions", "terminated", "param_version", "ids", "reuse")


class Tables:
    """K tables of equally many transitions, with uniform draws, and fifo or reservoir eviction.

    Attributes:
        inserted: transitions, of each. obs, next_obs: float32 [K, capacity, 4]. columns: of `Columns`, by name, [K,
            capacity]. reuse_evicted: int64 [K, REUSE_BUCKETS]. terminal: int64 [K], transitions that end so. batches:
            drawn of each. rngs: the tables' own.
    """

    def __init__(self, config: RunConfig, rngs: Sequence[np.random.Generator]) -> None:
        count, capacity = len(rngs), config.replay.capacity
        self.config, self.rngs, self.capacity = config, list(rngs), capacity
        self.inserted = self.batches = 0
        self.obs, self.next_obs = (np.zeros((count, capacity, 4), np.float32) for _ in range(2))
        self.columns: dict[str, Array] = {
            name: np.zeros((count, capacity), np.bool_ if name == "terminated" else np.int64) for name in _COLUMNS
        }
        self.reuse_evicted = np.zeros((count, REUSE_BUCKETS), np.int64)
        self.terminal = np.zeros(count, np.int64)
        self._powers = np.float32(config.learner.gamma) ** np.arange(256, dtype=np.uint8)

    @staticmethod
    def of(memories: Sequence[TableMemory], config: RunConfig) -> Tables:
        """The present tables of some runs, all with as many transitions."""
        states = [memory.table.snapshot() for memory in memories]
        found = Tables(config, [np.random.default_rng(0) for _ in memories])
        for k, (meta, arrays, frames) in enumerate(states):
            with frames:
                stored = frames.read()
            size = len(arrays["ids"])
            found.obs[k, :size], found.next_obs[k, :size] = stored[arrays["slots"].T]
            for name, column in found.columns.items():
                column[k, :size] = arrays[name]
            found.reuse_evicted[k] = meta["reuse_evicted"]
            found.terminal[k] = memories[k].table.terminal
            set_generator_state(found.rngs[k], meta["rng"])
            found.inserted, found.batches = meta["inserted"], meta["batches"]
        return found

    def memory(self, k: int, spec: EnvSpec) -> TableMemory:
        """Table k as lockstep has it, with a generator in the same state; the frames lie otherwise."""
        found = TableMemory(self.config, spec)
        size = min(self.inserted, self.capacity)
        names = {name: column[k, :size] for name, column in self.columns.items()}
        given: dict[str, Array] = {
            **filled(KEPT, size, {**names, "rewards": np.ones(size)}), "priorities": np.zeros(0),
            "slots": np.arange(2 * size, dtype=np.int32).reshape(2, size).T.copy(),
            "frames": np.concatenate((self.obs[k, :size], self.next_obs[k, :size])),
            "tails": np.empty(0, np.int32),  # a segment's first frame is stored again
        }  # fmt: skip
        meta: dict[str, Any] = {
            **found.table.snapshot().meta, "inserted": self.inserted, "held": size,
            "batches": self.batches, "sampled": self.batches * self.config.learner.batch_size,
            "reuse_evicted": self.reuse_evicted[k].tolist(), "rng": generator_state(self.rngs[k]),
        }  # fmt: skip
        found.table.load_state(meta, given)
        return found

    def rows(self, k: int, first: int, count: int) -> list[int]:
        """The rows of the transitions first, first + 1, ... of a segment in table k, -1 for one that is not kept."""
        if self.config.replay.eviction == "fifo":
            return [number % self.capacity for number in range(first, first + count)]
        # `Reservoir.place` draws them as one array, which takes the same numbers; of two in one row the last stays.
        draw = self.rngs[k].integers
        rows = [n if n < self.capacity else int(draw(n + 1)) for n in range(first, first + count)]
        return [row if row < self.capacity else -1 for row in rows]

    def drawn(self, k: int, inserted: int, count: int = 1) -> Ints:
        """The rows of so many batches of table k once it has been given so many transitions: int64 [count, batch]."""
        return self.rngs[k].integers(0, min(inserted, self.capacity), (count, self.config.learner.batch_size))

    def insert(self, rows: Ints, obs: Array, next_obs: Array, actions: Ints, terminal: Array, version: int) -> None:
        """Put the next transition of every run into its row, int64 [K]; obs, next_obs: float32 [K, 4]."""
        held = self.columns
        loops.insert(
            rows, obs, next_obs, actions, terminal, version, self.inserted, self.capacity, self.obs, self.next_obs,
            held["actions"], held["terminated"], held["param_version"], held["ids"], held["reuse"],
            self.reuse_evicted, self.terminal,
        )  # fmt: skip
        self.inserted += 1

    def read(self, runs: slice, rows: Ints, updates: int, x: Array, taken: Ints, discounts: Array, seen: Ints) -> None:
        """Read a batch of these runs, whose rows are [n, batch], as `loops.gather` has it; `batches` stays."""
        held = self.columns
        loops.gather(
            self.obs[runs], self.next_obs[runs], held["actions"][runs], held["terminated"][runs],
            held["param_version"][runs], held["ids"][runs], held["reuse"][runs], rows, self._powers,
            x, taken, discounts, seen, np.array((self.inserted, updates)),
        )  # fmt: skip

    def counters(self, k: int) -> dict[str, int]:
        """As `TableMemory.counters`."""
        size = min(self.inserted, self.capacity)
        return {
            "size": size, "evicted": self.inserted - size, "evicted_unsampled": int(self.reuse_evicted[k, 0]),
            "terminal": int(self.terminal[k]),
        }  # fmt: skip

    def batch(self, k: int, rows: Ints, seen: Ints) -> Batch:
        """A batch of table k as lockstep has it; rows int64 [batch], seen int64 [5, batch] of `read`."""
        size = len(rows)
        here, there = np.arange(2 * size, dtype=np.int32).reshape(2, size, 1)
        given = {
            **{name: column[k, rows] for name, column in self.columns.items()},
            "obs_index": here, "next_index": there, "rewards": np.ones(size), "ids": seen[0], "age": seen[1],
            "reuse": seen[2],
        }  # fmt: skip
        frames = np.concatenate((self.obs[k, rows], self.next_obs[k, rows]))
        return Batch(frames=frames, **filled(IN_BATCH, size, given))

    def kept(self, runs: NDArray[np.intp]) -> Tables:
        """The tables of these runs alone."""
        found = Tables(self.config, [self.rngs[k] for k in runs])
        found.inserted, found.batches = self.inserted, self.batches
        found.obs, found.next_obs = self.obs[runs], self.next_obs[runs]
        found.columns = {name: column[runs] for name, column in self.columns.items()}
        found.reuse_evicted, found.terminal = self.reuse_evicted[runs], self.terminal[runs]
        return found
