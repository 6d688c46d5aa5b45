"""What an actor loads and computes is what the learner's network holds and gives, with and without PyTorch."""

import subprocess
import sys

import numpy as np
import pytest

from coop.common.networks.acting import Mlp, acting_network
from coop.common.networks.network import FlatNetwork, build_network, sample_inputs, sample_observations
from coop.common.settings.config import NetworkSettings
from coop.common.types import EnvSpec

CARTPOLE = EnvSpec("CartPole-v0", (4,), "float32", 1, 2)
STACKED = EnvSpec("made-up", (3,), "float32", 4, 5)
PICTURES = EnvSpec("made-up", (10, 10, 4), "bool", 1, 6)
BYTES = EnvSpec("made-up", (7, 5), "uint8", 2, 3)


@pytest.mark.parametrize("spec", [CARTPOLE, STACKED, PICTURES, BYTES], ids=lambda spec: str(spec.frame_shape))
@pytest.mark.parametrize("hidden", [(), (16,), (32, 8)], ids=str)
def test_an_mlp_in_numpy_is_pytorch_s(spec: EnvSpec, hidden: tuple[int, ...]) -> None:
    learned = FlatNetwork(build_network("mlp", spec, hidden, seed=3))
    acting = acting_network(NetworkSettings(hidden=hidden), spec)
    assert isinstance(acting, Mlp)
    assert (acting.layout_digest(), acting.size) == (learned.layout_digest(), learned.size)
    obs = sample_observations(spec, 9).numpy()
    assert not acting.q_values(obs, spec).any(), "parameters come from the learner"
    acting.load(learned.snapshot())
    values = acting.q_values(obs, spec)
    assert values.dtype == np.float32
    np.testing.assert_allclose(values, learned.module(sample_inputs(spec, 9)).detach().numpy(), rtol=1e-5, atol=1e-6)


def test_other_networks_are_pytorch_s() -> None:
    for settings in (NetworkSettings(kind="minatar"), NetworkSettings(dtype="bfloat16")):
        acting = acting_network(settings, PICTURES)
        assert isinstance(acting, FlatNetwork)
        assert str(acting.flat.dtype) == f"torch.{settings.dtype}"


def test_parameters_of_another_network_are_refused() -> None:
    acting = acting_network(NetworkSettings(hidden=(16,)), CARTPOLE)
    with pytest.raises(ValueError, match=r"^flat parameters: got shape \(3,\), the network has 114$"):
        acting.load(np.zeros(3, np.float32))


def test_an_actor_of_an_mlp_imports_no_pytorch() -> None:
    code = (
        "import sys, coop.actors.process; from coop.common.networks.acting import acting_network\n"
        "from coop.common.envs.make import make_vector_env; from coop.common.settings.config import RunConfig\n"
        "config = RunConfig(); env = make_vector_env(config.env, 1, 0)\n"
        "acting_network(config.network, env.spec).q_values(env.reset(), env.spec); print('torch' in sys.modules)"
    )
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert out.stdout == "False\n"
