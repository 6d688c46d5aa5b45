"""The replay tables of K lockstep runs as arrays, and what chance decides in them, ahead of the steps."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coop.common.numbers import generator_state, set_generator_state
from coop.common.settings.config import RunConfig
from coop.common.transitions import IN_BATCH, KEPT, Batch, filled
from coop.common.types import Array, EnvSpec
from coop.lockstep.compiled import loops
from coop.lockstep.memory import TableMemory
from coop.replay.table.loops import REUSE_BUCKETS

Ints = NDArray[np.int64]

_COLUMNS = {
    "actions": np.int64, "rewards": np.float32, "terminated": np.bool_, "param_version": np.int64, "ids": np.int64,
    "span": np.int64, "reuse": np.int64,
}  # fmt: skip


class Packing:
    """How an observation lies in a row of a table: its numbers, or eight truth values to a byte.

    width, dtype: of a row.
    """

    def __init__(self, spec: EnvSpec) -> None:
        self._shape, self._size = spec.obs_shape, math.prod(spec.obs_shape)
        self._bits = spec.frame_dtype == "bool"
        self.width, self.dtype = (-(-self._size // 8), "uint8") if self._bits else (self._size, spec.frame_dtype)

    def rows(self, obs: Array) -> Array:
        """Observations <frame_dtype>[n, *obs_shape] as rows, <dtype>[n, width]."""
        flat = obs.reshape(len(obs), self._size)
        return np.packbits(flat, axis=1) if self._bits else flat

    def obs(self, rows: Array) -> Array:
        """The reverse of `rows`."""
        flat = np.unpackbits(rows, axis=1, count=self._size).view(np.bool_) if self._bits else rows
        return flat.reshape(len(rows), *self._shape)


@dataclass
class Batches:
    """A batch of each of n runs.

    x: <dtype>[n, 2 batch, width], rows of the observations and then of the next ones. taken: int64 [n, batch], actions.
    rewards, discounts: float32 [n, batch], the latter 0 for a terminal next state.
    """

    x: Array
    taken: Ints
    rewards: Array
    discounts: Array

    @staticmethod
    def room(packing: Packing, count: int, size: int) -> Batches:
        """For so many batches of this size."""
        x = np.zeros((count, 2 * size, packing.width), packing.dtype)
        return Batches(x, np.zeros((count, size), np.int64), *np.zeros((2, count, size), np.float32))

    def first(self, count: int) -> Batches:
        """The first of them, in place."""
        return Batches(self.x[:count], self.taken[:count], self.rewards[:count], self.discounts[:count])


class Tables:
    """K tables of equally many transitions, with uniform draws, and fifo or reservoir eviction.

    Attributes:
        inserted: transitions, of each. obs, next_obs: rows [K, capacity, width]. columns: of `Columns`, by name, [K,
            capacity]. reuse_evicted: int64 [K, REUSE_BUCKETS]. terminal: int64 [K], transitions that end so. batches:
            drawn of each. largest: float32 [K], the largest |reward| drawn. rngs: the tables' own.
    """

    def __init__(self, config: RunConfig, spec: EnvSpec, rngs: Sequence[np.random.Generator]) -> None:
        count, capacity = len(rngs), config.replay.capacity
        self.config, self.rngs, self.capacity = config, list(rngs), capacity
        self._spec, self.packing = spec, Packing(spec)
        self.inserted = self.batches = 0
        shape = count, capacity, self.packing.width
        self.obs, self.next_obs = (np.zeros(shape, self.packing.dtype) for _ in range(2))
        self.columns: dict[str, Array] = {name: np.zeros((count, capacity), dtype) for name, dtype in _COLUMNS.items()}
        self.largest = np.zeros(count, np.float32)
        self.reuse_evicted = np.zeros((count, REUSE_BUCKETS), np.int64)
        self.terminal = np.zeros(count, np.int64)
        self._powers = np.float32(config.learner.gamma) ** np.arange(256, dtype=np.uint8)

    @staticmethod
    def of(memories: Sequence[TableMemory], config: RunConfig) -> Tables:
        """The present tables of some runs, all with as many transitions."""
        states = [memory.table.snapshot() for memory in memories]
        found = Tables(config, memories[0].table.spec, [np.random.default_rng(0) for _ in memories])
        for k, (meta, arrays, frames) in enumerate(states):
            with frames:
                stored = found.packing.rows(frames.read())
            size = len(arrays["ids"])
            found.obs[k, :size], found.next_obs[k, :size] = stored[arrays["slots"].T]
            for name, column in found.columns.items():
                column[k, :size] = arrays[name]
            found.reuse_evicted[k] = meta["reuse_evicted"]
            found.terminal[k] = memories[k].table.terminal
            set_generator_state(found.rngs[k], meta["rng"])
            found.inserted, found.batches = meta["inserted"], meta["batches"]
        return found

    def memory(self, k: int) -> TableMemory:
        """Table k as lockstep has it, with a generator in the same state; the frames lie otherwise."""
        found = TableMemory(self.config, self._spec)
        size = min(self.inserted, self.capacity)
        names = {name: column[k, :size] for name, column in self.columns.items()}
        rows = np.concatenate((self.obs[k, :size], self.next_obs[k, :size]))
        distinct, slots = np.unique(rows.view(f"V{rows.itemsize * rows.shape[1]}"), return_inverse=True)
        given: dict[str, Array] = {
            **filled(KEPT, size, names), "priorities": np.zeros(0),
            "slots": slots.reshape(2, size).T.astype(np.int32),
            "frames": self.packing.obs(distinct.view(rows.dtype).reshape(-1, rows.shape[1])),
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

    def insert(
        self,
        rows: Ints,
        obs: Array,
        next_obs: Array,
        actions: Ints,
        rewards: Array,
        terminal: Array,
        version: int,
        span: int,
    ) -> None:
        """Put the next transition of every run, over `span` steps, into its row, int64 [K]; obs, next_obs: rows."""
        held = self.columns
        loops.insert(
            rows, obs, next_obs, actions, rewards, terminal, version, span, self.inserted, self.capacity, self.obs,
            self.next_obs, held["actions"], held["rewards"], held["terminated"], held["param_version"], held["span"],
            held["ids"], held["reuse"], self.reuse_evicted, self.terminal,
        )  # fmt: skip
        self.inserted += 1

    def read(self, runs: slice, rows: Ints, updates: int, batches: Batches, seen: Ints) -> None:
        """Read a batch of these runs, whose rows are [n, batch], as `loops.gather` has it; the count stays."""
        held = self.columns
        loops.gather(
            self.obs[runs], self.next_obs[runs], held["actions"][runs], held["rewards"][runs],
            held["terminated"][runs], held["param_version"][runs], held["span"][runs], held["ids"][runs],
            held["reuse"][runs], rows, self._powers, batches.x, batches.taken, batches.rewards, batches.discounts, seen,
            self.largest[runs], np.array((self.inserted, updates)),
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
            "obs_index": here, "next_index": there, "ids": seen[0], "age": seen[1], "reuse": seen[2],
        }  # fmt: skip
        frames = self.packing.obs(np.concatenate((self.obs[k, rows], self.next_obs[k, rows])))
        return Batch(frames=frames, **filled(IN_BATCH, size, given))

    def kept(self, runs: NDArray[np.intp]) -> Tables:
        """The tables of these runs alone."""
        found = Tables(self.config, self._spec, [self.rngs[k] for k in runs])
        found.inserted, found.batches = self.inserted, self.batches
        found.obs, found.next_obs = self.obs[runs], self.next_obs[runs]
        found.columns = {name: column[runs] for name, column in self.columns.items()}
        found.reuse_evicted, found.terminal = self.reuse_evicted[runs], self.terminal[runs]
        found.largest = self.largest[runs]
        return found
