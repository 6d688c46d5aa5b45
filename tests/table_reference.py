"""What the table's tests compare it with: made-up streams of experience, and a list of copies."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from coop.common.transitions import Batch, Segment
from coop.common.types import Array, EnvSpec
from coop.replay.table.loops import reuse_histogram
from coop.replay.table.table import Table


def make_spec(stack: int, dtype: str = "float32", shape: tuple[int, ...] = (2, 3)) -> EnvSpec:
    return EnvSpec("test", shape, dtype, stack, 5)


@dataclass
class Stream:
    """An emulator and its actor: every frame is unlike all others, segments carry what the last one ended with."""

    spec: EnvSpec
    number: int
    rng: np.random.Generator
    episode_length: int
    sequence: int = 0
    clock: int = 0
    observation: list[int] = field(default_factory=list)  # frames are named by numbers
    sent: list[int] = field(default_factory=list)  # the frames of the last segment

    def frame(self, name: int) -> Array:
        values = np.random.default_rng([self.number, name])
        if self.spec.frame_dtype == "uint8":
            return values.integers(0, 256, self.spec.frame_shape, np.uint8)
        return values.random(self.spec.frame_shape, np.float32)

    def new_frame(self) -> int:
        self.clock += 1
        return self.clock

    def segment(self, steps: int) -> Segment:
        pairs, terminated = [], []
        for _ in range(steps):
            if not self.observation:
                self.observation = [self.new_frame()] * self.spec.stack
            following = [*self.observation[1:], self.new_frame()]
            pairs.append((self.observation, following))
            terminated.append(bool(self.rng.random() < 0.5 / self.episode_length))
            ended = terminated[-1] or self.rng.random() < 0.5 / self.episode_length
            self.observation = [] if ended else following
        names = sorted({name for pair in pairs for obs in pair for name in obs})
        place = {name: index for index, name in enumerate(names)}
        carried = sum(name in self.sent for name in names)
        assert self.sent[len(self.sent) - carried :] == names[:carried]
        self.sent = names
        self.sequence += 1
        index = np.array([[[place[name] for name in obs] for obs in pair] for pair in pairs], np.int32)
        return Segment(
            incarnation=7,
            stream=self.number,
            sequence=self.sequence - 1,
            frames=np.stack([self.frame(name) for name in names]),
            obs_index=np.ascontiguousarray(index[:, 0]),
            next_index=np.ascontiguousarray(index[:, 1]),
            actions=self.rng.integers(0, 5, steps, np.int32),
            rewards=self.rng.random(steps, np.float32),
            terminated=np.array(terminated),
            param_version=self.rng.integers(0, 1 << 40, steps),
            span=np.ones(steps, np.uint8),
            carried=carried,
        )


@dataclass
class Copies:
    """The same table done the naive way: a copy of both stacks per transition, one transition at a time."""

    capacity: int
    eviction: str
    held: dict[int, tuple[Any, ...]] = field(default_factory=dict)
    row: dict[int, int] = field(default_factory=dict)
    priority: dict[int, float] = field(default_factory=dict)
    draws: dict[int, int] = field(default_factory=dict)
    max_priority: float = 1.0
    inserted: int = 0
    evicted_unsampled: int = 0

    def insert(self, segment: Segment, rng: np.random.Generator) -> None:
        for step in range(segment.steps):
            number, self.inserted = self.inserted, self.inserted + 1
            victim, row = None, number
            if number >= self.capacity:
                row = int(rng.integers(0, number + 1)) if self.eviction == "reservoir" else -1
                if self.eviction == "fifo":
                    victim = min(self.held)
                elif self.eviction == "prioritized":
                    victim = min(self.held, key=lambda number: (self.priority[number], number))
                else:
                    victim = next((held for held in self.held if self.row[held] == row), None)
            if victim is not None:
                del self.held[victim]
                self.evicted_unsampled += victim not in self.draws
            if number >= self.capacity and victim is None:
                self.evicted_unsampled += 1
                continue
            self.row[number] = row
            self.priority[number] = self.max_priority
            self.held[number] = (
                segment.frames[segment.obs_index[step]].copy(),
                segment.frames[segment.next_index[step]].copy(),
                segment.actions[step],
                segment.rewards[step],
                segment.terminated[step],
                segment.param_version[step],
            )

    def update(self, ids: Array, priorities: Array) -> None:
        for number, priority in zip(ids.tolist(), priorities.tolist(), strict=True):
            if number in self.held:
                self.priority[number] = priority
                self.max_priority = max(self.max_priority, priority)

    def check(self, batch: Batch) -> None:
        for number in batch.ids.tolist():
            self.draws[number] = self.draws.get(number, 0) + 1
        for row, number in enumerate(batch.ids.tolist()):
            obs, following, action, reward, terminated, version = self.held[number]
            np.testing.assert_array_equal(batch.frames[batch.obs_index[row]], obs)
            np.testing.assert_array_equal(batch.frames[batch.next_index[row]], following)
            assert (batch.actions[row], batch.rewards[row]) == (action, reward)
            assert (batch.terminated[row], batch.param_version[row]) == (terminated, version)
            assert batch.age[row] == self.inserted - 1 - number
            assert batch.reuse[row] == self.draws[number]


def held_ids(table: Table) -> list[int]:
    return sorted(table._columns.ids[: len(table)].tolist())


def check_references(table: Table, pinned: Array | None = None) -> None:
    """Every slot has exactly the references of the transitions, streams and snapshots that name it."""
    tails = table._tails.slots()
    named: list[Array] = [tails[tails >= 0]]
    named += [table._columns.slots[: len(table)].reshape(-1), *([] if pinned is None else [pinned])]
    references = table._frames.references[: table._frames.used]
    expected = np.bincount(np.concatenate(named).astype(np.intp), minlength=len(references))
    np.testing.assert_array_equal(references, expected)
    assert table._frames.held == np.count_nonzero(references)


def whole_state(table: Table) -> tuple[dict[str, Any], dict[str, Array]]:
    """A snapshot of a table as `Table.load_state` takes it, with all frames read."""
    meta, arrays, frames = table.snapshot()
    with frames:
        return meta, {**arrays, "frames": frames.read(0, len(frames))}


@dataclass(frozen=True, slots=True)
class TableStats:
    """Counts since the table's beginning, and its present contents.

    inserted, evicted, evicted_unsampled: transitions (one that reservoir eviction never kept counts as evicted).
    batches, sampled: sample calls and transitions drawn.
    reuse_mean: draws per transition held. reuse_held, reuse_evicted: transitions by how often they have been drawn;
    entry 0 counts those never drawn, entry b those drawn 2^(b-1) to 2^b - 1 times, the last entry all above.
    """

    size: int
    inserted: int
    evicted: int
    evicted_unsampled: int
    batches: int
    sampled: int
    frames_held: int
    bytes_held: int
    reuse_mean: float
    reuse_held: tuple[int, ...]
    reuse_evicted: tuple[int, ...]


def table_stats(table: Table) -> TableStats:
    size = len(table)
    reuse = table._columns.reuse[:size]
    return TableStats(
        size=size,
        inserted=table.inserted,
        evicted=table.evicted,
        evicted_unsampled=table.evicted_unsampled,
        batches=table.batches,
        sampled=table._sampled,
        frames_held=table._frames.held,
        bytes_held=table._frames.bytes_held + size * table._columns.row_bytes,
        reuse_mean=float(reuse.mean()) if size else 0.0,
        reuse_held=tuple(reuse_histogram(reuse).tolist()),
        reuse_evicted=tuple(table._reuse_evicted.tolist()),
    )
