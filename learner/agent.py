"""Algorithm 1's learner: two networks, one of them acting and trained, and the swap of their roles.

The four methods differ by config only:

    method   second network   target             feedback
    dqn      copy of first    copied every C     none
    edql     copy of first    copied every C     transform | weight-gradient | random
    g-coop   independent      the other network  none
    coop     independent      the other network  transform | weight-gradient | random
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from common.errors import UsageError
from common.networks.network import FlatNetwork, build_network, preprocess
from common.process.randomness import generator_state, set_generator_state
from common.settings import schedules
from common.settings.config import RunConfig
from common.types import Batch, EnvSpec
from learner.edl.arrays import Array, assign
from learner.edl.feedback import FeedbackRule
from learner.edl.trainable import Trainable
from learner.optimizers import make_optimizer

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class UpdateResult:
    """What one update measured.

    td_errors: float32 [batch], e of the taken actions before clipping and weighting.
    s: the exploration rate used. swapped: the roles changed after this update.
    """

    td_errors: NDArray[np.float32]
    s: float
    swapped: bool


class Agent:
    """Both networks with their optimizers, the acting role and the update.

    Args:
        config: the run; `spec`: its environment.

    Attributes:
        acting: 0 or 1, index of the network that acts and is trained.
        updates: updates done.
        networks: the two networks. versions: updates done when each was changed last.
    """

    def __init__(self, config: RunConfig, spec: EnvSpec) -> None:
        """Raises UsageError for a device that is not there or weight decays that do not fit the layers."""
        settings = config.learner
        self.config = config
        self.spec = spec
        self.device = _device(settings.device)
        self.networks = [make_network(config, spec, number, self.device) for number in (0, 1)]
        self._halves = self._half_networks()
        self.acting = 0
        self.updates = 0
        self.versions = [0, 0]
        polar_dtype = torch.bfloat16 if config.edl.polar_dtype == "bfloat16" else None
        in_numpy = polar_dtype is None and not settings.compile
        self._trainables = [Trainable(network, in_numpy) for network in self.networks]
        halves = [Trainable(network, in_numpy) for network in self._halves]
        self._targets = halves or self._trainables
        # What the gradient is made of: error-driven feedback needs the accuracy of float32.
        self._sources = self._targets if config.feedback == "none" else self._trainables
        trained = self._trainables if config.two_networks else self._trainables[:1]
        self.optimizers = [make_optimizer(settings, one.theta, one.gradient) for one in trained]
        rules = [FeedbackRule(source.chain, config.feedback, config.seed, polar_dtype) for source in self._sources]
        ready = torch.compile if settings.compile else _as_it_is
        self._forward = [ready(source.chain.forward) for source in self._sources]
        self._values = [ready(target.values) for target in self._targets]
        self._backward = [ready(rule.backward) for rule in rules]
        self._noise = np.random.default_rng([config.seed, 2])
        decay = _decay_vector(settings.weight_decay, self.networks[0].layout)
        self._decay = None if decay is None else self._trainables[0].take(decay)

    def update(self, batch: Batch) -> UpdateResult:
        """Train the acting network on one batch, towards targets of the other one; then swap if it is time.

        e[a] = y[a] - (r + gamma^k (1 - terminated) Q_target(x', u*)), k the steps that the transition spans, u* the
        target's best action, or the acting network's with `double`.
        """
        settings, acting = self.config.learner, self.acting
        trained, source, target = self._trainables[acting], self._sources[acting], self._targets[1 - acting]
        s = self._draw_s()
        # A run that diverges goes on: numpy then says no more than PyTorch.
        with torch.inference_mode(), np.errstate(all="ignore"):
            states = self._states(batch)
            obs, next_obs = states[: len(batch)], states[len(batch) :]
            # One pass of the acting network over both where its choice of next actions is asked for.
            tape = self._forward[acting](source.take(states if settings.double else obs))
            next_output = self._values[1 - acting](target.take(next_obs))
            td_errors, output_error = self._errors(batch, tape.output, next_output)
            if settings.double:
                tape = tape.head(len(batch))
            self._backward[acting](tape, source.take(output_error), s, source.gradients)
            if source is not trained:
                assign(trained.gradient, source.gradient)
            if self._decay is not None:
                trained.gradient += self._decay * trained.theta
            progress = self.updates / max(1, self.config.planned_updates)
            self.optimizers[acting].step(schedules.learning_rate(settings, progress))
            self._halve(acting)
        return UpdateResult(td_errors, s, self._count())

    def swap(self) -> None:
        """Change the acting role; for the one-network methods, copy the network to its target."""
        if self.config.two_networks:
            self.acting = 1 - self.acting
        else:
            self.networks[1].load(self.networks[0].flat)
            self._halve(1)
            self.versions[1] = self.updates

    def exploration_rate(self) -> float:
        """The rate that s is now drawn from; 0 for the gradient methods."""
        return 0.0 if self.config.feedback == "none" else schedules.exploration_rate(self.config.edl, self.updates)

    def losses(self, errors: NDArray[np.float32]) -> NDArray[np.float32]:
        """The cost of each TD error: 1/2 e^2, or Huber's."""
        size = np.abs(errors)
        if self.config.learner.loss == "huber":
            return np.where(size < 1, np.float32(0.5) * size * size, size - np.float32(0.5))
        return np.float32(0.5) * size * size

    def q_values(self, obs: Array) -> tuple[Tensor, Tensor]:
        """Q1 and Q2, float32 [batch, actions], of stored observations <frame_dtype>[batch, *obs_shape]."""
        with torch.no_grad():
            x = preprocess(torch.as_tensor(obs, device=self.device), self.spec)
            return self.networks[0](x), self.networks[1](x)

    def state(self) -> dict[str, Any]:
        """Everything that `load_state` needs; loads with weights_only."""
        return {
            "networks": [network.flat.cpu().clone() for network in self.networks],
            "optimizers": [optimizer.state() for optimizer in self.optimizers],
            "acting": self.acting,
            "updates": self.updates,
            "versions": list(self.versions),
            "noise": generator_state(self._noise),
        }

    def load_state(self, state: dict[str, Any]) -> None:
        """Continue where `state` was taken."""
        for number, flat in enumerate(state["networks"]):
            self.networks[number].load(flat)
            self._halve(number)
        for optimizer, saved in zip(self.optimizers, state["optimizers"], strict=True):
            optimizer.load_state(saved)
        self.acting, self.updates, self.versions = state["acting"], state["updates"], list(state["versions"])
        set_generator_state(self._noise, state["noise"])

    def _half_networks(self) -> list[FlatNetwork]:
        """Copies of both networks in bfloat16, kept up by `_halve`; none where all is computed in float32."""
        if self.config.network.dtype == "float32":
            return []
        return [make_network(self.config, self.spec, number, self.device, torch.bfloat16) for number in (0, 1)]

    def _halve(self, number: int) -> None:
        if self._halves:
            self._halves[number].load(self.networks[number].flat)

    def _draw_s(self) -> float:
        s = self.exploration_rate()
        return s * float(self._noise.standard_normal()) if self.config.edl.noise == "normal" and s else s

    def _states(self, batch: Batch) -> Array:
        """Inputs of the networks [2 batch, *input]: obs, then next_obs."""
        index = np.concatenate((batch.obs_index, batch.next_index)).reshape(-1)
        if self._trainables[0].in_numpy:
            return batch.frames.take(index, axis=0)
        # Copies: arrays from the wire are read-only, and PyTorch warns of viewing those.
        frames, places = torch.tensor(batch.frames, device=self.device), torch.tensor(index, device=self.device)
        return preprocess(frames.index_select(0, places).view(-1, *self.spec.obs_shape), self.spec)

    def _errors(self, batch: Batch, output: Array, next_output: Array) -> tuple[NDArray[np.float32], Array]:
        """TD errors of the taken actions, float32 [batch], and e with weights and batch mean in it, [batch, actions].

        output: of the acting network for obs, and for next_obs below it with `double`. next_output: of the other one.
        In numpy on the host, whose operations on so few numbers cost a fraction of PyTorch's.
        """
        settings, rows = self.config.learner, np.arange(len(batch))
        values, next_values = _on_host(output), _on_host(next_output)
        best = values[len(batch) :].argmax(1) if settings.double else next_values.argmax(1)
        discounts = np.float32(settings.gamma) ** batch.span * ~batch.terminated
        td_errors = values[rows, batch.actions] - (batch.rewards + discounts * next_values[rows, best])
        clipped = td_errors.clip(-1, 1) if settings.loss == "huber" else td_errors
        output_error = np.zeros_like(next_values)
        output_error[rows, batch.actions] = clipped * batch.weights / np.float32(len(batch))
        return td_errors, output_error

    def _count(self) -> bool:
        self.updates += 1
        self.versions[self.acting] = self.updates
        settings = self.config.learner
        due = settings.swap_by == "updates" and self.updates % settings.swap_every == 0
        if due:
            self.swap()
        return due


def make_network(
    config: RunConfig, spec: EnvSpec, number: int, device: torch.device, dtype: torch.dtype = torch.float32
) -> FlatNetwork:
    """Network 0 or 1 of a run as it starts; the same one for both where the method has one and a copy."""
    seed = int(np.random.SeedSequence([config.seed, number if config.two_networks else 0]).generate_state(1)[0])
    return FlatNetwork(build_network(config.network.kind, spec, config.network.hidden, seed).to(device, dtype))


def _as_it_is(function: T) -> T:
    return function


def _on_host(values: Array) -> NDArray[np.float32]:
    return values.float().cpu().numpy() if isinstance(values, Tensor) else values


def _device(name: str) -> torch.device:
    try:
        device = torch.device(name)
        torch.empty(0, device=device)
    except (RuntimeError, AssertionError) as error:
        raise UsageError(f"learner.device = {name!r}: {str(error).splitlines()[0]}") from error
    return device


def _decay_vector(decay: tuple[float, ...], layout: Sequence[tuple[str, tuple[int, ...]]]) -> Tensor | None:
    """lambda(i) of every parameter of a network's layout, float32 [P]; biases share their layer's."""
    if not any(decay):
        return None
    layers = list(dict.fromkeys(name.rsplit(".", 1)[0] for name, _ in layout))
    if len(decay) not in (1, len(layers)):
        raise UsageError(f"learner.weight_decay = {decay}: give one value, or one for each of {len(layers)} layers")
    by_layer = dict(zip(layers, decay * len(layers) if len(decay) == 1 else decay, strict=True))
    return torch.cat([torch.full((math.prod(shape),), by_layer[name.rsplit(".", 1)[0]]) for name, shape in layout])
