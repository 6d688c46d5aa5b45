"""A Q-network's passes, in numpy and in PyTorch, in float32 and in bfloat16: the gradients of its module."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from coop.common.errors import UsageError
from coop.common.networks.network import build_network
from coop.common.settings.config import EdlSettings, NetworkSettings, RunConfig
from coop.common.transitions import Batch
from coop.common.types import EnvSpec
from coop.learner.edl.arrays import AnyArray
from coop.learner.edl.feedback import edl_gradients
from coop.learner.given import Given
from coop.learner.qnetwork import QNetwork, make_network, make_q_network

CPU = torch.device("cpu")
VECTOR = EnvSpec("made-up", (4,), "float32", 1, 3)
PICTURES = EnvSpec("pictures", (6, 7, 2), "uint8", 3, 4)


def _q_network(config: RunConfig, spec: EnvSpec = VECTOR, number: int = 0) -> QNetwork:
    return make_q_network(config, spec, number, CPU, np.random.default_rng(0))


def _config(kind: str, method: str = "coop", feedback: Any = "transform", **changes: Any) -> RunConfig:
    network = NetworkSettings(kind, hidden=(16,), dtype=changes.pop("dtype", "float32"))
    edl = EdlSettings(feedback=feedback)
    return RunConfig(method=method, seed=3, network=network, edl=edl, **changes)


def _inputs(spec: EnvSpec) -> torch.Tensor:
    return torch.from_numpy(np.random.default_rng(1).standard_normal((5, *spec.input_shape), np.float32))


def _error(spec: EnvSpec) -> np.ndarray[Any, np.dtype[np.float32]]:
    return np.random.default_rng(2).standard_normal((5, spec.num_actions), np.float32) / 5


def _gradient(network: QNetwork, spec: EnvSpec, s: float = 0.4) -> torch.Tensor:
    with torch.inference_mode():
        network.backward(network.forward(_inputs(spec)), _error(spec), s)
    return torch.as_tensor(network.gradient).clone()


def _expected(network: QNetwork, spec: EnvSpec, s: float = 0.4, feedback: str = "transform") -> torch.Tensor:
    found = edl_gradients(network.network.module, _inputs(spec), torch.from_numpy(_error(spec)), s, feedback, seed=3)
    return torch.cat([gradient.flatten() for gradient in found.values()])


@pytest.mark.parametrize("feedback", ["transform", "random"])
@pytest.mark.parametrize(
    ("kind", "spec", "in_numpy"),
    [
        ("mlp", VECTOR, True),
        ("minatar", PICTURES, True),
        ("mlp", PICTURES, False),
        ("custom_networks:duel", VECTOR, False),
    ],
)
def test_the_gradient_is_that_of_the_module(kind: str, spec: EnvSpec, in_numpy: bool, feedback: str) -> None:
    network = _q_network(_config(kind, feedback=feedback), spec)
    torch.testing.assert_close(_gradient(network, spec), _expected(network, spec, feedback=feedback))
    with torch.inference_mode():
        values = network.network.module(_inputs(spec)).numpy()
        np.testing.assert_allclose(network.values(_inputs(spec)), values, rtol=1e-5, atol=1e-6)
    assert network.in_numpy == isinstance(_network_inputs(network, _batch(spec)), np.ndarray) == in_numpy


def test_the_gradient_of_another_cost_is_added_without_s() -> None:
    network = _q_network(_config("mlp"))
    tape = network.forward(_inputs(VECTOR))
    network.backward(tape, _error(VECTOR), 0.4)
    network.add_gradient(tape, 2 * _error(VECTOR))
    expected = _expected(network, VECTOR) + 2 * _expected(network, VECTOR, 0.0)
    torch.testing.assert_close(torch.as_tensor(network.gradient), expected)


def _batch(spec: EnvSpec) -> Batch:
    """Two transitions of frames 0..5: obs 0 1 2 and 3 2 0, next_obs 1 2 4 and 5 5 1; of one frame each for a vector."""
    rng = np.random.default_rng(0)
    frames = rng.integers(256, size=(6, *spec.frame_shape)).astype(spec.frame_dtype)
    index, after = np.array([[0, 1, 2], [3, 2, 0]], np.int32), np.array([[1, 2, 4], [5, 5, 1]], np.int32)
    ones = np.ones(2, np.int64)
    return Batch(
        frames, index[:, : spec.stack], after[:, : spec.stack], ones.astype(np.int32), ones.astype(np.float32),
        np.zeros(2, np.bool_), ones, ones.astype(np.uint8), ones.astype(np.float32), ones, ones, ones.astype(np.int32),
    )  # fmt: skip


def _network_inputs(network: QNetwork, batch: Batch) -> AnyArray:
    given = Given.of(batch, 0.9, 0.0, 0.1, None if network.in_numpy else CPU)
    return network.inputs(given.frames, given.index)


@pytest.mark.parametrize("kind", ["minatar", "mlp"])
def test_inputs_are_channels_of_stacked_frames_obs_before_next_obs(kind: str) -> None:
    """minatar has its inputs in numpy, a picture's mlp in PyTorch."""
    batch = _batch(PICTURES)
    order = [[0, 1, 2], [3, 2, 0], [1, 2, 4], [5, 5, 1]]
    expected = [np.concatenate([batch.frames[i].transpose(2, 0, 1) for i in stack]) / 255 for stack in order]
    found = _network_inputs(_q_network(_config(kind), PICTURES), batch)
    np.testing.assert_allclose(found, np.stack(expected), rtol=1e-6)


@pytest.mark.parametrize(
    ("method", "feedback"), [("dqn", "none"), ("coop", "transform"), ("coop", "weight-gradient"), ("coop", "random")]
)
def test_every_pass_can_run_in_half_precision(method: str, feedback: str) -> None:
    """Values for targets are those of a copy in bfloat16, which follows the parameters; the gradient is float32."""
    network = _q_network(_config("mlp", method, feedback, dtype="bfloat16"))
    network.load(1.1 * network.network.snapshot())
    half = make_network(_config("mlp", method), VECTOR, 0, CPU, torch.bfloat16)
    half.load(network.network.flat)
    with torch.inference_mode():
        expected = half(_inputs(VECTOR).bfloat16()).float().numpy()
        np.testing.assert_array_equal(network.values(_inputs(VECTOR)), expected)
        assert torch.as_tensor(network.forward(_inputs(VECTOR)).output).dtype == torch.bfloat16
    wanted, found = _expected(network, VECTOR, feedback=feedback), _gradient(network, VECTOR)
    assert found.dtype == torch.float32
    rounding = float((found - wanted).norm() / wanted.norm())
    assert 1e-3 < rounding < 0.03


@pytest.mark.parametrize(("method", "seeds"), [("coop", (0, 1)), ("dqn", (0, 0))])
def test_initial_parameters_are_those_of_the_runs_seed(method: str, seeds: tuple[int, int]) -> None:
    for number, entry in enumerate(seeds):
        seed = int(np.random.SeedSequence([3, entry]).generate_state(1)[0])
        module = build_network("mlp", VECTOR, (16,), seed)
        expected = torch.cat([p.detach().flatten() for p in module.parameters()])
        assert torch.equal(make_network(_config("mlp", method), VECTOR, number, CPU).flat, expected)
        assert torch.equal(_q_network(_config("mlp", method), VECTOR, number).network.flat, expected)


STACKS = "with network.kind = 'custom_networks:duel'; only stacks of Linear, Conv2d, ReLU and Flatten have others"


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"network": NetworkSettings("custom_networks:duel", dtype="bfloat16")},
         f"network.dtype = 'bfloat16': allowed: 'float32' {STACKS}"),
        ({"network": NetworkSettings("custom_networks:twice")},
         "network.kind = 'custom_networks:twice': layer 'inner' (Linear) is used twice in a forward pass"),
    ],
)  # fmt: skip
def test_what_has_no_meaning_for_a_network_is_refused(changes: dict[str, Any], text: str) -> None:
    with pytest.raises(UsageError) as refused:
        _q_network(replace(_config("custom_networks:duel"), **changes))
    assert str(refused.value) == text


def test_gradient_methods_train_a_layer_that_is_used_twice() -> None:
    network = _q_network(_config("custom_networks:twice", "dqn"))
    torch.testing.assert_close(_gradient(network, VECTOR), _expected(network, VECTOR, feedback="none"))
