"""`coop.replay.table.loops` in loops that numba compiles: a third of the time of numpy's many short calls."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from coop.common.compiling import compiled
from coop.common.types import Array
from coop.replay.table.columns import Columns
from coop.replay.table.frames import FrameStore, Slots, as_slice
from coop.replay.table.loops import Placed
from coop.replay.table.streams import StreamTails


def put(
    frames: FrameStore, tails: StreamTails, columns: Columns, reuse_evicted: NDArray[np.int64], placed: Placed
) -> int:
    """As `coop.replay.table.loops.put`, to the bit: each frame gets the same slot."""
    segment, rows, kept, first, size = placed
    count = len(segment.frames)
    positions = np.arange(kept.start, kept.stop) if isinstance(kept, slice) else kept
    previous, shared = tails.take(segment)
    tail = tails.begin(segment)
    frames.reserve(count)
    slots, new, references = np.empty(count, np.intp), np.empty(count, np.intp), np.empty(count, np.int32)
    fresh, frames.free_count, frames.used = _store(
        segment.obs_index, segment.next_index, positions, previous, shared, segment.carried, tail, slots, new,
        references, frames.references, frames.numbers_of, frames.free, frames.free_count, frames.used, frames.stored,
    )  # fmt: skip
    frames.stored += fresh
    at = as_slice(new[:fresh])
    frames.write(slots[at], segment.frames[at])
    added, columns.terminal, frames.free_count, in_order = _write(
        segment.obs_index, segment.next_index, segment.terminated, positions, rows, first, size, slots, previous,
        columns.slots, columns.ids, columns.reuse, columns.named["terminated"], columns.terminal, reuse_evicted,
        frames.references, frames.free, frames.free_count,
    )  # fmt: skip
    columns.write_given(as_slice(rows) if in_order else rows, segment, kept)
    forgotten = tails.keep(segment, slots[tail:])
    if len(forgotten):
        frames.drop(forgotten[forgotten >= 0])
    return int(added)


def gather(frames: FrameStore, columns: Columns, rows: Slots) -> tuple[Slots, NDArray[np.int32], NDArray[np.int32]]:
    """As `coop.replay.table.loops.gather`, to the bit."""
    slots = columns.slots
    distinct = np.empty(len(rows) * slots.shape[1], np.intp)
    shape = len(rows), slots.shape[1] // 2
    obs_index, next_index = np.empty(shape, np.int32), np.empty(shape, np.int32)
    count = _gather(slots, columns.reuse, frames.marks, rows, distinct, obs_index, next_index)
    return distinct[:count], obs_index, next_index


def held(
    columns: Columns, size: int, ids: NDArray[Any], rows: Slots, priorities: NDArray[np.float64]
) -> tuple[Slots, NDArray[np.float64]]:
    """As `coop.replay.table.loops.held`."""
    kept, given = np.empty(len(rows), np.intp), np.empty(len(rows))
    count = _held(columns.ids, size, ids, rows, priorities, kept, given)
    return kept[:count], given[:count]


@compiled
def largest(priorities: NDArray[np.float64]) -> float:
    """As `coop.replay.table.loops.largest`."""
    found = 0.0
    for priority in priorities:
        if not 0 <= priority < np.inf:
            return np.nan
        found = max(found, priority)
    return found


@compiled
def _store(
    obs_index: Array,
    next_index: Array,
    positions: Array,
    previous: Array,
    shared: int,
    carried: int,
    tail: int,
    slots: Array,
    new: Array,
    wanted: Array,
    references: Array,
    numbers: Array,
    free: Array,
    free_count: int,
    used: int,
    stored: int,
) -> tuple[int, int, int]:
    """Give slots to the frames that the transitions at `positions` have.

    slots, new, wanted: [frames], written: the slot of each, -1 if it is not stored; those to copy; the references of
    each. Returns how many there are to copy, and the new free_count and used.
    """
    for i in range(slots.shape[0]):
        wanted[i] = 0
        slots[i] = -1
    for position in positions:
        for j in range(obs_index.shape[1]):
            wanted[obs_index[position, j]] += 1
            wanted[next_index[position, j]] += 1
    for j in range(shared):
        slots[carried - shared + j] = previous[previous.shape[0] - shared + j]
    fresh = 0
    for i in range(slots.shape[0]):
        if i >= tail and (wanted[i] > 0 or slots[i] >= 0):
            wanted[i] += 1
        if wanted[i] > 0 and slots[i] >= 0:
            references[slots[i]] += wanted[i]
        elif wanted[i] > 0:
            new[fresh] = i
            fresh += 1
    recycled = min(fresh, free_count)
    free_count -= recycled
    for k in range(fresh):
        slot = free[free_count + k] if k < recycled else used + k - recycled
        slots[new[k]] = slot
        references[slot] = wanted[new[k]]
        numbers[slot] = stored + k + 1
    return fresh, free_count, used + fresh - recycled


@compiled
def _write(
    obs_index: Array,
    next_index: Array,
    ends: Array,
    positions: Array,
    rows: Array,
    first: int,
    size: int,
    slots: Array,
    previous: Array,
    held: Array,
    ids: Array,
    reuse: Array,
    terminated: Array,
    terminal: int,
    reuse_evicted: Array,
    references: Array,
    free: Array,
    free_count: int,
) -> tuple[int, int, int, bool]:
    """Write the rows, and drop the frames that they had, and those of `previous`.

    held: int32 [capacity, 2 stack], the slots of each row. Returns by how many rows the table grows, the new terminal
    and free_count, and whether the rows follow one another.
    """
    stack, added, in_order = obs_index.shape[1], 0, True
    for k in range(rows.shape[0]):
        row, position = rows[k], positions[k]
        in_order &= row == rows[0] + k
        if row < size:
            bucket, draws = 0, reuse[row]
            while draws > 0 and bucket < reuse_evicted.shape[0] - 1:
                draws >>= 1
                bucket += 1
            reuse_evicted[bucket] += 1
            terminal -= int(terminated[row])
            for j in range(2 * stack):
                free_count = _drop(held[row, j], references, free, free_count)
        else:
            added += 1
        for j in range(stack):
            held[row, j] = slots[obs_index[position, j]]
            held[row, stack + j] = slots[next_index[position, j]]
        terminal += int(ends[position])
        ids[row] = first + position
        reuse[row] = 0
    for slot in previous:
        if slot >= 0:
            free_count = _drop(slot, references, free, free_count)
    return added, terminal, free_count, in_order


@compiled
def _drop(slot: int, references: Array, free: Array, free_count: int) -> int:
    """Remove a reference; a slot without any is free. Returns the new count of those."""
    references[slot] -= 1
    if references[slot] > 0:
        return free_count
    free[free_count] = slot
    return free_count + 1


@compiled
def _gather(
    slots: Array, reuse: Array, marks: Array, rows: Array, distinct: Array, obs_index: Array, next_index: Array
) -> int:
    """Write the distinct slots of these rows and the indices, and count the draws; returns how many slots there are."""
    width, stack = slots.shape[1], obs_index.shape[1]
    for i in range(len(rows)):
        reuse[rows[i]] += 1
        for j in range(width):
            marks[slots[rows[i], j]] = i * width + j  # the last of equal slots wins
    count = 0
    for i in range(len(rows)):
        for j in range(width):
            slot = slots[rows[i], j]
            if marks[slot] == i * width + j:
                distinct[count] = slot
                marks[slot] = count
                count += 1
    for i in range(len(rows)):
        for j in range(stack):
            obs_index[i, j] = marks[slots[rows[i], j]]
            next_index[i, j] = marks[slots[rows[i], stack + j]]
    return count


@compiled
def _held(numbers: Array, size: int, ids: Array, rows: Array, priorities: Array, kept: Array, given: Array) -> int:
    """Write the rows below `size` that hold the transitions, and their priorities; returns how many there are."""
    count = 0
    for i in range(len(rows)):
        if rows[i] < size and numbers[rows[i]] == ids[i]:
            kept[count], given[count] = rows[i], priorities[i]
            count += 1
    return count
