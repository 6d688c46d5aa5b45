"""The line with which a run ends."""

import pytest

from learner.records.summary import Summary


@pytest.mark.parametrize(
    ("episodes", "returns"),
    [
        (0, "no episode ended"),
        (1, "return of 1 episode 22.6 (20.8)"),
        (100, "return of 100 episodes 22.6 (20.8)"),
        (1234, "return of the last 100 episodes 22.6 (20.8)"),
    ],
)
def test_it_says_how_many_episodes_the_return_is_of(episodes: int, returns: str) -> None:
    summary = Summary("dqn", "CartPole-v0", 0, 1000, 900, episodes, 22.6, 20.8, 3.4, 1000, 0, 0, "complete")
    assert str(summary) == f"complete: 1,000 steps, 900 updates, {returns}, 3 s"
