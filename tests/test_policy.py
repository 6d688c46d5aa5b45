"""The acting policy: greedy where it is not random, and in bfloat16 nearly as in float32."""

import numpy as np
import pytest
import torch

from coop.actors.policy import EpsilonGreedy
from coop.common.networks.network import FlatNetwork, build_network
from coop.common.types import EnvSpec

SPEC = EnvSpec("made-up", (84, 84), "uint8", 4, 6)


def policy(dtype: torch.dtype) -> EpsilonGreedy:
    """Networks of other seeds take over, as an actor's do, what a learner sends: float32 on the host."""
    first, second = (FlatNetwork(build_network("nips2013", SPEC, (), seed).to(dtype)) for seed in (8, 9))
    for seed, network in enumerate((first, second)):
        network.load(FlatNetwork(build_network("nips2013", SPEC, (), seed)).snapshot())
    return EpsilonGreedy((first, second), SPEC, np.random.default_rng(0))


def test_bfloat16_acts_nearly_as_float32() -> None:
    exact, half = policy(torch.float32), policy(torch.bfloat16)
    obs = np.random.default_rng(1).integers(0, 256, (64, *SPEC.obs_shape)).astype(np.uint8)
    for acting in (0, 1):
        exact.acting = half.acting = acting
        values = exact.networks[acting].module(torch.from_numpy(obs) / 255).detach().numpy()
        np.testing.assert_array_equal(exact.act(obs, 0.0), values.argmax(1))
        chosen = values[np.arange(64), half.act(obs, 0.0)]
        np.testing.assert_allclose(chosen, values.max(1), atol=0.01)
    np.testing.assert_allclose(half.mean_values(obs[0]), exact.mean_values(obs[0]), atol=0.01)
    assert half.mean_values(obs[0]) != exact.mean_values(obs[0])


@pytest.mark.parametrize("epsilon", [0.0, 0.5, 1.0])
def test_a_share_of_epsilon_is_random(epsilon: float) -> None:
    actor = policy(torch.float32)
    obs = np.random.default_rng(1).integers(0, 256, (200, *SPEC.obs_shape)).astype(np.uint8)
    other = np.mean(actor.act(obs, epsilon) != actor.act(obs, 0.0))
    assert abs(other - epsilon * 5 / 6) < 0.12
