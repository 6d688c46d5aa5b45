"""What re-execution compares: every value of the learner's state, in every bit."""

from typing import Any

import pytest
import torch

from coop.lockstep.reexecute import _difference


def state(**changed: Any) -> dict[str, Any]:
    values = {"weights": torch.tensor([0.0, 1.0, torch.nan]), "updates": 3, "noise": {"state": "12"}, **changed}
    return {"networks": [values, torch.zeros(2)], "acting": 1}


def test_equal_states_are_equal() -> None:
    assert _difference(state(), state(), "agent") is None


@pytest.mark.parametrize(
    ("changed", "place"),
    [
        ({"weights": torch.tensor([-0.0, 1.0, torch.nan])}, ".weights"),
        ({"weights": torch.tensor([0.0, 1.0 + 2**-23, torch.nan])}, ".weights"),
        ({"weights": torch.tensor([0.0, 1.0, torch.nan]).double()}, ".weights"),
        ({"weights": torch.tensor([[0.0, 1.0, torch.nan]])}, ".weights"),
        ({"updates": 4}, ".updates"),
        ({"noise": {"state": "13"}}, ".noise.state"),
        ({"noise": {"state": "12", "more": 0}}, ".noise"),
        ({"noise": {}}, ".noise"),
        ({"more": 1}, ""),
    ],
)
def test_each_difference_is_named(changed: dict[str, Any], place: str) -> None:
    for mine, theirs in ((state(), state(**changed)), (state(**changed), state())):
        assert _difference(mine, theirs, "agent") == f"agent.networks[0]{place}"


def test_a_longer_list_is_another() -> None:
    assert _difference([1, 2], [1, 2, 3], "agent") == _difference([1, 2, 3], [1, 2], "agent") == "agent"
