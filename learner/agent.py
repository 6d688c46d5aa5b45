"""The learner of Algorithm 1: two networks, one of which acts and is trained, and the swap of their roles.

The methods (`common.settings.methods`) differ only in these:

    method   second network   target             feedback                              extra cost
    dqn      copy of first    copied every C     none                                  none
    edql     copy of first    copied every C     transform | weight-gradient | random  none
    g-coop   independent      the other network  none                                  none
    coop     independent      the other network  transform | weight-gradient | random  none
    medqn    copy of first    copied every C     none                                  Q away from the target network's

A method without a replay buffer has an agent of its own (`learner.methods.stream_q`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from common.errors import UsageError
from common.networks.network import FlatNetwork
from common.process.randomness import generator_state, set_generator_state
from common.registry import loaded
from common.settings import schedules
from common.settings.config import RunConfig
from common.settings.methods import METHODS
from common.types import Array, Batch, EnvSpec
from learner.edl.arrays import AnyArray
from learner.losses import LOSSES, Values, output_error, td_errors
from learner.methods.rule import Rule
from learner.optimizers import make_optimizer
from learner.qnetwork import QNetwork, make_q_network, on_host


@dataclass(frozen=True, slots=True)
class Update:
    """The measurements of one update.

    td_errors: float32 [batch], e of the taken actions before clipping and weighting, and before the update.
    s: the value of s in this update. swapped: the roles changed after it.
    """

    td_errors: NDArray[np.float32]
    s: float
    swapped: bool


class Agent:
    """Both networks with their optimizers, the acting role, and the update.

    Args:
        config: of the run. spec: of its environment.

    Attributes:
        acting: 0 or 1, index of the network that acts and is trained.
        updates: number of updates done.
        networks: the parameters of both networks. versions: `updates` at each network's last change.
        loss: the loss of a TD error. rule: what the method changes in the update.
    """

    def __init__(self, config: RunConfig, spec: EnvSpec) -> None:
        """Raise UsageError for a missing device, a method that can't be loaded, or a weight decay for other layers."""
        self.config = config
        self.spec = spec
        self.device = _device(config.learner.device)
        self.loss = LOSSES[config.learner.loss]
        self.acting = 0
        self.updates = 0
        self.versions = [0, 0]
        self._noise = np.random.default_rng([config.seed, 2])
        self._networks = [make_q_network(config, spec, number, self.device, self._noise) for number in (0, 1)]
        trained = self._networks if config.two_networks else self._networks[:1]
        self.optimizers = [make_optimizer(config.learner, one.theta, one.gradient) for one in trained]
        rule = loaded(METHODS.get(config.method).rule, f"method {config.method!r}")
        self.rule: Rule = rule(config, self._noise)
        self._weight_decay = _decay_vector(config.learner.weight_decay, self.networks[0].layout)

    @property
    def networks(self) -> list[FlatNetwork]:
        """The parameters of both networks."""
        return [one.network for one in self._networks]

    def update(self, batch: Batch) -> Update:
        """One step of Algorithm 1: train the acting network towards the other one's targets, then count the step."""
        online, target = self._networks[self.acting], self._networks[1 - self.acting]
        s = self._draw_s()
        # The trainer finds TD errors that are not finite; numpy, like PyTorch, does not warn of them here.
        with torch.inference_mode(), np.errstate(all="ignore"):
            inputs = online.inputs(batch, self.spec)
            first, *_ = [self._step(online, target, batch, inputs, s) for _ in range(self.rule.passes)]
        return Update(first, s, swapped=self._count())

    def _step(self, online: QNetwork, target: QNetwork, batch: Batch, inputs: AnyArray, s: float) -> Values:
        """Make one step of the optimizer; returns the TD errors before it, float32 [batch]."""
        settings, size = self.config.learner, len(batch)
        # With `double` the acting network chooses the next actions, so one pass covers obs and next_obs.
        tape = online.forward(inputs if settings.double else inputs[:size])
        values, next_values = on_host(tape.output), target.values(inputs[size:])
        bootstrap = self.rule.bootstrap(next_values, values[size:] if settings.double else next_values)
        errors = td_errors(batch, values, bootstrap, settings.gamma, settings.value_bound)
        online.backward(tape.head(size), output_error(batch, self.loss.slope(errors), next_values), s)
        self.rule.add_cost(online, target, inputs, self.updates)
        if self._weight_decay is not None:
            online.decay(self._weight_decay)
        self.optimizers[self.acting].step(self._learning_rate())
        online.changed()
        return errors

    def swap(self) -> None:
        """Change the acting role; for the one-network methods, copy the network to its target."""
        if self.config.two_networks:
            self.acting = 1 - self.acting
        else:
            self._networks[1].load(self.networks[0].flat)
            self.versions[1] = self.updates

    def epsilon(self, env_step: int) -> float:
        """Probability of a random action after `env_step` environment steps."""
        return schedules.epsilon(self.config.actor, env_step)

    def exploration_rate(self) -> float:
        """The present scale of s; 0 for the gradient methods."""
        return 0.0 if self.config.feedback == "none" else schedules.exploration_rate(self.config.edl, self.updates)

    def finite(self) -> bool:
        """True while every parameter of both networks is finite."""
        return all(network.finite() for network in self.networks)

    def q_values(self, obs: Array) -> tuple[Values, Values]:
        """Q1 and Q2, float32 [batch, actions], of stored observations <frame_dtype>[batch, *obs_shape]."""
        first, second = self.networks
        return first.q_values(obs, self.spec), second.q_values(obs, self.spec)

    def state(self) -> dict[str, Any]:
        """The state for `load_state`; torch.load reads it with weights_only."""
        return {
            "networks": [network.flat.cpu().clone() for network in self.networks],
            "optimizers": [optimizer.state() for optimizer in self.optimizers],
            "acting": self.acting,
            "updates": self.updates,
            "versions": list(self.versions),
            "noise": generator_state(self._noise),
            "rule": self.rule.state(),
        }

    def load_state(self, state: dict[str, Any]) -> None:
        """Restore a state from `state`."""
        for network, flat in zip(self._networks, state["networks"], strict=True):
            network.load(flat)
        for optimizer, saved in zip(self.optimizers, state["optimizers"], strict=True):
            optimizer.load_state(saved)
        self.acting, self.updates, self.versions = state["acting"], state["updates"], list(state["versions"])
        set_generator_state(self._noise, state["noise"])
        self.rule.load_state(state.get("rule", {}))  # older states lack it

    def _draw_s(self) -> float:
        s = self.exploration_rate()
        return s * float(self._noise.standard_normal()) if self.config.edl.noise == "normal" and s else s

    def _learning_rate(self) -> float:
        return schedules.learning_rate(self.config.learner, self.updates, self.config.planned_updates)

    def _count(self) -> bool:
        """Count an update; return True if the roles change after it."""
        self.updates += 1
        self.versions[self.acting] = self.updates
        settings = self.config.learner
        due = settings.swap_unit == "updates" and self.updates % self.config.swap_period == 0
        if due:
            self.swap()
        return due


def _device(name: str) -> torch.device:
    try:
        device = torch.device(name)
        torch.empty(0, device=device)
    except (RuntimeError, AssertionError) as error:
        raise UsageError(f"learner.device = {name!r}: {str(error).splitlines()[0]}") from error
    return device


def _decay_vector(decay: tuple[float, ...], layout: Sequence[tuple[str, tuple[int, ...]]]) -> Tensor | None:
    """lambda(i) of each parameter in a network's layout, float32 [P]; a bias has its layer's."""
    if not any(decay):
        return None
    layers = list(dict.fromkeys(name.rsplit(".", 1)[0] for name, _ in layout))
    if len(decay) not in (1, len(layers)):
        raise UsageError(f"learner.weight_decay = {decay}: give one value, or one for each of {len(layers)} layers")
    by_layer = dict(zip(layers, decay * len(layers) if len(decay) == 1 else decay, strict=True))
    return torch.cat([torch.full((math.prod(shape),), by_layer[name.rsplit(".", 1)[0]]) for name, shape in layout])
