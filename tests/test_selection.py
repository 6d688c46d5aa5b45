"""Each policy against its definition: which row goes, which is drawn how often, and with what weight."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from coop.replay.table.policies import Floats, Rows, TableView
from coop.replay.table.selection import Fifo, LowestPriority, Proportional, Reservoir, SumTree, Uniform


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


@given(
    capacity=st.sampled_from([1, 5, 64, 65, 300, 2048, 2049, 5000]),
    updates=st.lists(st.tuples(st.integers(0, 4999), st.floats(0, 1e6)), min_size=1, max_size=60),
    fractions=st.lists(st.floats(0, 1, exclude_max=True), min_size=1, max_size=20),
)
def test_sum_tree_equals_running_sums(capacity: int, updates: list[tuple[int, float]], fractions: list[float]) -> None:
    tree, values = SumTree(capacity), np.zeros(capacity)
    rows = np.array([row % capacity for row, _ in updates])
    given_values = np.array([value for _, value in updates])
    values[rows] = given_values
    tree.update(rows, given_values)
    np.testing.assert_array_equal(tree.values(np.arange(capacity)), values)
    assert tree.total == pytest.approx(values.sum())
    again = SumTree(capacity)
    again.update(np.arange(capacity), values)
    for one, other in zip(again._levels + again._running, tree._levels + tree._running, strict=True):
        np.testing.assert_array_equal(one, other)
    if tree.total > 0:
        sums = np.array(fractions) * tree.total
        found = tree.find(sums)
        assert (values[found] > 0).all()
        before = np.concatenate([[0.0], np.cumsum(values)])
        margin = 1e-9 * tree.total
        assert (before[found] - margin <= sums).all()
        assert (sums <= before[found + 1] + margin).all()


@pytest.mark.parametrize("value", [2.0, 2.0**-20])
@pytest.mark.parametrize("capacity", [1, 64, 65, 2048, 2049, 5000, 140_000])
def test_sum_tree_finds_every_row(capacity: int, value: float) -> None:
    tree = SumTree(capacity)
    tree.update(np.arange(capacity), np.full(capacity, value))
    assert tree.total == value * capacity
    for share in (0.0, 0.5, 0.75):
        np.testing.assert_array_equal(tree.find(value * (np.arange(capacity) + share)), np.arange(capacity))
    assert tree.find(np.array([tree.total])).tolist() == [capacity - 1]  # to which a share below 1 may be rounded


def test_sum_tree_rounds_inside_a_group() -> None:
    """A sum below its node's end may equal the end after the sum before the node is taken away."""
    values = np.zeros(4096)
    values[0], values[64] = 1.5 * 2**-53, 1 - 2**-52
    tree = SumTree(4096)
    tree.update(np.arange(4096), values)
    assert tree.find(np.array([1 - 2**-53])).tolist() == [64]


@pytest.mark.parametrize("largest", [1.0, 1e-6])
def test_sum_tree_at_the_seams(largest: float) -> None:
    """Sums at the border of two values, where rounding decides, never find a value of 0 or a row that isn't there."""
    rng = np.random.default_rng(0)
    for _ in range(300):
        values = largest * rng.random(200) * (rng.random(200) < 0.5)
        tree = SumTree(200)
        tree.update(np.arange(200), values)
        seams = np.concatenate([level.cumsum(axis=-1).reshape(-1) for level in tree._levels])
        sums = np.concatenate([np.nextafter(seams, 0), seams, np.nextafter(seams, np.inf)])
        found = tree.find(sums[sums < tree.total])
        assert found.max() < 200
        assert (values[found] > 0).all()
