"""Losses and TD errors on numbers worked out by hand."""

import numpy as np
import pytest
import torch

from coop.common.settings.config import LearnerSettings
from coop.common.transitions import Batch
from coop.learner.losses import LOSSES, columns, output_error, td_errors

ERRORS = np.array([-3.0, -1.0, -0.5, 0.0, 0.5, 1.0, 1.5], np.float32)


def make_batch(**fields: list[float]) -> Batch:
    """Transitions of which only actions, rewards, ends, spans and weights matter."""
    size = len(fields["actions"])
    index, numbers = np.zeros((size, 1), np.int32), np.zeros(size, np.int64)
    return Batch(
        frames=np.zeros((1, 1), np.float32),
        obs_index=index,
        next_index=index,
        actions=np.array(fields["actions"], np.int32),
        rewards=np.array(fields.get("rewards", [0.0] * size), np.float32),
        terminated=np.array(fields.get("terminated", [False] * size), np.bool_),
        span=np.array(fields.get("span", [1] * size), np.uint8),
        weights=np.array(fields.get("weights", [1.0] * size), np.float32),
        ids=numbers,
        param_version=numbers,
        age=numbers,
        reuse=numbers.astype(np.int32),
    )


@pytest.mark.parametrize(
    ("name", "costs", "slopes"),
    [
        ("squared", [4.5, 0.5, 0.125, 0.0, 0.125, 0.5, 1.125], ERRORS.tolist()),
        ("mse", [9.0, 1.0, 0.25, 0.0, 0.25, 1.0, 2.25], [-6.0, -2.0, -1.0, 0.0, 1.0, 2.0, 3.0]),
        ("huber", [2.5, 0.5, 0.125, 0.0, 0.125, 0.5, 1.0], [-1.0, -1.0, -0.5, 0.0, 0.5, 1.0, 1.0]),
    ],
)
def test_costs_and_slopes(name: str, costs: list[float], slopes: list[float]) -> None:
    loss = LOSSES[name]
    for found, expected in ((loss.cost(ERRORS), costs), (loss.slope(ERRORS), slopes)):
        assert found.dtype == np.float32
        assert found.tolist() == expected
    tensor = torch.from_numpy(ERRORS)
    torch.testing.assert_close(loss.cost(tensor), torch.tensor(costs), rtol=0, atol=0)
    torch.testing.assert_close(loss.slope(tensor), torch.tensor(slopes), rtol=0, atol=0)


def test_td_errors() -> None:
    batch = make_batch(
        actions=[0, 1, 1, 0], rewards=[1.0, 2.0, -1.0, 0.0], terminated=[False, True, False, False], span=[1, 1, 3, 2]
    )
    values = np.array([[1.0, 9.0], [9.0, 3.0], [9.0, 0.5], [4.0, 9.0]], np.float32)
    errors = td_errors(columns(batch, 0.5), values, np.array([2.0, 9.0, 8.0, 4.0], np.float32))
    assert errors.dtype == np.float32
    # 1 - (1 + 2/2); 3 - 2, without a future; 0.5 - (-1 + 8/8); 4 - 4/4
    assert errors.tolist() == [-1.0, 1.0, 0.5, 3.0]


def test_targets_take_no_value_beyond_the_bound() -> None:
    """r + 0.5 V with V clipped to +-4: 1 + 2, 1 - 2, 1 + 1; the network's own value, 9, is not clipped."""
    batch = make_batch(actions=[0, 0, 0], rewards=[1.0, 1.0, 1.0])
    values, bootstrap = np.full((3, 1), 9, np.float32), np.array([6.0, -6.0, 2.0], np.float32)
    errors = td_errors(columns(batch, 0.5), values, bootstrap, value_bound=4.0)
    assert errors.dtype == np.float32
    assert errors.tolist() == [6.0, 10.0, 7.0]


def test_rewards_bound_values() -> None:
    bounds = [LearnerSettings(gamma=gamma, reward_bound=reward).value_bound for gamma, reward in ((0.75, 3), (0, 3))]
    assert bounds == [12, 3]
    assert LearnerSettings(gamma=0.75).value_bound is None
    assert LearnerSettings(gamma=1, reward_bound=3).value_bound is None


def test_only_the_actions_taken_have_an_error() -> None:
    batch = make_batch(actions=[1, 0], weights=[1.0, 0.5])
    error = output_error(columns(batch, 0.5), np.array([4.0, 6.0], np.float32), np.empty((2, 3), np.float32))
    assert error.dtype == np.float32
    assert error.tolist() == [[0.0, 2.0, 0.0], [1.5, 0.0, 0.0]]
