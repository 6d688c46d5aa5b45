"""Policies of eviction and sampling that see observations, rewards, episodes and what comes, and may refuse it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from samples import make_segment

from coop.common.errors import RunError, UsageError
from coop.common.settings.policies import EVICTIONS, SAMPLERS, EvictionPolicy, SamplingPolicy
from coop.common.types import EnvSpec, EpisodeEnd
from coop.replay.table.policies import Eviction, Incoming, Sampling
from coop.replay.table.selection import Fifo
from coop.replay.table.table import Table

SPEC = EnvSpec("any", (2,), "float32", 1, 3)
EXAMPLES = Path(__file__).parents[1] / "examples" / "methods"
SEEN: dict[str, Any] = {}


@pytest.fixture(autouse=True)
def _examples(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(EXAMPLES)


class Refusing(Fifo):
    """Keeps what has an even reward; notes what it sees."""

    episodes = True

    def admit(self, incoming: Incoming) -> Any:
        kept = np.flatnonzero(incoming.rewards % 2 == 0)
        SEEN["observations"], SEEN["next"] = incoming.observations(), incoming.next_observations()
        SEEN["episodes"], SEEN["table"] = incoming.episodes, self.table
        size, capacity = self.table.size, self.table.capacity
        rows = np.append(np.arange(size, capacity), np.argsort(self.table.ids[:size], kind="stable"))
        return rows[: len(kept)], kept


def table_of(policy: type, capacity: int = 6, spec: EnvSpec = SPEC) -> Table:
    kind, make = ("eviction", EVICTIONS) if issubclass(policy, Eviction) else ("sampling", SAMPLERS)
    entry: Any = EvictionPolicy if kind == "eviction" else SamplingPolicy
    make._own["own:Policy"] = entry("own:Policy", policy, policy.priorities, policy.episodes)  # type: ignore[attr-defined]
    return Table(spec, capacity, rng=np.random.default_rng(0), **{kind: "own:Policy"})


def ends(*steps: int) -> tuple[EpisodeEnd, ...]:
    return tuple(EpisodeEnd(step, 0.0, 1, 0.1, 0.0, 0.0, 0) for step in steps)


def test_what_a_policy_sees_and_refuses() -> None:
    """Rewards, and the first number of an observation, count transitions; episodes end behind the 2nd and the 3rd."""
    table = table_of(Refusing)
    actions, terminated = np.arange(4, dtype=np.int32) % 3, np.array([False, False, True, False])
    table.insert(make_segment(SPEC, 0, 4, episodes=ends(1, 2), actions=actions, terminated=terminated))
    assert (len(table), table.inserted, table.evicted_unsampled) == (2, 4, 2)
    assert SEEN["episodes"].tolist() == [0, 0, 1, 2]
    assert (SEEN["observations"][:, 0].tolist(), SEEN["next"][:, 0].tolist()) == ([0, 1, 2, 3], [1, 2, 3, 4])
    view, rows = SEEN["table"], np.arange(2)
    assert view.observations(rows)[:, 0].tolist() == [0, 2]
    assert view.next_observations(rows)[:, 0].tolist() == [1, 3]
    assert view.terminated[:2].tolist() == [False, True]
    assert (view.rewards[:2].tolist(), view.actions[:2].tolist(), view.episodes[:2].tolist()) == (
        [0, 2],
        [0, 2],
        [0, 1],
    )
    table.insert(make_segment(SPEC, 1, 4, episodes=()))
    assert SEEN["episodes"].tolist() == [2, 2, 2, 2], "an episode goes on from segment to segment"
    table.insert(make_segment(SPEC, 0, 4, incarnation=8, episodes=ends(3)))
    assert SEEN["episodes"].tolist() == [3, 3, 3, 3]
    table.insert(make_segment(SPEC, 2, 4, episodes=()))
    assert SEEN["episodes"].tolist() == [2, 2, 2, 2]
    assert len(table) == 6
    assert sorted(table.sample(200).rewards.astype(int).tolist())[:1] == [0]


def test_a_policy_that_uses_no_episodes_is_told_of_none() -> None:
    class Without(Refusing):
        episodes = False

    table_of(Without).insert(make_segment(SPEC, episodes=ends(1, 2)))
    assert (SEEN["episodes"].tolist(), SEEN["episodes"].dtype) == ([0] * 4, np.int64)
    assert (SEEN["table"].episodes.shape, SEEN["table"].episodes.dtype) == ((0,), np.int64)


def test_a_sampling_sees_episodes_whatever_the_eviction() -> None:
    class Counting(Sampling):
        episodes = True

        def draw(self, count: int, size: int) -> Any:
            SEEN["episodes"] = self.table.episodes[:size].tolist()
            return np.arange(count), np.ones(count)

    table = table_of(Counting)
    table.insert(make_segment(SPEC, episodes=ends(1, 2)))
    table.sample(1)
    assert SEEN["episodes"] == [0, 0, 1, 2]


def test_stacked_observations() -> None:
    spec = EnvSpec("any", (2,), "float32", 3, 3)
    table = table_of(Refusing, spec=spec)
    index = np.array([[0, 0, 0], [0, 0, 1], [0, 1, 2], [1, 2, 3]], np.int32)
    following = np.array([[0, 0, 1], [0, 1, 2], [1, 2, 3], [2, 3, 4]], np.int32)
    table.insert(make_segment(spec, 0, 4, obs_index=index, next_index=following))
    assert SEEN["table"].observations(np.arange(2))[..., 0].tolist() == [[0, 0, 0], [0, 1, 2]]
    assert SEEN["next"][..., 0].tolist() == following.tolist()


def test_a_restored_table_goes_on_as_the_saved_one() -> None:
    one = table_of(Refusing)
    for sequence in range(2):
        one.insert(make_segment(SPEC, sequence, 3, episodes=ends(*[1] * (sequence == 1))))
    other = table_of(Refusing)
    with one.snapshot().frames as frames:
        meta, arrays, _ = one.snapshot()
        other.load_state(meta, {**arrays, "frames": frames.read()})
    assert len(one) == len(other) == 3
    numbers = []
    for table in (one, other):
        table.insert(make_segment(SPEC, 2, 3, episodes=()))
        numbers.append((SEEN["episodes"].tolist(), SEEN["table"].episodes.tolist()))
    assert numbers[0] == numbers[1]
    np.testing.assert_array_equal(one.sample(50).rewards, other.sample(50).rewards)


@pytest.mark.parametrize(
    ("rows", "kept", "words"),
    [
        ([0, 0], slice(0, 2), "a row twice"),
        ([0, 2], slice(0, 2), r"rows \[0, 2\] with 0 in use"),
        ([0], slice(0, 2), "1 rows for 2 transitions"),
        ([0, 6], slice(0, 2), "rows from 0 to 6, must be from 0 to 5"),
        ([-1, 0], slice(0, 2), "rows from -1 to 0"),
    ],
)
def test_impossible_rows_are_refused_and_change_nothing(rows: list[int], kept: slice, words: str) -> None:
    class Wrong(Eviction):
        def place(self, first: int, count: int) -> Any:
            assert (first, count) == (0, 4)
            return np.array(rows), kept

    table = table_of(Wrong)
    with pytest.raises(UsageError, match=f"replay.eviction = 'own:Policy': gives {words}"):
        table.insert(make_segment(SPEC))
    assert (len(table), table.inserted) == (0, 0)


@pytest.mark.parametrize(
    ("rows", "weights", "words"),
    [
        ([0, 9], 2, "rows 0 to 9 of 4"),
        ([0, 4], 2, "rows 0 to 4 of 4"),
        ([-1, 0], 2, "rows -1 to 0"),
        ([0], 1, r"1 rows, weights of shape \(1,\), not 2"),
        ([0, 1], 1, r"2 rows, weights of shape \(1,\), not 2"),
        ([0], 2, r"1 rows, weights of shape \(2,\), not 2"),
        ([0.0, 1.0], 2, r"the rows float64\[2\] from 0 to 1, must be whole numbers"),
    ],
)
def test_impossible_draws_are_refused(rows: list[int], weights: int, words: str) -> None:
    class Wrong(Sampling):
        def draw(self, count: int, size: int) -> Any:
            return np.array(rows), np.ones(weights, np.float32)

    table = table_of(Wrong)
    table.insert(make_segment(SPEC))
    with pytest.raises(UsageError, match=f"replay.sampling = 'own:Policy': draws {words}"):
        table.sample(2)


@pytest.mark.parametrize(
    ("answer", "words"),
    [
        (None, r"None, must be \(rows, kept\)"),
        (("ab", 1, 2), r"\('ab', 1, 2\), must be"),
        ((np.zeros((2, 1), int), slice(0, 2)), r"the rows int64\[2, 1\] from 0 to 0, must be whole numbers"),
        ((np.array([True, False]), slice(0, 2)), r"the rows bool\[2\]"),
        (([0], None), "kept None, must be a slice, or ascending positions among 4"),
        (([0], [7]), "kept list|kept \\[7\\]"),
        (([0, 1], [2, 1]), "kept"),
        (([0], [0.0]), "kept"),
    ],
)
def test_answers_of_another_form_are_refused(answer: Any, words: str) -> None:
    class Wrong(Eviction):
        def place(self, first: int, count: int) -> Any:
            return answer

    table = table_of(Wrong)
    with pytest.raises(UsageError, match=f"^replay.eviction = 'own:Policy': gives {words}"):
        table.insert(make_segment(SPEC))
    assert (len(table), table.inserted) == (0, 0)


@pytest.mark.parametrize("weights", [[np.nan, 1], [np.inf, 1], [-1, 1], ["a", "b"], None])
def test_weights_that_are_none_are_refused(weights: Any) -> None:
    class Wrong(Sampling):
        def draw(self, count: int, size: int) -> Any:
            return [0, 1], weights

    table = table_of(Wrong)
    table.insert(make_segment(SPEC))
    with pytest.raises(UsageError, match=r"^replay.sampling = 'own:Policy': draws .*weights"):
        table.sample(2)


def test_lists_and_small_types_will_do() -> None:
    class Listing(Fifo):
        def place(self, first: int, count: int) -> Any:
            rows, _ = super().place(first, count)
            return rows.astype(np.uint8), [True] * count

    class Drawing(Sampling):
        def draw(self, count: int, size: int) -> Any:
            return list(range(count)), [1] * count

    table_of(Listing).insert(make_segment(SPEC))
    table = table_of(Drawing)
    table.insert(make_segment(SPEC))
    batch = table.sample(3)
    assert batch.rewards.tolist() == [0, 1, 2]
    assert (batch.weights.dtype, batch.weights.tolist()) == (np.float32, [1, 1, 1])


def test_a_policy_that_fails_is_named_with_its_place_and_writes_to_no_column() -> None:
    class Writing(Fifo):
        def place(self, first: int, count: int) -> Any:
            self.table.rewards[:] = 7
            return super().place(first, count)

    class Exiting(Sampling):
        def draw(self, count: int, size: int) -> Any:
            raise SystemExit("no licence")

    table = table_of(Writing)
    with pytest.raises(
        RunError, match=r"^replay.eviction = 'own:Policy' raised ValueError: .*read-only \(test_own_pol"
    ):
        table.insert(make_segment(SPEC))
    assert (len(table), table.inserted) == (0, 0)
    table = table_of(Exiting)
    table.insert(make_segment(SPEC))
    words = r"^replay.sampling = 'own:Policy' raised SystemExit: no licence \(test_own_policies.py:\d+\)$"
    with pytest.raises(RunError, match=words):
        table.sample(2)


def test_a_policy_that_fails_at_new_priorities_is_named() -> None:
    class Dividing(Sampling):
        priorities = True

        def draw(self, count: int, size: int) -> Any:
            return np.arange(count), np.ones(count, np.float32)

        def prioritise(self, rows: Any, priorities: Any) -> None:
            raise ZeroDivisionError("nothing")

    table = table_of(Dividing)
    with pytest.raises(RunError, match=r"^replay.sampling = 'own:Policy' raised ZeroDivisionError: nothing"):
        table.insert(make_segment(SPEC))


def test_best_returns_keeps_the_best_episodes() -> None:
    """Episodes of returns 9, 1 and 6, of three transitions each; the next three find room where the return is 1."""
    from best_returns import BestReturns  # noqa: PLC0415

    table = table_of(BestReturns, 9)
    for sequence, reward in enumerate((3, 1 / 3, 2, 5)):
        table.insert(make_segment(SPEC, sequence, 3, rewards=np.full(3, reward, np.float32)))
    held = np.sort(np.unique(table.sample(300).rewards))
    np.testing.assert_allclose(held, [2, 3, 5])


def test_coverage_keeps_rare_observations() -> None:
    """Of 40 transitions near one point and one at another, a table of ten keeps the one, and refuses the rest."""
    from hashed_coverage import Coverage  # noqa: PLC0415

    table = table_of(Coverage, 10)
    for sequence in range(41):
        frames = np.full((2, 2), -1.0 if sequence == 3 else 1.0, np.float32)
        table.insert(make_segment(SPEC, sequence, 1, frames=frames, carried=0))
    assert len(table) == 10
    batch = table.sample(200)
    assert (batch.frames[batch.obs_index[:, 0]][:, 0] < 0).any()
    assert batch.ids.max() == 9, "all behind the first ten are refused"


def test_the_newest_transition_is_in_every_batch() -> None:
    from recency import Combined  # noqa: PLC0415

    table = table_of(Combined, 6)
    for sequence in range(5):
        table.insert(make_segment(SPEC, sequence, 2))
        assert all((table.sample(3).age == 0).any() for _ in range(10))


def test_ages_fall_geometrically() -> None:
    """Of 100 transitions with a mean age of 25 before the cut: P(age) = c 0.96^age."""
    from recency import Geometric  # noqa: PLC0415

    table = table_of(Geometric, 100)
    for sequence in range(30):
        table.insert(make_segment(SPEC, sequence, 5))
    drawn = np.bincount(table.sample(40_000).age, minlength=100)
    expected = 0.96 ** np.arange(100)
    expected *= 40_000 / expected.sum()
    assert ((drawn - expected) ** 2 / expected).sum() < 160, "chi squared, 99 degrees of freedom: p = 0.0001"
