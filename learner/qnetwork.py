"""A Q-network for training in PyTorch or numpy, in float32 or with a copy in bfloat16."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from coop.common.errors import UsageError
from coop.common.networks.forward import preprocess
from coop.common.networks.network import FlatNetwork, sample_inputs
from coop.common.registry import loaded
from coop.common.settings.config import RunConfig
from coop.common.settings.methods import METHODS
from coop.common.types import EnvSpec
from coop.learner.edl import kernels
from coop.learner.edl.arrays import AnyArray, assign, convert_like
from coop.learner.edl.autograd_backprop import AutogradBackprop
from coop.learner.edl.backprop import Tape, UnsupportedLayerError
from coop.learner.edl.feedback import FeedbackRule
from coop.learner.edl.trainable import Trainable


class QNetwork:
    """One network with the passes of an update.

    The parameters are float32. With network.dtype "bfloat16" all passes run on a copy in bfloat16; the algebra that
    error-driven feedback does on the T(i) stays in float32 or better.

    Args:
        network: the parameters, also published and saved. half: a copy in bfloat16, or None.
        spec: of the environment. rng: random numbers of the feedback.

    Raises:
        UsageError: a setting or the feedback has no meaning for the network; names the layer.

    Attributes:
        theta, gradient: float32 [P], of PyTorch or numpy, for the optimizer.
        double, value_bound: as the learner's settings have them.
        in_numpy: the passes take arrays of numpy. plain: the network is a plain stack, with hand-written passes.
    """

    def __init__(
        self,
        network: FlatNetwork,
        half: FlatNetwork | None,
        config: RunConfig,
        spec: EnvSpec,
        rng: np.random.Generator,
    ) -> None:
        self.network = network
        self._half = half
        self.double, self.value_bound = config.learner.double, config.learner.value_bound
        example = None if config.feedback == "none" else sample_inputs(spec, 8).to(network.flat.device)
        try:
            self._trained = Trainable(network, example)
        except UnsupportedLayerError as error:
            raise UsageError(f"network.kind = {config.network.kind!r}: {error}") from error
        self.plain = not isinstance(self._trained.backprop, AutogradBackprop)
        if not self.plain and config.network.dtype != "float32":
            kind, stacks = config.network.kind, "only stacks of Linear, Conv2d, ReLU and Flatten have others"
            raise UsageError(
                f"network.dtype = {config.network.dtype!r}: allowed: 'float32' with network.kind = {kind!r}; {stacks}"
            )
        self._passes = self._trained if half is None else Trainable(half, None)
        self.in_numpy = self._passes.in_numpy
        self._rule = FeedbackRule(self._passes.backprop, config.feedback, config.seed, rng)
        self._spec = spec
        self.theta: Any
        self.gradient: Any
        self.theta, self.gradient = self._trained.theta, self._trained.gradient

    def inputs(self, frames: AnyArray, index: AnyArray) -> AnyArray:
        """The input of both networks: [n, *input], pictures channels last.

        frames: <frame_dtype>[unique, *frame_shape]. index: int32 [n * stack], their rows in observations, oldest first.
        """
        shape = (-1, *self._spec.obs_shape)
        if not isinstance(frames, Tensor):
            return preprocess(frames.take(index, axis=0).reshape(shape), self._spec)
        if self._passes.gradient.dtype == torch.float32 and self._spec.stack == 4 and len(self._spec.frame_shape) == 2:
            stacked = kernels.stacks(frames, torch.as_tensor(index), len(index) // 4)
            if stacked is not None:
                return stacked
        obs = frames.index_select(0, torch.as_tensor(index)).view(shape)
        if obs.dim() == 4:
            obs = obs.contiguous(memory_format=torch.channels_last)
        return preprocess(obs, self._spec, self._passes.gradient.dtype)

    def forward(self, inputs: AnyArray) -> Tape[Any]:
        """Run a forward pass and record its activations for `backward`."""
        return self._passes.backprop.forward(self._passes.cast(inputs))

    def values(self, inputs: AnyArray) -> Any:  # noqa: ANN401
        """Q-values for the targets, float32 [batch, actions]."""
        return as_float32(self._passes.values(self._passes.cast(inputs)))

    def backward(self, tape: Tape[Any], output_error: AnyArray, s: Any) -> None:  # noqa: ANN401
        """Compute `gradient` from an output error, float32 [batch, actions], through the method's feedback.

        s: a number, or a tensor of one on the network's device.
        """
        self._rule.backward(tape, self._passes.cast(output_error), s, self._passes.gradients)
        if self._passes is not self._trained:
            assign(self.gradient, self._passes.gradient)

    def add_gradient(self, tape: Tape[Any], output_error: AnyArray) -> None:
        """Add the gradient of another cost to `gradient`; s is 0 in it. Arguments as `backward`'s."""
        before = self.gradient * 1  # a copy, in either library
        self.backward(tape, output_error, 0.0)
        self.gradient += before

    def follow(self, other: QNetwork, share: float) -> None:
        """Move all parameters towards another network's by this share of the way."""
        self.theta += share * (other.theta - self.theta)
        self.changed()

    def decay(self, rates: AnyArray) -> None:
        """Add rates * theta, rates float32 [P], to the gradient."""
        self.gradient += convert_like(rates, self.theta) * self.theta

    def load(self, flat: Tensor | NDArray[np.float32]) -> None:
        """Overwrite all parameters, float32 [P]."""
        self.network.load(flat)
        self.changed()

    def changed(self) -> None:
        """Update the copy in bfloat16; call after changing theta."""
        if self._half is not None:
            self._half.load(self.network.flat)


def make_network(
    config: RunConfig, spec: EnvSpec, number: int, device: torch.device, dtype: torch.dtype = torch.float32
) -> FlatNetwork:
    """Make network 0 or 1 with its initial parameters; they are equal if the second network is a copy."""
    seed = int(np.random.SeedSequence([config.seed, number if config.two_networks else 0]).generate_state(1)[0])
    build = loaded(METHODS.get(config.method).network, f"method {config.method!r}")
    return FlatNetwork(build(config.network.kind, spec, config.network.hidden, seed).to(device, dtype))


def make_q_network(
    config: RunConfig, spec: EnvSpec, number: int, device: torch.device, rng: np.random.Generator
) -> QNetwork:
    """Make network 0 or 1 with its initial parameters, for training."""
    in_half = config.network.dtype == "bfloat16"
    half = make_network(config, spec, number, device, torch.bfloat16) if in_half else None
    return QNetwork(make_network(config, spec, number, device), half, config, spec, rng)


def as_float32(values: Any) -> Any:  # noqa: ANN401
    """Values of either library in float32, on their device."""
    return values.float() if isinstance(values, Tensor) else values


def on_host(values: AnyArray) -> NDArray[np.float32]:
    """Convert values of either library to a float32 numpy array."""
    return values.float().cpu().numpy() if isinstance(values, Tensor) else values
