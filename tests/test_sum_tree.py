"""The sums behind proportional sampling: numpy's and compiled loops give the same bits, and never find a zero."""

from __future__ import annotations

import sys

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from coop.replay.table.sum_tree import SumTree, make_sum_tree

pytest.importorskip("numba")
from coop.replay.table.compiled_tree import CompiledSumTree

kinds = pytest.mark.parametrize("kind", [SumTree, CompiledSumTree])


@kinds
@given(
    capacity=st.sampled_from([1, 5, 64, 65, 300, 2048, 2049, 5000]),
    updates=st.lists(st.tuples(st.integers(0, 4999), st.floats(0, 1e6)), min_size=1, max_size=60),
    fractions=st.lists(st.floats(0, 1, exclude_max=True), min_size=1, max_size=20),
)
def test_equals_running_sums(
    kind: type[SumTree], capacity: int, updates: list[tuple[int, float]], fractions: list[float]
) -> None:
    tree, values = kind(capacity), np.zeros(capacity)
    rows = np.array([row % capacity for row, _ in updates])
    given_values = np.array([value for _, value in updates])
    values[rows] = given_values
    tree.update(rows, given_values)
    np.testing.assert_array_equal(tree.values(np.arange(capacity)), values)
    assert tree.total == pytest.approx(values.sum())
    again = kind(capacity)
    again.update(np.arange(capacity), values)
    for one, other in zip(again.levels + again.running, tree.levels + tree.running, strict=True):
        np.testing.assert_array_equal(one, other)
    if tree.total > 0:
        sums = np.array(fractions) * tree.total
        found = tree.find(sums)
        assert (values[found] > 0).all()
        before = np.concatenate([[0.0], np.cumsum(values)])
        margin = 1e-9 * tree.total
        assert (before[found] - margin <= sums).all()
        assert (sums <= before[found + 1] + margin).all()


@kinds
@pytest.mark.parametrize("value", [2.0, 2.0**-20])
@pytest.mark.parametrize("capacity", [1, 64, 65, 2048, 2049, 5000, 140_000])
def test_finds_every_row(kind: type[SumTree], capacity: int, value: float) -> None:
    tree = kind(capacity)
    tree.update(np.arange(capacity), np.full(capacity, value))
    assert tree.total == value * capacity
    for share in (0.0, 0.5, 0.75):
        np.testing.assert_array_equal(tree.find(value * (np.arange(capacity) + share)), np.arange(capacity))
    assert tree.find(np.array([tree.total])).tolist() == [capacity - 1]  # to which a share below 1 may be rounded


@kinds
def test_rounds_inside_a_group(kind: type[SumTree]) -> None:
    """A sum below its node's end may equal the end after the sum before the node is taken away."""
    values = np.zeros(4096)
    values[0], values[64] = 1.5 * 2**-53, 1 - 2**-52
    tree = kind(4096)
    tree.update(np.arange(4096), values)
    assert tree.find(np.array([1 - 2**-53])).tolist() == [64]


@kinds
@pytest.mark.parametrize("largest", [1.0, 1e-6])
def test_at_the_seams(kind: type[SumTree], largest: float) -> None:
    """Sums at the border of two values, where rounding decides, never find a value of 0 or a row that isn't there."""
    rng = np.random.default_rng(0)
    for _ in range(300):
        values = largest * rng.random(200) * (rng.random(200) < 0.5)
        tree = kind(200)
        tree.update(np.arange(200), values)
        seams = np.concatenate([level.cumsum(axis=-1).reshape(-1) for level in tree.levels])
        sums = np.concatenate([np.nextafter(seams, 0), seams, np.nextafter(seams, np.inf)])
        found = tree.find(sums[sums < tree.total])
        assert found.max() < 200
        assert (values[found] > 0).all()


@given(
    capacity=st.sampled_from([1, 5, 65, 2049, 5000, 140_000]),
    seed=st.integers(0, 2**32),
    batches=st.lists(st.integers(1, 100), min_size=1, max_size=8),
)
def test_compiled_loops_give_the_same_bits(capacity: int, seed: int, batches: list[int]) -> None:
    rng = np.random.default_rng(seed)
    plain, compiled = SumTree(capacity), CompiledSumTree(capacity)
    for count in batches:
        first = int(rng.integers(capacity))  # of rows one after another, as a segment's, or anywhere, as a batch's
        rows = (first + np.arange(count)) % capacity if rng.random() < 0.5 else rng.integers(0, capacity, count)
        values = np.where(rng.random(count) < 0.2, 0, rng.random(count) ** 9)
        plain.update(rows, values)
        compiled.update(rows, values)
        for one, other in zip(plain.levels + plain.running, compiled.levels + compiled.running, strict=True):
            np.testing.assert_array_equal(one, other)
        if plain.total > 0:
            sums = np.minimum(rng.random(64), 1 - 2.0**-53) * plain.total
            np.testing.assert_array_equal(plain.find(sums), compiled.find(sums))
            places = rng.random(int(rng.integers(1, 100)))
            rows, drawn = plain.draw(places)
            assert (drawn > 0).all()
            np.testing.assert_array_equal(compiled.draw(places), (rows, drawn))


def test_sampling_takes_the_compiled_tree_where_numba_is(monkeypatch: pytest.MonkeyPatch) -> None:
    assert type(make_sum_tree(3)) is CompiledSumTree
    monkeypatch.setitem(sys.modules, "coop.replay.table.compiled_tree", None)
    assert type(make_sum_tree(3)) is SumTree
