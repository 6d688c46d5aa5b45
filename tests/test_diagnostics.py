"""Diagnostics of small buffers against numbers derived by hand: forgetting, churn, dormant units, effective rank."""

import itertools
from collections.abc import Sequence
from dataclasses import replace

import msgspec
import numpy as np
import pytest
import torch
from torch import Tensor, nn

from coop.common.settings.config import LearnerSettings, NetworkSettings, RunConfig
from coop.common.transitions import Batch
from coop.common.types import EnvSpec
from coop.learner.agent import Agent
from coop.learner.diagnostics import Diagnostics, dormant, effective_ranks, hidden_layers
from coop.learner.losses import Values

SPEC = EnvSpec("CartPole-v0", (4,), "float32", 1, 2)
CONFIG = RunConfig(method="coop", learner=LearnerSettings(gamma=0.5, double=False), network=NetworkSettings(hidden=()))

SHAPES = [(5, 6, 8), (20,)]  # of layers' activations


def batch(count: int, first: int = 0) -> Batch:
    """Transitions from frame i to frame i + 1, number `first` and after; frames are unlike each other."""
    frames = np.arange(first, first + count + 1, dtype=np.float32)[:, None].repeat(4, 1)
    index = np.arange(count, dtype=np.int32)[:, None]
    integers = np.arange(first, first + count)
    return Batch(
        frames=frames,
        obs_index=index,
        next_index=index + 1,
        actions=(integers % 2).astype(np.int32),
        rewards=np.where(integers % 2, -1, 1).astype(np.float32),
        terminated=integers % 2 == 1,
        weights=np.ones(count, np.float32),
        ids=integers,
        param_version=integers,
        age=integers,
        reuse=integers.astype(np.int32),
        span=np.full(count, 2, np.uint8),
    )


def constant(agent: Agent, number: int, values: Sequence[float]) -> None:
    """Let a network without hidden layers answer these values to every state."""
    agent.networks[number].load(torch.tensor([0.0] * 8 + list(values)))


@pytest.mark.parametrize(
    ("acting", "double", "error"),
    [
        (0, False, (1.25 + 3) / 2),  # 1 - (1 + 0.25 * 5) and 2 - -1
        (1, False, (1.5 + 6) / 2),  # 3 - (1 + 0.25 * 2) and 5 - -1
        (0, True, (1.25 + 3) / 2),
        (1, True, (1.5 + 6) / 2),
    ],
)
def test_td_error_of_two_transitions(acting: int, double: bool, error: float) -> None:
    """The first ends after two steps with reward 1, the second in a terminal state with reward -1; gamma is 0.5."""
    agent = Agent(replace(CONFIG, learner=replace(CONFIG.learner, double=double)), SPEC)
    agent.acting = acting
    constant(agent, 0, (1, 2))
    constant(agent, 1, (3, 5))
    diagnostics = Diagnostics()
    diagnostics.add(batch(2))
    row = diagnostics.row(agent)
    assert row["archive_td_error"] == error
    assert row["q_gap"] == pytest.approx(13**0.5)
    assert (row["q1_mean"], row["q2_mean"], row["q_abs_mean"]) == (1.5, 4, 2.75)
    assert "dormant_share" not in row  # no hidden layer


@pytest.mark.parametrize(("double", "bound", "error"), [(True, None, 2.25), (False, None, 1.75), (False, 1.0, 2.5)])
def test_the_targets_are_those_of_an_update(double: bool, bound: float | None, error: float) -> None:
    """4 - (1 + 0.25 * 3), 4 - (1 + 0.25 * 5) with the other network's own action, 4 - (1 + 0.25 * 2) with the bound."""
    agent = Agent(replace(CONFIG, learner=replace(CONFIG.learner, double=double, reward_bound=bound)), SPEC)
    constant(agent, 0, (4, 1))
    constant(agent, 1, (3, 5))
    diagnostics = Diagnostics()
    diagnostics.add(batch(1))
    assert diagnostics.row(agent)["archive_td_error"] == error


@pytest.mark.parametrize(("method", "drift", "churn"), [("coop", (4 + 1) / 4, 1 / 2), ("dqn", (3 + 1) / 2, 1)])
def test_drift_and_churn_since_the_last_row(method: str, drift: float, churn: float) -> None:
    """Q1 goes from (1, 2) to (4, 1), Q2 from (3, 5) to (4, 5); only Q1 is trained in dqn."""
    agent, diagnostics = Agent(replace(CONFIG, method=method), SPEC), Diagnostics()
    diagnostics.add(batch(3))
    constant(agent, 0, (1, 2))
    constant(agent, 1, (3, 5))
    assert not {"archive_drift", "policy_churn"} & diagnostics.row(agent).keys()
    constant(agent, 0, (4, 1))
    constant(agent, 1, (4, 5))
    diagnostics.add(batch(3, 3))  # what has come since was not there at the last row
    restored = Diagnostics()
    restored.load_state(diagnostics.state())
    for each in (diagnostics, restored):
        row = each.row(agent)
        assert (row["archive_drift"], row["policy_churn"]) == (drift, churn)
        row = each.row(agent)
        assert (row["archive_drift"], row["policy_churn"]) == (0, 0)


def test_churn_is_the_share_of_states() -> None:
    """Of the states x = 0, 1, 2, 3, with values (x, 2.5) and then (x, 0.5), 1 and 2 change their action."""
    agent, diagnostics = Agent(replace(CONFIG, method="dqn"), SPEC), Diagnostics()
    diagnostics.add(batch(4))
    for limit, expected in ((2.5, None), (0.5, 2 / 4)):
        agent.networks[0].load(torch.tensor([1.0, 0, 0, 0, 0, 0, 0, 0, 0, limit]))
        assert diagnostics.row(agent).get("policy_churn") == expected


def test_the_archive_holds_the_first_transitions_for_good() -> None:
    diagnostics, whole = Diagnostics(), batch(300)
    for first in range(0, 300, 50):
        diagnostics.add(batch(50, first))
    archive = diagnostics.archive
    assert archive is not None
    assert len(archive) == 64
    assert len(archive.frames) == 64 + 2  # each batch has one more frame than transitions
    for index in ("obs_index", "next_index"):
        frames, theirs = archive.frames[getattr(archive, index)], whole.frames[getattr(whole, index)[:64]]
        np.testing.assert_array_equal(frames, theirs)
    for name, column in whole.columns().items():
        assert getattr(archive, name).dtype == column.dtype
        if "index" not in name:
            np.testing.assert_array_equal(getattr(archive, name), column[:64])


def test_an_archived_batch_is_a_copy() -> None:
    diagnostics, given = Diagnostics(), batch(3)
    diagnostics.add(given)
    for array in (given.frames, *given.columns().values()):
        array[:] = 0
    assert diagnostics.archive is not None
    assert diagnostics.archive.frames[:, 0].tolist() == [0, 1, 2, 3]
    assert diagnostics.archive.ids.tolist() == [0, 1, 2]


def test_measuring_changes_nothing() -> None:
    """Not even the random numbers of a method that draws some for its targets."""
    agent, diagnostics = Agent(replace(CONFIG, network=NetworkSettings(hidden=(8,))), SPEC), Diagnostics()

    def bootstrap(next_values: Values, preferred: Values) -> Values:
        return np.asarray(next_values[:, 0] * agent.rule.rng.random(), np.float32)

    agent.rule.bootstrap = bootstrap  # type: ignore[method-assign]
    diagnostics.add(batch(64))
    agent.update(batch(32))
    before = agent.state()
    diagnostics.row(agent)
    after = agent.state()
    assert before["noise"] == after["noise"]
    assert all(map(torch.equal, before["networks"], after["networks"]))
    hooks = [module._forward_pre_hooks for network in agent.networks for module in network.module.modules()]
    assert not any(hooks)


def network(*sizes: int) -> nn.Sequential:
    layers: list[nn.Module] = []
    for inputs, outputs in itertools.pairwise(sizes):
        layers += [nn.Linear(inputs, outputs), nn.ReLU()]
    return nn.Sequential(*layers[:-1])


def test_a_dead_unit_and_the_rank_of_the_others() -> None:
    """relu(x1), relu(x2) and relu(-1), which is dead: the matrix has singular values 3^0.5 and 1."""
    module = network(2, 3, 2)
    with torch.no_grad():
        module[0].weight.copy_(torch.tensor([[1.0, 0], [0, 1], [0, 0]]))
        module[0].bias.copy_(torch.tensor([0.0, 0, -1]))
        (hidden,) = hidden_layers(module, torch.tensor([[1.0, 0], [0, 1], [1, 1]]))
    assert hidden.tolist() == [[1, 0, 0], [0, 1, 0], [1, 1, 0]]
    assert dormant(hidden.numpy()).tolist() == [False, False, True]
    assert effective_ranks([hidden.numpy()]) == [2]


def test_rows_have_a_value_for_each_hidden_layer() -> None:
    """Of 4 + 2 units, three of the first layer are dead and none of the second."""
    agent = Agent(replace(CONFIG, network=NetworkSettings(hidden=(4, 2))), SPEC)
    views = agent.networks[0].views(agent.networks[0].flat)
    for view in views.values():
        view.fill_(1)
    views["fc1.weight"].fill_(0)
    views["fc1.bias"].copy_(torch.tensor([1.0, -1, -1, -1]))
    diagnostics = Diagnostics()
    diagnostics.add(batch(8))
    row = diagnostics.row(agent)
    assert row["dormant_by_layer"] == [3 / 4, 0]
    assert row["dormant_share"] == 3 / 6
    assert row["effective_rank_by_layer"] == [1, 1]
    assert row["effective_rank"] == 1
    views["fc2.weight"].fill_(-1)
    views["fc2.bias"].fill_(0)
    row = diagnostics.row(agent)
    assert (row["dormant_by_layer"], row["effective_rank"]) == ([3 / 4, 1], 0)  # a layer that is dead altogether


@pytest.mark.parametrize(
    ("means", "expected"),
    [
        ([1, 1, 1, 0.018], [False, False, False, True]),  # 0.025 of the mean is 0.01886
        ([1, 1, 1, 0.020], [False, False, False, False]),
        ([-1, 1, 1, -0.020], [False, False, False, False]),
        ([0, 0, 0, 0], [True, True, True, True]),
    ],
)
def test_dormant_units(means: list[float], expected: list[bool]) -> None:
    layer = np.array([[2.0], [0.0]], np.float32) * np.array(means, np.float32)  # a mean over two states
    assert dormant(layer).tolist() == expected


@pytest.mark.parametrize(
    ("singular", "rank"),
    [([99.5, 0.5], 1), ([98.0, 2.0], 2), ([1.0, 1, 1], 3), ([50.0, 30, 19.5, 0.3, 0.2], 3), ([0.0], 0), ([5e-30], 1)],
)
@pytest.mark.parametrize("shape", [(64, 200), (64, 16)])
def test_effective_rank(singular: list[float], rank: int, shape: tuple[int, int]) -> None:
    rng = np.random.default_rng(0)
    left, right = (np.linalg.qr(rng.standard_normal((size, len(singular))))[0] for size in shape)
    features = (left * singular @ right.T).astype(np.float32)
    assert effective_ranks([np.ones((64, 3), np.float32), features, features.reshape(64, 2, 2, -1)]) == [1, rank, rank]


def test_the_rank_of_what_is_not_finite_does_not_exist() -> None:
    assert np.isnan(effective_ranks([np.array([[1.0, np.inf]], np.float32)])).all()


class Duelling(nn.Module):
    """Reads a scaled picture; flattens in `forward`; two heads read one layer."""

    def __init__(self) -> None:
        super().__init__()
        self.convs = nn.ModuleList([nn.Conv2d(1, 2, 1), nn.Conv2d(2, 3, 2)])
        self.value, self.advantage = nn.Linear(3 * 4, 1), nn.Linear(3 * 4, 2)

    def forward(self, x: Tensor) -> Tensor:
        x = 2 * x
        for conv in self.convs:
            x = torch.relu(conv(x))
        x = x.flatten(1)
        value: Tensor = self.value(x)
        return value + self.advantage(x)


def test_a_device_reduces_layers_to_what_the_host_does() -> None:
    rng = np.random.default_rng(0)
    layers = [rng.standard_normal((32, *shape)).astype(np.float32) * (rng.random(shape[-1]) > 0.3) for shape in SHAPES]
    assert effective_ranks([torch.from_numpy(layer) for layer in layers]) == effective_ranks(layers)
    for layer in layers:
        assert 0 < dormant(layer).mean() < 1
        assert dormant(torch.from_numpy(layer)).tolist() == dormant(layer).tolist()


def test_channels_are_the_units_of_pictures() -> None:
    module = Duelling()
    with torch.no_grad():
        for conv in module.convs:
            conv.weight.fill_(1)
            conv.bias.copy_(torch.tensor([0.0, -1e6, 0.0][: len(conv.bias)]))
        hidden = hidden_layers(module, torch.rand(5, 1, 3, 3))
    assert [layer.shape for layer in hidden] == [(5, 3, 3, 2), (5, 2, 2, 3)]
    assert [dormant(layer.numpy()).tolist() for layer in hidden] == [[False, True], [False, True, False]]


def test_channels_are_units_of_pictures_stored_with_their_channels_last() -> None:
    """Of MinAtar's 16 channels, 12 are dead, and none of its 128 other units."""
    agent = Agent(replace(CONFIG, network=NetworkSettings(kind="minatar")), EnvSpec("x", (10, 10, 4), "bool", 1, 2))
    views = agent.networks[0].views(agent.networks[0].flat)
    views["conv1.weight"].fill_(0)
    views["conv1.bias"].copy_(torch.tensor([1.0] * 4 + [-1.0] * 12))
    diagnostics = Diagnostics()
    diagnostics.add(msgspec.structs.replace(batch(3), frames=np.zeros((4, 10, 10, 4), np.bool_)))
    views["fc1.weight"].fill_(0)
    views["fc1.bias"].fill_(1)
    assert diagnostics.row(agent)["dormant_share"] == 12 / 144


def test_a_flattened_input_is_no_hidden_layer() -> None:
    module = nn.Sequential(nn.Flatten(), network(9, 4, 2))
    with torch.no_grad():
        hidden = hidden_layers(module, torch.rand(5, 1, 3, 3))
        assert [layer.shape for layer in hidden] == [(5, 4)]
        assert hidden_layers(nn.Sequential(nn.Flatten()), torch.rand(5, 1, 3, 3)) == []
