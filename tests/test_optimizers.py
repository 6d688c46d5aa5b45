"""Optimizers against PyTorch's and against their formulas, over tensors and over numpy's arrays."""

import tracemalloc
from collections.abc import Callable

import numpy as np
import pytest
import torch

from coop.common.settings.config import LearnerSettings, OptimizerName
from coop.learner.edl.arrays import AnyArray
from coop.learner.optimizers import MnihRMSProp, make_optimizer

SIZE = 50
OPTIMIZERS: list[OptimizerName] = ["sgd", "rmsprop", "rmsprop-mnih", "adam"]
LIBRARIES = pytest.mark.parametrize("library", ["torch", "numpy"])


def arrays(library: str, theta: torch.Tensor) -> tuple[AnyArray, AnyArray]:
    """Parameters theta and a gradient of 0, in memory of their own."""
    if library == "numpy":
        return theta.numpy().copy(), np.zeros(len(theta), np.float32)
    return theta.clone(), torch.zeros(len(theta))


def wave(number: int) -> torch.Tensor:
    """The gradient of a step."""
    return torch.linspace(-1, 1, SIZE).roll(number).sin()


@LIBRARIES
@pytest.mark.parametrize("gradient_alpha", [0.0, 0.9, 0.95])  # with the first, the variance would be negative
def test_rmsprop_of_mnih(gradient_alpha: float, library: str) -> None:
    rng = np.random.default_rng(1)
    theta, gradient = arrays(library, torch.tensor([1.0, -2.0, 3.0]))
    optimizer = MnihRMSProp(theta, gradient, alpha=0.95, eps=0.01, gradient_alpha=gradient_alpha)
    expected, mean, square = np.array([1.0, -2.0, 3.0]), np.zeros(3), np.zeros(3)
    for _ in range(5):
        g = rng.standard_normal(3)
        gradient[:] = torch.tensor(g)
        optimizer.step(0.1)
        mean = gradient_alpha * mean + (1 - gradient_alpha) * g
        square = 0.95 * square + 0.05 * g * g
        expected = expected - 0.1 * g / np.sqrt(np.maximum(square - mean * mean, 0) + 0.01)
    np.testing.assert_allclose(theta, expected, rtol=1e-5)


def test_rmsprop_of_mnih_moves_as_with_gradients_summed_over_the_batch() -> None:
    settings = LearnerSettings(optimizer="rmsprop-mnih", batch_size=32, gradient_alpha=0.9, alpha=0.95, eps=0.01)
    moved, summed = torch.zeros(SIZE), torch.zeros(SIZE)
    gradient = torch.zeros(SIZE)
    of_means, of_sums = make_optimizer(settings, moved, gradient), MnihRMSProp(summed, 32 * gradient, 0.95, 0.01, 0.9)
    for k in range(20):
        gradient.copy_(1e-3 * torch.linspace(-1, 1, SIZE).roll(k))
        of_sums.gradient.copy_(32 * gradient)
        of_means.step(0.1)
        of_sums.step(0.1)
    torch.testing.assert_close(moved, summed)


@LIBRARIES
@pytest.mark.parametrize("momentum", [0.0, 0.8])
@pytest.mark.parametrize(
    ("name", "reference"),
    [
        ("sgd", lambda p, momentum: torch.optim.SGD(p, 0.1, momentum=momentum)),
        ("rmsprop", lambda p, momentum: torch.optim.RMSprop(p, 0.1, alpha=0.9, eps=1e-3, momentum=momentum)),
        ("adam", lambda p, _: torch.optim.Adam(p, 0.1, betas=(0.8, 0.95), eps=1e-3)),
    ],
)
def test_optimizers_are_pytorchs(
    name: OptimizerName,
    momentum: float,
    reference: Callable[[list[torch.nn.Parameter], float], torch.optim.Optimizer],
    library: str,
) -> None:
    settings = LearnerSettings(optimizer=name, momentum=momentum, alpha=0.9, beta1=0.8, beta2=0.95, eps=1e-3)
    parameter = torch.nn.Parameter(torch.linspace(-1, 1, SIZE))
    theta, gradient = arrays(library, parameter.detach())
    other = reference([parameter], momentum)
    optimizer = make_optimizer(settings, theta, gradient)
    for k in range(20):
        parameter.grad = parameter.detach().roll(k).sin()
        gradient[:] = parameter.grad
        rate = 0.1 / (k + 1)
        other.param_groups[0]["lr"] = rate
        other.step()
        optimizer.step(rate)
        torch.testing.assert_close(torch.as_tensor(theta), parameter.detach(), rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("restored", ["torch", "numpy"])
@LIBRARIES
@pytest.mark.parametrize("name", OPTIMIZERS)
def test_a_restored_optimizer_goes_on_whatever_holds_its_arrays(
    name: OptimizerName, library: str, restored: str
) -> None:
    settings = LearnerSettings(optimizer=name, momentum=0.8, gradient_alpha=0.9, eps=1e-3)
    first, gradient = arrays(library, torch.linspace(-1, 1, SIZE))
    optimizer = make_optimizer(settings, first, gradient)
    for k in range(6):
        gradient[:] = wave(k)
        optimizer.step(0.1)
        if k == 2:
            saved, at = optimizer.state(), torch.as_tensor(first).clone()
    second, gradient = arrays(restored, at)
    optimizer = make_optimizer(settings, second, gradient)
    optimizer.load_state(saved)
    assert optimizer.steps == 3
    for k in range(3, 6):
        gradient[:] = wave(k)
        optimizer.step(0.1)
    torch.testing.assert_close(torch.as_tensor(second), torch.as_tensor(first))


@pytest.mark.parametrize(
    ("name", "momentum", "buffers"),
    [
        ("sgd", 0.0, set()),
        ("sgd", 0.8, {"velocity"}),
        ("rmsprop", 0.0, {"square"}),
        ("rmsprop", 0.8, {"square", "velocity"}),
        ("rmsprop-mnih", 0.8, {"square", "mean"}),
        ("adam", 0.8, {"square", "mean"}),
    ],
)
def test_only_running_means_that_are_used_are_kept(name: OptimizerName, momentum: float, buffers: set[str]) -> None:
    theta, gradient = arrays("torch", torch.ones(SIZE))
    optimizer = make_optimizer(LearnerSettings(optimizer=name, momentum=momentum), theta, gradient)
    assert set(optimizer.state()) == {"steps", *buffers}


@LIBRARIES
def test_running_means_never_become_denormal_and_other_arithmetic_may(library: str) -> None:
    theta, gradient = arrays(library, torch.ones(SIZE))
    optimizer = make_optimizer(LearnerSettings(optimizer="adam", beta1=0.9), theta, gradient)
    optimizer.buffers["mean"][:] = 1.2e-38  # 0.9 of it is below the smallest normal number, 1.18e-38
    optimizer.step(0.1)
    assert not optimizer.buffers["mean"].any()
    assert ((0 * theta + 1.2e-38) * 0.9).all()


@pytest.mark.parametrize("momentum", [0.0, 0.8])
@pytest.mark.parametrize("name", OPTIMIZERS)
def test_a_step_allocates_no_array(name: OptimizerName, momentum: float) -> None:
    settings = LearnerSettings(optimizer=name, momentum=momentum)
    theta, gradient = arrays("numpy", torch.ones(100_000))
    gradient[:] = 0.1
    optimizer = make_optimizer(settings, theta, gradient)
    tracemalloc.start()
    optimizer.step(0.1)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < theta.nbytes
