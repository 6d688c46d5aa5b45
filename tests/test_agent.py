"""The four methods: who is trained, who gives the targets, and what happens every C updates."""

from dataclasses import replace

import msgspec
import numpy as np
import pytest
import torch
from samples import make_segment

from coop.common.errors import UsageError
from coop.common.settings.config import EdlSettings, LearnerSettings, NetworkSettings, RunConfig
from coop.common.transitions import Batch
from coop.common.types import EnvSpec
from coop.learner.agent import Agent, _decay_vector
from coop.learner.qnetwork import make_network
from coop.replay.table.table import Table

SPEC = EnvSpec("CartPole-v0", (4,), "float32", 1, 2)


def _config(method: str, **learner: object) -> RunConfig:
    settings = LearnerSettings(**{"swap_every": 10, "learning_rate": 1e-3, **learner})  # type: ignore[arg-type]
    return RunConfig(method=method, learner=settings, network=NetworkSettings(hidden=(8, 8)))


def batches(count: int) -> list[Batch]:
    rng = np.random.default_rng(0)
    table = Table(SPEC, 500, rng=rng)
    for sequence in range(10):
        frames = rng.standard_normal((9, 4)).astype(np.float32)
        terminated = rng.random(8) < 0.2
        actions = rng.integers(2, size=8).astype(np.int32)
        changes = {"terminated": terminated, "actions": actions, "span": rng.integers(1, 4, 8, np.uint8), "carried": 0}
        table.insert(make_segment(SPEC, sequence, 8, frames=frames, **changes))
    return [table.sample(32) for _ in range(count)]


@pytest.mark.parametrize("method", ["g-coop", "coop"])
def test_roles_swap_every_c_updates(method: str) -> None:
    agent = Agent(_config(method), SPEC)
    assert len(agent.optimizers) == 2
    assert agent.versions == [0, 0]
    assert (agent.feedback_scale() == 0) == (method == "g-coop")
    assert not torch.equal(agent.networks[0].flat, agent.networks[1].flat)
    for number, batch in enumerate(batches(35)):
        before = [network.snapshot() for network in agent.networks]
        acting = number // 10 % 2
        assert agent.acting == acting
        result = agent.update(batch)
        changed = [not np.array_equal(b, n.snapshot()) for b, n in zip(before, agent.networks, strict=True)]
        assert changed == [acting == 0, acting == 1]
        assert result.swapped == (number % 10 == 9)
    assert agent.versions == [30, 35]


@pytest.mark.parametrize("method", ["dqn", "edql"])
def test_the_target_is_a_copy_every_c_updates(method: str) -> None:
    agent = Agent(_config(method), SPEC)
    copy = agent.networks[0].snapshot()
    for number, batch in enumerate(batches(25), start=1):
        np.testing.assert_array_equal(agent.networks[1].snapshot(), copy)
        agent.update(batch)
        assert agent.acting == 0
        if number % 10 == 0:
            copy = agent.networks[0].snapshot()
    np.testing.assert_array_equal(agent.networks[1].snapshot(), copy)
    assert agent.versions == [25, 20]
    assert len(agent.optimizers) == 1


def test_coop_without_s_is_g_coop() -> None:
    config = _config("coop")
    coop = Agent(replace(config, edl=EdlSettings(rate=0.0)), SPEC)
    g_coop = Agent(replace(config, method="g-coop"), SPEC)
    for batch in batches(200):
        coop.update(batch)
        g_coop.update(batch)
    for one, other in zip(coop.networks, g_coop.networks, strict=True):
        torch.testing.assert_close(one.flat, other.flat, rtol=1e-5, atol=1e-6)
    edl = Agent(config, SPEC)
    edl.update(batches(1)[0])
    assert edl.feedback_scale() > 0


@pytest.mark.parametrize(("double", "bound"), [(False, None), (True, None), (True, 0.01)])
@pytest.mark.parametrize("loss", ["squared", "mse", "huber"])
def test_an_update_by_autograd(double: bool, bound: float | None, loss: str) -> None:
    """One step of SGD on 1/2 e^2 (or Huber's) with the targets written out."""
    agent = Agent(
        _config("g-coop", optimizer="sgd", double=double, loss=loss, gamma=0.9, reward_bound=bound and bound / 10), SPEC
    )
    batch = batches(1)[0]
    batch = msgspec.structs.replace(
        batch, rewards=batch.rewards * 3, weights=np.linspace(0.5, 1.5, 32, dtype=np.float32)
    )
    online, target = agent.networks
    obs, next_obs = (torch.tensor(batch.frames[i[:, 0]]) for i in (batch.obs_index, batch.next_index))
    actions = torch.tensor(batch.actions).long()[:, None]
    with torch.no_grad():
        best = (online if double else target)(next_obs).argmax(1, keepdim=True)
        value = target(next_obs).gather(1, best)[:, 0]
        value = value if bound is None else value.clip(-bound, bound)
        discounts = 0.9 ** torch.tensor(batch.span) * ~torch.tensor(batch.terminated)
        targets = torch.tensor(batch.rewards) + discounts * value
    errors = online.module(obs).gather(1, actions)[:, 0] - targets
    costs = {
        "squared": 0.5 * errors**2,
        "mse": torch.nn.functional.mse_loss(errors, 0 * errors, reduction="none"),
        "huber": torch.nn.functional.huber_loss(errors, 0 * errors, reduction="none"),
    }[loss]
    parameters = list(online.module.parameters())
    gradients = torch.autograd.grad((costs * torch.tensor(batch.weights)).mean(), parameters)
    expected = online.snapshot() - 1e-3 * torch.cat([g.flatten() for g in gradients]).numpy()
    result = agent.update(batch)
    np.testing.assert_allclose(agent.networks[0].snapshot(), expected, rtol=1e-5, atol=1e-7)
    np.testing.assert_allclose(result.td_errors, errors.detach().numpy(), rtol=1e-5, atol=1e-6)


def test_weight_decay_by_layer() -> None:
    plain = Agent(_config("dqn", optimizer="sgd"), SPEC)
    decayed = Agent(_config("dqn", optimizer="sgd", weight_decay=(0.0, 0.5, 0.0)), SPEC)
    before = {name: p.detach().clone() for name, p in plain.networks[0].module.named_parameters()}
    batch = batches(1)[0]
    plain.update(batch)
    decayed.update(batch)
    other = dict(decayed.networks[0].module.named_parameters())
    for name, p in plain.networks[0].module.named_parameters():
        expected = p - (1e-3 * 0.5 * before[name] if name.startswith("fc2") else 0)
        torch.testing.assert_close(other[name], expected)
    uniform = Agent(_config("dqn", optimizer="sgd", weight_decay=(0.5,)), SPEC)
    uniform.update(batch)
    for name, p in uniform.networks[0].module.named_parameters():
        torch.testing.assert_close(p, dict(plain.networks[0].module.named_parameters())[name] - 5e-4 * before[name])
    with pytest.raises(UsageError, match="3 layers"):
        Agent(_config("dqn", weight_decay=(0.1, 0.1)), SPEC)


def test_weight_decay_of_nested_layers() -> None:
    """Each Linear of a nested stack is a layer of its own."""
    layout = [("trunk.weight", (2, 3)), ("trunk.bias", (2,)), ("head.0.weight", (1, 2)), ("head.2.weight", (2, 1))]
    rates = _decay_vector((0.1, 0.2, 0.3), layout)
    assert rates is not None
    torch.testing.assert_close(rates, torch.tensor([0.1] * 8 + [0.2] * 2 + [0.3] * 2))


@pytest.mark.parametrize("gradient_alpha", [0.0, 0.9])
def test_mnihs_rmsprop_stays_finite_where_the_two_constants_differ(gradient_alpha: float) -> None:
    settings = {"optimizer": "rmsprop-mnih", "gradient_alpha": gradient_alpha, "eps": 0.01, "learning_rate": 3e-5}
    agent = Agent(_config("dqn", **settings), SPEC)
    for batch in batches(20):
        assert np.isfinite(agent.update(batch).td_errors).all()


def test_s_is_drawn_from_a_normal_distribution_of_the_falling_rate() -> None:
    agent = Agent(replace(_config("coop"), edl=EdlSettings(rate=0.2, decay=0.5, decay_every=100, noise="normal")), SPEC)
    drawn = np.array([agent.update(batch).s / (0.2 * 0.5 ** (k / 100)) for k, batch in enumerate(batches(300))])
    assert abs(drawn.mean()) < 0.2  # three standard deviations of the mean of 300
    assert 0.85 < drawn.std() < 1.15
    assert 100 < (drawn < 0).sum() < 200
    constant = Agent(replace(_config("coop"), edl=EdlSettings(rate=0.2)), SPEC)
    assert constant.update(batches(1)[0]).s == 0.2


def test_the_learning_rate_falls_over_the_run() -> None:
    config = _config("g-coop", optimizer="sgd", learning_rate=1e-3, learning_rate_final=0.01, swap_every=1000)
    config = replace(config, total_steps=140, replay=replace(config.replay, learning_starts=100, capacity=100))
    agent, batch = Agent(config, SPEC), batches(1)[0]
    assert config.planned_updates == 40
    for update in range(41):
        before = agent.networks[0].snapshot()
        agent.update(batch)
        moved = before - agent.networks[0].snapshot()
        expected = 1e-3 * 0.01 ** (update / 40) * agent.optimizers[0].gradient
        np.testing.assert_allclose(moved, expected, rtol=1e-3, atol=1e-7)


@pytest.mark.parametrize("edl", [EdlSettings(noise="normal"), EdlSettings(feedback="weight-gradient")])
def test_a_restored_agent_goes_on_to_the_bit(edl: EdlSettings) -> None:
    config = replace(_config("coop"), edl=edl)
    seen = batches(40)
    first, second = Agent(config, SPEC), Agent(replace(config, seed=0), SPEC)
    for batch in seen[:17]:
        first.update(batch)
    second.load_state(first.state())
    for batch in seen[17:]:
        first.update(batch)
        second.update(batch)
    for one, other in zip(first.networks, second.networks, strict=True):
        assert torch.equal(one.flat, other.flat)
    assert first.acting == second.acting


@pytest.mark.parametrize("part", ["networks", "optimizers"])
def test_a_state_of_fewer_networks_is_refused(part: str) -> None:
    agent = Agent(_config("coop"), SPEC)
    state = agent.state()
    with pytest.raises(ValueError, match="shorter"):
        agent.load_state({**state, part: state[part][:1]})


@pytest.mark.parametrize("device", ["nonsense", "cuda:99"])
def test_a_device_that_is_not_there(device: str) -> None:
    with pytest.raises(UsageError, match=r"learner\.device"):
        Agent(_config("dqn", device=device), SPEC)


def test_values_are_finite_where_only_their_sum_is_not() -> None:
    agent = Agent(_config("coop"), SPEC)
    agent.networks[1].flat.fill_(3e38)
    assert agent.finite()
    agent.networks[1].flat[-1] = torch.nan
    assert not agent.finite()


def test_the_second_network_is_the_runs_second() -> None:
    config = _config("coop")
    cpu = torch.device("cpu")
    agent, obs = Agent(config, SPEC), np.ones((3, 4), np.float32)
    for number, (network, values) in enumerate(zip(agent.networks, agent.q_values(obs), strict=True)):
        expected = make_network(config, SPEC, number, cpu)
        assert torch.equal(network.flat, expected.flat)
        np.testing.assert_allclose(values, expected(torch.from_numpy(obs)).detach(), rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("method", ["dqn", "g-coop", "edql", "coop"])
def test_bfloat16_trains_nearly_as_float32_does(method: str) -> None:
    config = _config(method)
    low = replace(config, network=replace(config.network, dtype="bfloat16"))
    exact, half = Agent(config, SPEC), Agent(low, SPEC)
    start = [network.snapshot() for network in exact.networks]
    for number, batch in enumerate(batches(25)):
        expected, found = exact.update(batch).td_errors, half.update(batch).td_errors
        assert number == 0 or not np.array_equal(found, expected), "another precision shows"
        np.testing.assert_allclose(found, expected, atol=0.1)
        assert found.dtype == np.float32
    for before, one, other in zip(start, exact.networks, half.networks, strict=True):
        went, goes = one.snapshot() - before, other.snapshot() - before
        assert goes.dtype == np.float32
        assert went @ goes > 0.95 * np.linalg.norm(went) * np.linalg.norm(goes)
    resumed = Agent(low, SPEC)
    resumed.load_state(half.state())
    for batch in batches(3):
        np.testing.assert_array_equal(resumed.update(batch).td_errors, half.update(batch).td_errors)


@pytest.mark.parametrize("method", ["dqn", "coop"])
def test_a_run_that_diverges_goes_on_quietly(method: str) -> None:
    agent = Agent(_config(method), SPEC)
    for network in agent.networks:
        network.load(1e20 * network.snapshot())
    for batch in batches(3):  # pytest makes an error of every warning
        result = agent.update(batch)
    assert not np.isfinite(result.td_errors).all()


def test_updates_of_a_cpu_are_neither_recorded_nor_read_late() -> None:
    agent = Agent(_config("coop"), SPEC)
    assert (agent.lag, agent.eager, agent._recorded) == (0, "", None)
