"""MeDQN's extra cost against numbers derived by hand, and what of it survives a checkpoint."""

from dataclasses import replace
from typing import Any

import msgspec
import numpy as np
import pytest
import torch
from test_agent import SPEC, batches

from coop.common.settings.config import LearnerSettings, NetworkSettings, ReplaySettings, RunConfig
from coop.common.settings.medqn import MedqnSettings
from coop.common.settings.tables import preset_names
from coop.common.transitions import Batch
from coop.common.types import EnvSpec
from coop.learner.agent import Agent
from coop.learner.methods.medqn import Consolidation
from coop.records.run_options import base_config

ONE = EnvSpec("one", (1,), "float32", 1, 2)


def config(own: MedqnSettings, **learner: Any) -> RunConfig:
    settings = LearnerSettings(**{"optimizer": "sgd", "learning_rate": 0.1, "gamma": 0.5, **learner})
    replay = ReplaySettings(learning_starts=1)
    network = NetworkSettings(hidden=())
    return RunConfig(
        method="medqn", method_settings=own, learner=settings, replay=replay, network=network, total_steps=101
    )


def batch_of_two() -> Batch:
    """x = 1, action 0, reward 1, next x = 2; x = 3, action 1, reward 0, a terminal next x = -1."""
    ones = np.ones(2, np.int64)
    return Batch(
        frames=np.array([[1], [2], [3], [-1]], np.float32),
        obs_index=np.array([[0], [2]], np.int32),
        next_index=np.array([[1], [3]], np.int32),
        actions=np.array([0, 1], np.int32),
        rewards=np.array([1, 0], np.float32),
        terminated=np.array([False, True]),
        weights=np.ones(2, np.float32),
        ids=ones, param_version=ones, age=ones, reuse=ones.astype(np.int32),
        span=ones.astype(np.uint8),
    )  # fmt: skip


def linear_agent(own: MedqnSettings, **learner: Any) -> Agent:
    """Q(x, 0) = x, Q(x, 1) = 0.5; in the target network Q(x, 0) = 0, Q(x, 1) = 1. Parameters: w0, w1, b0, b1."""
    agent = Agent(config(own, **learner), ONE)
    agent.networks[0].load(np.array([1, 0, 0, 0.5], np.float32))
    agent.networks[1].load(np.array([0, 0, 0, 1], np.float32))
    return agent


@pytest.mark.parametrize(("loss", "slope"), [("squared", 1.0), ("mse", 2.0)])
def test_an_update_with_real_states_by_hand(loss: str, slope: float) -> None:
    """TD errors: 1 - (1 + 0.5 * 1) = -0.5 and 0.5 - 0 = 0.5. Gaps to the target: (1, -0.5) and (3, -0.5).

    The mean of e^2 / 2 has the gradient 1/2 (-0.5 * 1) in w0, 1/2 (-0.5) in b0, 1/2 (0.5 * 3) in w1, 1/2 (0.5) in b1.
    lambda = 0.25: 2 * 0.25 / 2 = 1/4 times (1 * 1 + 3 * 3) in w0, (1 + 3) in b0, (-0.5 * 1 - 0.5 * 3) in w1, -1 in b1.
    """
    agent = linear_agent(MedqnSettings("real", lambda_start=0.25, lambda_end=1.0), loss=loss)
    result = agent.update(batch_of_two())
    np.testing.assert_allclose(result.td_errors, [-0.5, 0.5])
    td, near = np.array([-0.25, 0.75, -0.25, 0.25]), np.array([2.5, -0.5, 1.0, -0.25])
    np.testing.assert_allclose(
        agent.networks[0].snapshot(), np.array([1, 0, 0, 0.5]) - 0.1 * (slope * td + near), rtol=1e-6
    )
    np.testing.assert_array_equal(agent.networks[1].snapshot(), [0, 0, 0, 1])


def test_two_passes_are_two_steps_and_one_update() -> None:
    twice = linear_agent(MedqnSettings("real", 0.25, 0.25, epochs=2))
    once = linear_agent(MedqnSettings("real", 0.25, 0.25, epochs=1))
    first = twice.update(batch_of_two())
    steps = [once.update(batch_of_two()) for _ in range(2)]
    np.testing.assert_array_equal(twice.networks[0].snapshot(), once.networks[0].snapshot())
    np.testing.assert_array_equal(first.td_errors, steps[0].td_errors)
    assert (twice.updates, once.updates) == (1, 2)


def test_lambda_is_linear_over_the_run() -> None:
    rule = Consolidation(config(MedqnSettings(lambda_start=0.5, lambda_end=2.5)), np.random.default_rng(0))
    assert rule.config.planned_updates == 100
    assert [rule.strength(update) for update in (0, 25, 50, 100, 900)] == [0.5, 1.0, 1.5, 2.5, 2.5]


def test_uniform_states_lie_between_the_bounds_of_all_that_was_seen() -> None:
    """Of x = 1, 3 and next x = 2, -1, then of 10 too; the gradient is the cost's at the states that were drawn."""
    agent = linear_agent(MedqnSettings(lambda_start=0.25, lambda_end=0.25), gamma=0.0)
    batch = batch_of_two()
    draws = np.random.default_rng([agent.config.seed, 2])
    states = -1 + 4 * draws.random((2, 1), np.float32)[:, 0]
    agent.update(batch)
    gaps = np.array([states, np.full(2, -0.5)])
    near = 0.25 * np.array([*(gaps * states).sum(1), *gaps.sum(1)])
    td = np.array([0, 0.75, 0, 0.25])  # TD errors: 1 - 1 and 0.5 - 0
    np.testing.assert_allclose(agent.networks[0].snapshot(), np.array([1, 0, 0, 0.5]) - 0.1 * (td + near), rtol=1e-5)
    agent.update(msgspec.structs.replace(batch, frames=np.array([[1], [2], [10], [0]], np.float32)))
    agent.update(batch)
    assert isinstance(agent.rule, Consolidation)
    assert (agent.rule.low.tolist(), agent.rule.high.tolist()) == ([-1.0], [10.0])


@pytest.mark.parametrize("states", ["real", "uniform"])
def test_autograd_agrees(states: str, monkeypatch: pytest.MonkeyPatch) -> None:
    own = MedqnSettings(states, 0.3, 0.3)  # type: ignore[arg-type]
    agent = Agent(replace(config(own), network=NetworkSettings(hidden=(8, 8))), SPEC)
    plain = Agent(replace(agent.config, method="dqn", method_settings=None), SPEC)
    (first, batch) = batches(2)
    for one in (agent, plain):
        one.networks[0].load(plain.networks[0].snapshot() * 1.1)
    batch = msgspec.structs.replace(batch, frames=batch.frames * 0 + 0.25) if states == "uniform" else batch
    online, target = agent.networks
    obs = torch.tensor(batch.frames[batch.obs_index[:, 0]])
    cost = 0.3 * ((online.module(obs) - target.module(obs).detach()) ** 2).sum(1).mean()
    gradients = torch.autograd.grad(cost, list(online.module.parameters()))
    agent.update(batch)
    plain.update(batch)
    expected = plain.networks[0].snapshot() - 0.1 * torch.cat([g.flatten() for g in gradients]).numpy()
    np.testing.assert_allclose(agent.networks[0].snapshot(), expected, rtol=1e-4, atol=1e-6)
    del first


@pytest.mark.parametrize("dtype", ["float32", "bfloat16"])
def test_a_restored_agent_goes_on_to_the_bit(dtype: Any) -> None:
    settings = replace(config(MedqnSettings(epochs=2)), network=NetworkSettings(hidden=(8, 8), dtype=dtype))
    seen = batches(12)
    first, second = Agent(settings, SPEC), Agent(settings, SPEC)
    wide = msgspec.structs.replace(seen[0], frames=seen[0].frames * 3)  # its bounds are wider than those of all others
    for batch in [wide, *seen[1:6]]:
        first.update(batch)
    second.load_state(first.state())
    for batch in seen[6:]:
        first.update(batch)
        second.update(batch)
    assert torch.equal(first.networks[0].flat, second.networks[0].flat)


def test_pictures_are_drawn_too() -> None:
    spec = EnvSpec("p", (10, 10), "uint8", 2, 3)
    agent = Agent(replace(config(MedqnSettings()), network=NetworkSettings(hidden=(4,))), spec)
    frames = np.random.default_rng(0).integers(0, 200, (4, 10, 10), np.uint8)
    index = np.array([[0, 1], [1, 2]], np.int32)
    agent.update(msgspec.structs.replace(batch_of_two(), frames=frames, obs_index=index, next_index=index + 1))
    assert isinstance(agent.rule, Consolidation)
    np.testing.assert_allclose(agent.rule.high, frames[[[0, 1], [1, 2], [2, 3]]].max(0) / 255, rtol=1e-6)


def test_without_an_input_there_are_no_bounds() -> None:
    state = Agent(config(MedqnSettings("uniform")), ONE).rule.state()
    assert {name: (bound.shape, bound.dtype) for name, bound in state.items()} == {
        "low": ((0,), torch.float32), "high": ((0,), torch.float32)
    }  # fmt: skip


@pytest.mark.parametrize("preset", preset_names())
def test_presets_of_pictures_consolidate_on_real_states(preset: str) -> None:
    own = base_config(["--preset", preset, "--method", "medqn"]).method_settings
    assert isinstance(own, MedqnSettings)
    assert own.states == ("uniform" if preset.startswith("cartpole") else "real")
