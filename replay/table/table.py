"""The table of transitions: exact capacity, each frame stored once, policies of eviction and sampling, exact state."""

from __future__ import annotations

import weakref
import zlib
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from coop.common.errors import UsageError
from coop.common.numbers import generator_state, set_generator_state
from coop.common.settings.policies import EVICTIONS, SAMPLERS
from coop.common.transitions import IN_SEGMENT, MASKS, Batch, Segment
from coop.common.types import Array, EnvSpec
from coop.replay.table.columns import Columns
from coop.replay.table.frames import FrameStore, PinnedFrames, Slots, StoredFrames
from coop.replay.table.loops import PLAIN, REUSE_BUCKETS, Placed, compiled_loops
from coop.replay.table.numbering import EPISODES, EpisodeNumbers
from coop.replay.table.own_policies import OwnEviction, make_policies
from coop.replay.table.policies import IMPORTANCE_EXPONENT, PRIORITY_EXPONENT, Incoming, TableView
from coop.replay.table.streams import StreamTails

WORTH_COMPILING = 20_000  # segments inserted: loading compiled loops takes as long as they save in 15,000


class PinnedBatch(NamedTuple):
    """A batch whose frames stay in the table until they are released.

    columns: the other fields of a `Batch`, by name.
    """

    frames: PinnedFrames
    columns: dict[str, Array]

    def read(self) -> Batch:
        """The batch, with a copy of the frames."""
        return Batch(frames=self.frames.read(), **self.columns)


class TableSnapshot(NamedTuple):
    """A table's state at one moment, while the table stays in use.

    meta, arrays: as `Table.load_state` takes them, except the array "frames". frames: its content, to be read in pieces
    of any size between other calls on the table, and to be released at the end (it is a context manager).
    """

    meta: dict[str, Any]
    arrays: dict[str, Array]
    frames: PinnedFrames


class Table:
    """Transitions of one environment, at most `capacity` of them, over frames stored once each.

    Deterministic: all random numbers come from `rng` (a Generator over PCG64, which the table's state includes).
    Not thread-safe: one owner makes all calls.

    inserted, batches: transitions inserted and sample calls so far. preloaded: transitions that it began with.
    preload_sum: a checksum of these.
    """

    def __init__(
        self,
        spec: EnvSpec,
        capacity: int,
        *,
        eviction: str = "fifo",
        sampling: str = "uniform",
        rng: np.random.Generator,
        priority_exponent: float = PRIORITY_EXPONENT,
        importance_exponent: float = IMPORTANCE_EXPONENT,
        replacement: bool = True,
        shared_memory: bool = False,
    ) -> None:
        """Raise UsageError for a capacity below 1, exponents below 0 or an unknown policy."""
        if capacity < 1:
            raise UsageError(f"capacity: {capacity} transitions, must be at least 1")
        for name, exponent in (("priority", priority_exponent), ("importance", importance_exponent)):
            if not exponent >= 0:
                raise UsageError(f"{name}_exponent: {exponent}, must be at least 0")
        self.spec = spec
        self.capacity = capacity
        self.inserted = self.preloaded = self.preload_sum = 0
        self.batches = 0
        self._settings = {
            "spec": [
                *(spec.env_id, list(spec.frame_shape), spec.frame_dtype, spec.stack, spec.num_actions),
                *([True] if spec.masks else []),
            ],
            "capacity": capacity,
            "eviction": eviction,
            "sampling": sampling,
            "priority_exponent": priority_exponent,
            "importance_exponent": importance_exponent,
        }
        self._rng = rng
        self._frames = FrameStore(spec.frame_shape, spec.frame_dtype, shared_memory=shared_memory)
        evicts, draws = EVICTIONS.get(eviction), SAMPLERS.get(sampling)
        self._prioritized = evicts.priorities or draws.priorities
        self._columns = seen = Columns(capacity, spec, prioritized=self._prioritized)
        self._max_priority = 1.0
        self._row_of: dict[int, int] | None = {} if self._prioritized and not evicts.in_order else None
        self._held = self._inserts = 0
        self._loops = PLAIN
        self._episodes = EpisodeNumbers(capacity) if evicts.episodes or draws.episodes else None
        named = (seen.named[name] for name in ("rewards", "terminated", "actions"))
        numbers = np.empty(0, np.int64) if self._episodes is None else self._episodes.of_rows
        exponents = priority_exponent, importance_exponent
        table = weakref.proxy(self)  # no cycle: a table that is dropped frees its memory at once

        def read(rows: Slots, following: bool) -> Array:
            found: Array = table._observations(rows, following)
            return found

        ids, reuse, rewards, terminated, actions, priorities, episodes = map(
            _read_only, (seen.ids, seen.reuse, *named, seen.priorities, numbers)
        )
        view = TableView(
            rng, ids, reuse, rewards, terminated, priorities, *exponents, replacement, actions, episodes, read,
            lambda: len(table),
        )  # fmt: skip
        self._eviction, self._sampling = make_policies(evicts, draws, view)
        self._sees = isinstance(self._eviction, OwnEviction) or self._episodes is not None
        self._tails = StreamTails(self._frames, spec.stack)
        self._sampled = self._left_out = 0
        self._reuse_evicted = np.zeros(REUSE_BUCKETS, np.int64)

    def __len__(self) -> int:
        return self._held

    @property
    def shared_memory(self) -> str:
        """Where other processes of this machine read the frames, see `FrameStore`."""
        return self._frames.shared_memory

    @property
    def terminal(self) -> int:
        """Transitions held that end in a terminal state."""
        return self._columns.terminal

    @property
    def evicted(self) -> int:
        """Transitions held once, and no longer."""
        return self.numbered - self._left_out - len(self)

    @property
    def numbered(self) -> int:
        """The number of the next transition."""
        return self.preloaded + self.inserted

    @property
    def evicted_unsampled(self) -> int:
        """Transitions evicted, or never kept, that were never drawn."""
        return int(self._reuse_evicted[0])

    def repeated(self) -> int:
        """Count the transitions held that equal another one in their frames, action, reward, end and span."""
        own = (
            "ids",
            "reuse",
            "param_version",
            "priorities",
            *MASKS,
        )  # these differ where a transition has come in twice
        slots = self._columns.slots[: len(self)].astype(np.intp)
        columns = (column for name, column in self._columns.named.items() if name not in own)
        values = zip(slots, *columns, strict=False)
        return len(self) - len({hash((self._frames.read(each).tobytes(), *rest)) for each, *rest in values})

    def insert(self, segment: Segment) -> None:
        """Insert a valid segment that is no duplicate; the eviction policy chooses the transitions to evict."""
        size = len(self)
        first = self.numbered
        if self._sees:
            rows, kept = self._admitted(segment)
        else:
            rows, kept = self._eviction.place(first, segment.steps)
        placed = Placed(segment, rows, kept, first, size)
        self._inserts += 1
        if self._inserts == WORTH_COMPILING:
            self._loops = compiled_loops()
        replaced = () if self._row_of is None else self._columns.ids[rows[rows < size]].tolist()
        self._held += self._loops.put(self._frames, self._tails, self._columns, self._reuse_evicted, placed)
        self._reuse_evicted[0] += segment.steps - len(rows)
        self.inserted += segment.steps
        if self._row_of is not None:
            for number in replaced:
                del self._row_of[number]
            self._row_of.update(zip(self._columns.ids[rows].tolist(), rows.tolist(), strict=True))
        if self._prioritized:
            self._set_priorities(rows, np.full(len(rows), self._max_priority))

    def preload(self, segment: Segment) -> None:
        """As `insert`, of transitions that the table is to begin with: they count neither as inserted nor as evicted.

        Raises ValueError if others have been inserted.
        """
        if self.inserted:
            raise ValueError("only a table without transitions of the run can be preloaded")
        self.insert(segment)
        self.inserted, self.preloaded = 0, self.preloaded + segment.steps
        self._left_out = self.preloaded - len(self)
        self._reuse_evicted[:] = 0
        for name in ("frames", *IN_SEGMENT):
            self.preload_sum = zlib.crc32(np.ascontiguousarray(getattr(segment, name)).data, self.preload_sum)

    def _admitted(self, segment: Segment) -> tuple[Slots, slice | Slots]:
        """The rows that a policy which sees the transitions gives them; raises UsageError for an impossible answer."""
        episodes = self._episodes
        numbers = np.zeros(segment.steps, np.int64) if episodes is None else episodes.number(segment)
        rows, kept = self._eviction.admit(Incoming(segment, self.spec, self.numbered, numbers))
        if episodes is not None:
            episodes.write(rows, numbers[kept])
        return rows, kept

    def _observations(self, rows: Slots, following: bool) -> Array:
        """The observations of these rows, or the next ones: <frame_dtype>[n, *obs_shape], a copy."""
        stack = self.spec.stack
        slots = self._columns.slots[rows, stack:] if following else self._columns.slots[rows, :stack]
        return self._frames.read(slots.ravel().astype(np.intp)).reshape(-1, *self.spec.obs_shape)

    def sample(self, batch_size: int) -> Batch:
        """Draw transitions by the sampling policy. Raises ValueError if the table is empty."""
        slots, columns = self._draw(batch_size)
        return Batch(frames=self._frames.read(slots), **columns)

    def sample_pinned(self, batch_size: int) -> PinnedBatch:
        """Draw like `sample`, but leave the frames in the table."""
        slots, columns = self._draw(batch_size)
        return PinnedBatch(self._frames.pin(slots), columns)

    def stored(self, slots: Slots) -> StoredFrames:
        """The frames in these slots, intp [n], which must be pinned as long as it is used."""
        return StoredFrames(self._frames, slots)

    def pin(self, batch: Batch) -> PinnedBatch:
        """Store the frames of a batch that was drawn before this table was restored."""
        slots = self._frames.add(batch.frames, np.ones(len(batch.frames), np.intp))
        pinned = self._frames.pin(slots)
        self._frames.drop(slots)
        return PinnedBatch(pinned, batch.columns())

    def _draw(self, batch_size: int) -> tuple[Slots, dict[str, Array]]:
        """Draw a batch: the slots of its distinct frames, and its other fields."""
        size = len(self)
        if size == 0:
            raise ValueError("an empty table has nothing to sample")
        rows, weights = self._sampling.draw(batch_size, size)
        distinct, obs_index, next_index = self._loops.gather(self._frames, self._columns, rows)
        self.batches += 1
        self._sampled += batch_size
        columns = self._columns.read(rows)
        return distinct, {
            **columns,
            "obs_index": obs_index,
            "next_index": next_index,
            "weights": weights,
            "age": self.numbered - 1 - columns["ids"],
        }

    def update_priorities(self, ids: NDArray[np.int64], priorities: NDArray[np.floating[Any]]) -> None:
        """Set transitions' priorities (float [n], usually |TD error|); ignores ids that are no longer held.

        New transitions get the largest priority so far (1 at first). If an id repeats, its last priority
        counts. Without a prioritized policy this does nothing. Raises ValueError for a priority that is negative or
        not finite, and for different lengths.
        """
        given = np.asarray(priorities, np.float64)
        if len(ids) != len(given) or np.isnan(self._loops.largest(given)):
            raise ValueError("priorities: must be finite, at least 0, and one for each id")
        if not self._prioritized:
            return
        if self._row_of is None:
            rows = ids.astype(np.intp) % self.capacity
        else:
            rows = np.array([self._row_of.get(number, self.capacity) for number in ids.tolist()], np.intp)
        rows, given = self._loops.held(self._columns, len(self), ids, rows, given)
        if len(rows):
            self._max_priority = max(self._max_priority, self._loops.largest(given))
            self._set_priorities(rows, given)

    def snapshot(self) -> TableSnapshot:
        """Freeze the present state while the table stays in use: small arrays are copied, frames only held."""
        size = len(self)
        tail_slots = self._tails.slots()
        stored = tail_slots >= 0
        slots = self._columns.slots[:size]
        distinct, index = self._frames.unique(np.concatenate((slots.ravel(), tail_slots[stored])))
        tail_index = np.full(len(tail_slots), -1, np.int32)
        tail_index[stored] = index[slots.size :]
        meta = {
            "settings": self._settings,
            "inserted": self.inserted,
            "preloaded": [self.preloaded, self.preload_sum, self._left_out],
            "held": size,
            "batches": self.batches,
            "sampled": self._sampled,
            "max_priority": self._max_priority,
            "reuse_evicted": self._reuse_evicted.tolist(),
            "streams": self._tails.streams(),
            "rng": generator_state(self._rng),
        }
        arrays = self._columns.state(size)
        arrays["slots"] = index[: slots.size].reshape(slots.shape)
        arrays["tails"] = tail_index
        if self._episodes is not None:
            meta["episodes"], arrays[EPISODES] = self._episodes.state(), self._episodes.of_rows[:size].copy()
        return TableSnapshot(meta, arrays, self._frames.pin(distinct))

    def load_state(self, meta: dict[str, Any], arrays: dict[str, Array]) -> None:
        """Restore a snapshot to the bit; `arrays["frames"]`, all its frames, may be a memory map.

        Raises UsageError if the state's table has other settings, ValueError if this table is not new.
        """
        if self.numbered:
            raise ValueError("only a new table can load a state")
        for name, value in self._settings.items():
            if meta["settings"][name] != value:
                raise UsageError(f"{name}: {value!r}, but the saved table had {meta['settings'][name]!r}")
        tails = arrays["tails"].astype(np.intp)
        frames = arrays["frames"]
        references = np.bincount(np.concatenate((arrays["slots"].ravel(), tails[tails >= 0])))
        parts = [slice(start, start + 1024) for start in range(0, len(frames), 1024)]
        slots = np.concatenate(
            [np.empty(0, np.intp), *(self._frames.add(frames[part], references[part]) for part in parts)]
        )
        self._columns.load_state(arrays, slots[arrays["slots"]])
        self._tails.load_state(meta["streams"], np.where(tails >= 0, slots[tails], -1))
        self.inserted = meta["inserted"]
        self.preloaded, self.preload_sum, self._left_out = meta["preloaded"]
        self._held = meta["held"]
        if self._episodes is not None:
            self._episodes.load_state(meta["episodes"], arrays[EPISODES])
        self.batches = meta["batches"]
        self._sampled = meta["sampled"]
        self._max_priority = meta["max_priority"]
        self._reuse_evicted[:] = meta["reuse_evicted"]
        set_generator_state(self._rng, meta["rng"])
        rows = np.arange(len(self))
        if self._row_of is not None:
            self._row_of.update(zip(self._columns.ids[rows].tolist(), rows.tolist(), strict=True))
        if self._prioritized:
            self._set_priorities(rows, self._columns.priorities[rows])

    def _set_priorities(self, rows: Slots, priorities: NDArray[np.float64]) -> None:
        self._columns.priorities[rows] = priorities
        self._eviction.prioritise(rows)
        self._sampling.prioritise(rows, priorities)


def _read_only(array: Array) -> Array:
    view = array.view()
    view.flags.writeable = False
    return view
