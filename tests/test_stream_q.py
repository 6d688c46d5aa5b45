"""Stream Q(lambda) against numbers derived by hand and against autograd."""

import math
from typing import Any

import msgspec
import numpy as np
import pytest
import torch

from coop.common.errors import UsageError
from coop.common.networks.network import FlatNetwork, sample_inputs
from coop.common.networks.normalised import NormalisedNetwork
from coop.common.networks.sparse import sparse_, sparse_network
from coop.common.settings.config import LearnerSettings, NetworkSettings, RunConfig
from coop.common.settings.stream_q import StreamQSettings
from coop.common.types import Array, EnvSpec
from coop.learner.methods.moments import RewardScale, RunningMoments
from coop.learner.methods.stream_q import StreamAgent, Transition
from coop.learner.methods.traces import Traces, bounded_step

ONE = EnvSpec("one", (1,), "float32", 1, 2)
FOUR = EnvSpec("four", (4,), "float32", 1, 3)
PICTURE = EnvSpec("picture", (10, 10, 4), "bool", 1, 3)
STACKED = EnvSpec("stacked", (6, 5), "uint8", 2, 3)


def form_of(network: FlatNetwork) -> NormalisedNetwork:
    assert isinstance(network.in_numpy, NormalisedNetwork)
    return network.in_numpy


def network_of(kind: str, spec: EnvSpec, hidden: tuple[int, ...] = (16, 8)) -> FlatNetwork:
    """A network whose parameters are all different from 0."""
    network = FlatNetwork(sparse_network(kind, spec, hidden, 3))
    noise = np.random.default_rng(0).standard_normal(network.flat.numel(), np.float32)
    network.load(network.snapshot() + 0.1 * noise)
    form_of(network).sd[...] = np.abs(form_of(network).sd) + 0.5
    return network


NETWORKS = [("mlp", FOUR), ("mlp", STACKED), ("minatar", PICTURE)]


@pytest.mark.parametrize(("kind", "spec"), NETWORKS)
def test_the_form_in_numpy_gives_what_pytorch_gives(kind: str, spec: EnvSpec) -> None:
    network = network_of(kind, spec)
    x = sample_inputs(spec, 5)
    with torch.no_grad():
        expected = network.module(x).numpy()
    np.testing.assert_allclose(form_of(network)(x.numpy()), expected, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize(("kind", "spec"), NETWORKS)
def test_the_gradient_is_autograds(kind: str, spec: EnvSpec) -> None:
    network = network_of(kind, spec)
    traces = Traces(network, form_of(network))
    traces.z.fill_(2.0)
    traces.z[: form_of(network).mean.size * 2] = 0  # of mean and sd, which are no parameters of the gradient
    expected = traces.z.clone()
    for x, action in zip(sample_inputs(spec, 2).split(1), (2, 0), strict=True):
        trained = {name: p for name, p in network.module.named_parameters() if p.requires_grad}
        gradients = torch.autograd.grad(network.module(x)[0, action], list(trained.values()))
        by_name = dict(zip(trained, gradients, strict=True))
        parts = [by_name.get(name, torch.zeros(shape)).flatten() for name, shape in network.layout]
        expected = 0.7 * expected + torch.cat(parts)
        traces.add(form_of(network).record(x.numpy()), action, 0.7)
    torch.testing.assert_close(traces.z, expected, rtol=1e-4, atol=1e-5)


def test_the_slope_of_a_unit_at_0_is_the_leaky_one_as_autograds() -> None:
    """Without weights and biases each unit's normalised value is 0."""
    network = FlatNetwork(sparse_network("mlp", FOUR, (4,), 3))
    for name, view in network.views(network.flat).items():
        if name.startswith("fc1"):
            view.zero_()
        elif name.startswith("out"):
            view.copy_(torch.arange(float(view.numel())).view_as(view))
    traces, x = Traces(network, form_of(network)), sample_inputs(FOUR, 1)
    traces.add(form_of(network).record(x.numpy()), 1, 0.0)
    (expected,) = torch.autograd.grad(network.module(x)[0, 1], [dict(network.module.named_parameters())["fc1.bias"]])
    found = network.views(traces.z)["fc1.bias"]
    torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-5)


def test_moments_by_hand() -> None:
    """Of 1, 3, 8: mean 4, squared deviations 9 + 1 + 16."""
    moments = RunningMoments((2,))
    np.testing.assert_allclose(moments.sd, [1, 1])
    moments.add(np.array([1.0, -1.0]))
    np.testing.assert_allclose(moments.sd, [1, 1])
    for value in (3.0, 8.0):
        moments.add(np.array([value, -value]))
    np.testing.assert_allclose(moments.mean, [4, -4])
    np.testing.assert_allclose(moments.sd, [math.sqrt(13)] * 2)
    same = RunningMoments((2,))
    same.load_state(moments.state())
    for each in (moments, same):
        each.add(np.array([0.0, 0.0]))
    np.testing.assert_array_equal(same.sd, moments.sd)


def test_rewards_by_hand() -> None:
    """gamma = 0.5. u is 1; 3, as the episode ends there; then 0.5 * 3 + 2 = 3.5. Variances: 1, 2, 1.75."""
    scale = RewardScale(0.5)
    scales = [scale(1.0, ended=False), scale(3.0, ended=True), scale(2.0, ended=False)]
    assert scales == pytest.approx([1, 3 / math.sqrt(2), 2 / math.sqrt(1.75)])


@pytest.mark.parametrize(
    ("step_size", "bound", "delta", "norm", "expected"),
    [
        (1.0, 2.0, 0.5, 0.25, 1.0),  # M = 2 * 1 * 0.25 = 0.5
        (1.0, 2.0, -3.0, 4.0, 1 / 24),
        (1.0, 3.0, 0.5, 4.0, 1 / 12),
        (0.5, 2.0, 0.1, 4.0, 0.5 / 4),
        (0.5, 2.0, 0.1, 0.9, 0.5),  # M = 0.9
        (1.0, 2.0, 1.0, 0.0, 1.0),
    ],
)
def test_bounded_steps(step_size: float, bound: float, delta: float, norm: float, expected: float) -> None:
    assert bounded_step(step_size, bound, delta, norm) == pytest.approx(expected)


@pytest.mark.parametrize(("inputs", "zeros"), [(1, 0), (4, 3), (10, 9), (36, 32), (128, 115)])
def test_each_unit_begins_with_a_tenth_of_its_weights(inputs: int, zeros: int) -> None:
    weight = torch.full((200, inputs), 9.0)
    sparse_(weight, torch.Generator().manual_seed(1))
    assert ((weight == 0).sum(1) == zeros).all()
    used = weight[weight != 0].abs() * math.sqrt(inputs)
    assert 0.9 < used.max() <= 1
    assert abs(used.mean() - 0.5) < 0.1, "uniform"
    patterns = {tuple(row) for row in (weight != 0).tolist()}
    assert len(patterns) >= min(inputs, 190), "the inputs are chosen at random for each unit"


def test_the_network_has_layer_norms_before_leaky_relus_and_no_biases() -> None:
    mlp, minatar = (sparse_network(kind, spec, (8, 8), 0) for kind, spec in (("mlp", FOUR), ("minatar", PICTURE)))
    names = [name for name, _ in mlp.named_children()]
    assert names == ["standardize", "fc1", "norm1", "relu1", "fc2", "norm2", "relu2", "out"]
    kinds = [type(layer).__name__ for layer in minatar.children()]
    assert kinds == [
        *("Standardize", "Conv2d", "LayerNorm", "LeakyReLU", "Flatten"),
        *("Linear", "LayerNorm", "LeakyReLU", "Linear"),
    ]
    for module in (mlp, minatar):
        assert all((p == 0).all() for name, p in module.named_parameters() if name.endswith("bias"))
    first, second, other = (FlatNetwork(sparse_network("mlp", FOUR, (8, 8), seed)).flat for seed in (0, 0, 1))
    assert torch.equal(first, second)
    assert not torch.equal(first, other)


@pytest.mark.parametrize("kind", ["nature", "nips2013", "custom_networks:make"])
def test_other_networks_are_refused_by_name(kind: str) -> None:
    with pytest.raises(UsageError, match=f"network.kind = '{kind}': allowed: mlp, minatar"):
        sparse_network(kind, PICTURE, (), 0)


def linear_agent() -> StreamAgent:
    """Q(x, 0) = x + 0.5 and Q(x, 1) = -x of the standardized x; gamma = lambda = 0.5. The first observation is 1."""
    own = StreamQSettings(trace_decay=0.5)
    learner, network = LearnerSettings(gamma=0.5), NetworkSettings(hidden=())
    agent = StreamAgent(
        RunConfig(method="stream-q", method_settings=own, learner=learner, network=network, total_steps=1000), ONE
    )
    agent.networks[0].load(np.array([0, 1, 1, -1, 0.5, 0], np.float32))  # mean, sd, w0, w1, b0, b1
    agent.begin(np.array([1.0], np.float32))
    return agent


def transition(
    obs: float, action: int, reward: float, after: float, *, terminated: bool = False, restart: Array | None = None
) -> Transition:
    ones = np.ones(1, np.int64)
    return Transition(
        frames=np.array([[obs], [after]], np.float32),
        obs_index=np.zeros((1, 1), np.int32),
        next_index=np.ones((1, 1), np.int32),
        actions=np.array([action], np.int32),
        rewards=np.array([reward], np.float32),
        terminated=np.array([terminated]),
        weights=np.ones(1, np.float32),
        ids=ones, param_version=ones, age=ones, reuse=ones.astype(np.int32),
        span=ones.astype(np.uint8), restart=restart,
    )  # fmt: skip


def parameters(agent: StreamAgent) -> Array:
    return agent.networks[0].snapshot()[2:]


def traces(agent: StreamAgent) -> Any:
    return agent.state()["traces"].numpy()[2:]


def test_three_steps_by_hand() -> None:
    """A greedy step, a step that is not greedy, and a greedy one that ends the episode.

    Where |delta| > 1, the change is z times the sign of delta / (kappa ||z||_1).
    """
    agent = linear_agent()

    # x = 0: Q = (0.5, 0). Then mean 2.5, sd sqrt(4.5): x' = 1 / sqrt(2), Q' = (x' + 0.5, -x'). The reward 2 is not
    # scaled yet: delta = 2 + 0.5 (x' + 0.5) - 0.5. z = (0, 0, 1, 0): b0 grows by 1 / 2.
    root = math.sqrt(0.5)
    errors = [agent.update(transition(1, 0, 2, 4)).td_errors[0]]
    assert errors[-1] == pytest.approx(2 + 0.5 * (root + 0.5) - 0.5)
    np.testing.assert_allclose(parameters(agent), [1, -1, 1, 0], rtol=1e-6, atol=1e-7)
    np.testing.assert_allclose(traces(agent), [0, 0, 1, 0], atol=1e-7)

    # x = 1 / sqrt(2): Q = (x + 1, -x), and action 1 is taken. Then mean 2, sd sqrt(3): x' = -1 / sqrt(3), Q' = (x' + 1,
    # -x'). u = 2, then 0.5 * 2 + 3 = 4: the reward is 3 / sqrt(2). z = (0, x, 0.25, 1), and 0 behind the step.
    third = 1 / math.sqrt(3)
    errors.append(agent.update(transition(4, 1, 3, 1)).td_errors[0])
    assert errors[-1] == pytest.approx(3 / math.sqrt(2) + 0.5 * third + root)
    norm = root + 0.25 + 1
    weight, first, second = -1 + root / (2 * norm), 1 + 0.25 / (2 * norm), 1 / (2 * norm)
    np.testing.assert_allclose(parameters(agent), [1, weight, first, second], rtol=1e-6)
    np.testing.assert_array_equal(traces(agent), 0)

    # x = -1 / sqrt(3): Q = (x + first, weight x + second), of which the second is larger and taken. No reward, and a
    # terminal state: delta = -Q. z = (0, x, 0, 1): M = 2 (1 / sqrt(3) + 1).
    value = -weight * third + second
    assert value > first - third
    errors.append(agent.update(transition(1, 1, 0, 2, terminated=True)).td_errors[0])
    assert errors[-1] == pytest.approx(-value)
    step = -value / (2 * (third + 1))
    np.testing.assert_allclose(parameters(agent), [1, weight - third * step, first, second + step], rtol=1e-6)
    np.testing.assert_array_equal(traces(agent), 0)
    assert (agent.updates, agent.versions) == (3, [3, 3])


def test_traces_go_on_over_greedy_steps() -> None:
    agent = linear_agent()
    agent.update(transition(1, 0, 2, 4))
    agent.update(transition(4, 0, 3, 1))
    np.testing.assert_allclose(traces(agent), [math.sqrt(0.5), 0, 1.25, 0], rtol=1e-6)


def test_a_time_limit_bootstraps_and_begins_an_episode() -> None:
    """As the first of the three steps, but the next episode begins with 2: the third observation of the moments."""
    agent = linear_agent()
    error = agent.update(transition(1, 0, 2, 4, restart=np.array([2.0], np.float32))).td_errors[0]
    assert error == pytest.approx(2 + 0.5 * (math.sqrt(0.5) + 0.5) - 0.5)
    np.testing.assert_array_equal(traces(agent), 0)
    np.testing.assert_allclose(agent.networks[0].snapshot()[:2], [7 / 3, math.sqrt(7 / 3)], rtol=1e-6)


def test_masks_by_hand() -> None:
    """As the first of the three steps, but only action 1 is allowed: greedy, and the next state's value is -x'."""
    agent, only = linear_agent(), np.array([[False, True]])
    step = msgspec.structs.replace(transition(1, 1, 2, 4), mask=only, next_mask=only)
    assert agent.update(step).td_errors[0] == pytest.approx(2 - 0.5 * math.sqrt(0.5))
    np.testing.assert_allclose(traces(agent), [0, 0, 0, 1], atol=1e-7)


def test_the_reward_that_ends_an_episode_begins_no_sum() -> None:
    """u is 2, then 3 in place of 0.5 * 2 + 3, of variance 1/2; nothing is added to the terminal reward."""
    agent = linear_agent()
    agent.update(transition(1, 0, 2, 4))
    before = agent.q_values(np.array([[4.0]], np.float32))[0][0, 0]
    error = agent.update(transition(4, 0, 3, 1, terminated=True)).td_errors[0]
    assert error == pytest.approx(3 / math.sqrt(0.5) - before, rel=1e-5)


def test_stacked_pictures_are_shown_oldest_first() -> None:
    config = RunConfig(
        method="stream-q", method_settings=StreamQSettings(), network=NetworkSettings(hidden=(8,)), total_steps=1000
    )
    agent, rng = StreamAgent(config, STACKED), np.random.default_rng(0)
    frames = rng.integers(0, 256, (3, *STACKED.frame_shape), np.uint8)
    for first in (frames[1:], frames[:2]):  # one alone would be standardized to 0
        agent.begin(first.reshape(STACKED.obs_shape))
    values, again = agent.q_values(frames[:2].reshape(1, *STACKED.obs_shape))
    assert values is again
    np.testing.assert_allclose(
        values, agent.networks[0].module(torch.from_numpy(frames[None, :2] / np.float32(255))).detach(), rtol=1e-4
    )
    one = transition(0, 2, 1, 0, terminated=True)
    index = {"obs_index": np.array([[0, 1]], np.int32), "next_index": np.array([[1, 2]], np.int32)}
    found = agent.update(msgspec.structs.replace(one, frames=frames, **index))
    assert found.td_errors == pytest.approx([1 - values[0, 2]], rel=1e-4)
    assert (found.td_errors.dtype, found.s, found.swapped) == (np.float32, 0.0, False)


def test_what_metrics_read_of_the_agent() -> None:
    agent = linear_agent()
    assert (agent.feedback_scale(), agent.state()["acting"], agent.device) == (0.0, 0, torch.device("cpu"))
    assert agent.loss.cost(np.array([2.0], np.float32)) == pytest.approx([2.0])
    values = np.array([[1.0, 3.0]], np.float32)
    assert agent.rule.bootstrap(values, values) == pytest.approx([3.0])
    assert agent.rule.config is agent.config
    assert agent.rule.rng.random() >= 0


def test_epsilon_falls_over_a_fifth_of_the_run() -> None:
    agent = linear_agent()
    assert [agent.epsilon(step) for step in (0, 100, 200, 900)] == pytest.approx([1.0, 0.505, 0.01, 0.01])


def test_a_restored_agent_goes_on_to_the_bit() -> None:
    first, second = linear_agent(), linear_agent()
    rng = np.random.default_rng(0)
    steps = [transition(*rng.standard_normal(1), int(rng.integers(2)), *rng.standard_normal(2)) for _ in range(20)]
    for step in steps[:10]:
        first.update(step)
    second.load_state(first.state())
    for step in steps[10:]:
        for agent in (first, second):
            agent.update(step)
    for name in ("networks", "traces"):
        for one, other in zip(first.state()[name], second.state()[name], strict=True):
            assert torch.equal(one, other)
    assert first.updates == second.updates == 20


def test_a_diverged_agent_is_found() -> None:
    agent = linear_agent()
    assert agent.finite()
    agent.networks[0].flat[3] = math.inf
    assert not agent.finite()
    assert not np.isfinite(agent.update(transition(4, 1, 1, 1)).td_errors).all()
