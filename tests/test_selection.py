"""Each policy against its definition: which row goes, which is drawn how often, and with what weight."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from coop.replay.table.policies import Floats, Rows, TableView
from coop.replay.table.selection import Fifo, LowestPriority, Proportional, Reservoir, Uniform


def view(capacity: int, rng: np.random.Generator | None = None, priorities: Floats | None = None) -> TableView:
    zeros = np.zeros(capacity, np.int64)
    columns = np.arange(capacity), zeros.astype(np.int32), zeros.astype(np.float32), zeros.astype(np.bool_)
    return TableView(rng or np.random.default_rng(0), *columns, np.zeros(0) if priorities is None else priorities)


def fill(place: Callable[[int, int], tuple[Rows, slice | Rows]], capacity: int, lengths: list[int]) -> list[int]:
    """Ids in each row after segments of these lengths."""
    ids, first = np.full(capacity, -1), 0
    for length in lengths:
        rows, kept = place(first, length)
        assert len(set(rows.tolist())) == len(rows)
        ids[rows] = np.arange(first, first + length)[kept]
        first += length
    return ids.tolist()


@pytest.mark.parametrize(
    ("lengths", "ids"),
    [
        ([2], [0, 1, -1, -1]),
        ([3, 3], [4, 5, 2, 3]),
        ([9], [8, 5, 6, 7]),
        ([4, 4], [4, 5, 6, 7]),
        ([1, 9], [8, 9, 6, 7]),
    ],
)
def test_fifo_keeps_the_newest(lengths: list[int], ids: list[int]) -> None:
    assert fill(Fifo(view(4)).place, 4, lengths) == ids


@pytest.mark.parametrize(
    ("capacity", "lengths"), [(10, [40]), (10, [1] * 40), (10, [3, 10, 27]), (10, [25, 15]), (1, [2]), (1, [1, 1])]
)
def test_reservoir_keeps_everything_with_equal_probability(capacity: int, lengths: list[int]) -> None:
    """Of 40 transitions 10 are held, or one of two: each in that share of 1,000 runs (sd at most 0.016)."""
    rng = np.random.default_rng(0)
    held = np.zeros(sum(lengths))
    for _ in range(1000):
        held[fill(Reservoir(view(capacity, rng)).place, capacity, lengths)] += 1
    np.testing.assert_allclose(held / 1000, capacity / sum(lengths), atol=0.07)


def test_lowest_priority_goes_first_and_among_equals_the_oldest() -> None:
    priorities = np.array([3.0, 1.0, 2.0, 1.0, 5.0])
    policy = LowestPriority(view(5, priorities=priorities))
    policy.prioritise(np.arange(5))
    priorities[1] = 4.0  # raised: its old entry no longer counts
    policy.prioritise(np.array([1]))
    rows, kept = policy.place(5, 2)
    assert rows.tolist() == [3, 2]
    assert kept == slice(0, 2)


def test_lowest_priority_heap_stays_small() -> None:
    priorities = np.array([3.0, 1.0, 2.0, 5.0, 4.0])
    policy = LowestPriority(view(5, priorities=priorities))
    policy.prioritise(np.arange(4))
    sizes = []
    for number in range(3000):
        row = 4 if number < 1050 else 0
        priorities[row] += 1
        policy.prioritise(np.array([row]))
        sizes.append(len(policy._heap))
    assert max(sizes) == 2 * 5 + 1024
    assert sizes.count(5) == 3  # at first, and twice without what is out of date
    assert policy.place(5, 5)[0].tolist() == [1, 2, 3, 4, 0]


def test_lowest_priority_fills_empty_rows_first() -> None:
    policy = LowestPriority(view(5, priorities=np.ones(5)))
    assert policy.place(0, 3)[0].tolist() == [0, 1, 2]
    policy.prioritise(np.arange(3))
    policy.prioritise(np.array([1]))  # once more, with the priority that it has
    rows, kept = policy.place(3, 4)
    assert (rows.tolist(), kept) == ([3, 4, 0, 1], slice(0, 4))
    rows, kept = LowestPriority(view(5)).place(0, 7)
    assert (rows.tolist(), kept) == ([0, 1, 2, 3, 4], slice(2, 7))


def test_uniform_draws_every_row_alike() -> None:
    rows, weights = Uniform(view(10)).draw(100_000, 10)
    counts = np.bincount(rows)
    np.testing.assert_allclose(counts / 100_000, 0.1, atol=0.005)
    assert counts.std() > 30  # 95 if each draw is independent of the others
    assert weights.dtype == np.float32
    assert (weights == 1).all()


@pytest.mark.parametrize(("count", "size"), [(32, 33), (32, 32), (10, 10_000), (7, 3), (32, 5)])
def test_without_replacement_none_comes_again_before_all_others(count: int, size: int) -> None:
    policy = Uniform(replace(view(size), replacement=False))
    drawn = np.zeros(size)
    for _ in range(300):
        rows, weights = policy.draw(count, size)
        times = np.bincount(rows, minlength=size)
        assert len(rows) == count
        assert (times.min(), times.max()) == (count // size, -(-count // size))
        assert (weights == 1).all()
        drawn += times
    np.testing.assert_allclose(drawn, 300 * count / size, atol=5 * max(1, 300 * count / size) ** 0.5)


@pytest.mark.parametrize(("alpha", "beta"), [(1.0, 1.0), (0.6, 0.4), (0.0, 1.0)])
def test_proportional_draws_and_weights(alpha: float, beta: float) -> None:
    priorities = np.array([1.0, 4.0, 0.0, 2.0, 0.5])
    policy = Proportional(replace(view(8), priority_exponent=alpha, importance_exponent=beta))
    policy.prioritise(np.arange(5), priorities)
    expected = np.maximum(priorities, 1e-6) ** alpha
    expected /= expected.sum()
    rows, weights = policy.draw(100_000, 5)
    np.testing.assert_allclose(np.bincount(rows, minlength=5) / 100_000, expected, atol=0.005)
    drawn = (5 * expected[rows]) ** -beta
    np.testing.assert_allclose(weights, drawn / drawn.max(), rtol=1e-5)
    assert weights.dtype == np.float32


def test_proportional_draws_once_from_each_share() -> None:
    policy = Proportional(replace(view(8), priority_exponent=1.0))
    policy.prioritise(np.arange(8), np.ones(8))
    seen = set()
    for _ in range(200):
        rows, _ = policy.draw(4, 8)
        assert (rows // 2).tolist() == [0, 1, 2, 3]
        seen.add(tuple(rows % 2))
    assert len(seen) == 16  # which of the two in a share does not depend on the other shares
