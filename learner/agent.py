"""The learner of Algorithm 1: two networks, one of which acts and is trained, and the swap of their roles.

The methods (`coop.common.settings.methods`) differ only in these:

    method   second network   target             feedback                              extra cost
    dqn      copy of first    copied every C     none                                  none
    edql     copy of first    copied every C     transform | weight-gradient | random  none
    g-coop   independent      the other network  none                                  none
    coop     independent      the other network  transform | weight-gradient | random  none
    medqn    copy of first    copied every C     none                                  Q away from the target network's

A method without a replay buffer has an agent of its own (`coop.learner.methods.stream_q`).
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

from coop.common.errors import UsageError, first_line
from coop.common.networks.devices import usable_device
from coop.common.networks.masks import allowed
from coop.common.networks.network import FlatNetwork
from coop.common.numbers import generator_state, set_generator_state
from coop.common.process.output import warn
from coop.common.settings import schedules
from coop.common.settings.config import RunConfig
from coop.common.transitions import Batch
from coop.common.types import Array, EnvSpec
from coop.learner.edl.arrays import chosen, convert_like, namespace
from coop.learner.edl.branches import Branches
from coop.learner.given import Given
from coop.learner.losses import LOSSES, Values, output_error, td_errors
from coop.learner.methods.own_rule import make_rule
from coop.learner.methods.rule import AUTOGRAD
from coop.learner.methods.step import Step, slope_of, to_host
from coop.learner.optimizers import make_optimizer
from coop.learner.qnetwork import as_float32, make_q_network, on_host
from coop.learner.recorded import Capture, Late, Recorded, cuda_graph

LAG = 16  # updates of a GPU after which their TD errors are read


@dataclass(frozen=True, slots=True)
class Update:
    """The measurements of one update.

    errors: `td_errors`, or where they will be. s: the value of s in this update. swapped: the roles changed after it.
    """

    errors: NDArray[np.float32] | Late
    s: float
    swapped: bool

    @property
    def td_errors(self) -> NDArray[np.float32]:
        """The TD error e of each action taken, before clipping and weighting, and before the update: float32 [batch].

        Waits for a GPU that is not yet there.
        """
        return self.errors.read() if isinstance(self.errors, Late) else self.errors


class Agent:
    """Both networks with their optimizers, the acting role, and the update.

    Args:
        config: of the run. spec: of its environment.

    Attributes:
        acting: 0 or 1, index of the network that acts and is trained.
        updates: number of updates done.
        networks: the parameters of both networks. versions: `updates` at each network's last change.
        loss: the loss of a TD error. rule: what the method changes in the update.
        lag: updates after which TD errors should be read; earlier, the host waits for the GPU.
        eager: why updates are not recorded and repeated as a whole; empty if they are.
    """

    def __init__(self, config: RunConfig, spec: EnvSpec, capture: Capture | None = None) -> None:
        """capture: makes a function repeatable; CUDA graphs on a GPU, and none elsewhere, if not given.

        Raises UsageError for a missing device, a method that can't be loaded, or a weight decay for other layers.
        """
        self.config = config
        self.spec = spec
        self.device = usable_device(config.learner.device, f"learner.device = {config.learner.device!r}")
        if self.device.type == "cuda":
            torch.backends.cuda.matmul.allow_tf32 = torch.backends.cudnn.allow_tf32 = config.learner.tf32
        self.loss = LOSSES[config.learner.loss]
        self.acting = 0
        self.updates = 0
        self._tau = config.soft_targets
        self.versions = [0, 0]
        self._noise = np.random.default_rng([config.seed, 2])
        self._networks = [make_q_network(config, spec, number, self.device, self._noise) for number in (0, 1)]
        trained = self._networks if config.two_networks else self._networks[:1]
        self.optimizers = [make_optimizer(config.learner, one.theta, one.gradient) for one in trained]
        self.rule = make_rule(config, self._noise)
        decay = _decay_vector(config.learner.weight_decay, self.networks[0].layout)
        self._weight_decay = None if decay is None else convert_like(decay, self._networks[0].theta)
        if capture is None and self.device.type == "cuda":
            capture = cuda_graph
        self.lag = LAG if self.device.type == "cuda" else 0
        self.eager = "" if capture is None else self._obstacle()
        self._recorded = None
        if capture is not None and not self.eager:
            self._recorded = Recorded(self._learn, config, spec, self.device, capture, self)

    @property
    def networks(self) -> list[FlatNetwork]:
        """The parameters of both networks."""
        return [one.network for one in self._networks]

    def update(self, batch: Batch) -> Update:
        """One step of Algorithm 1: train the acting network towards the other one's targets, then count the step."""
        s, rate = self._draw_s(), self._learning_rate()
        # The trainer finds TD errors that are not finite; numpy, like PyTorch, does not warn of them here.
        with torch.inference_mode(), np.errstate(all="ignore"):
            errors: Values | Late | None = self._repeated(batch, s, rate)
            if errors is None:
                errors = self._led(batch, s, rate)
        return Update(errors, s, swapped=self._count())

    def _learn(self, acting: int, given: Given, batch: Batch | None = None) -> Any:  # noqa: ANN401
        """Train the acting network with a batch; returns the TD errors before that, float32 [batch].

        It stays with one array library on one device, and no value decides what it does.
        """
        # (roles of the networks)
        online, target, settings = self._networks[acting], self._networks[1 - acting], self.config.learner
        held = given.columns
        inputs, size = online.inputs(given.frames, given.index), len(held.actions)
        first = None
        for _ in range(self.rule.passes):
            branches = Branches(inputs)
            next_values = branches.run(lambda: target.values(inputs[size:]), inputs)
            # With `double` the acting network chooses the next actions, so one pass covers obs and next_obs.
            tape = online.forward(inputs if settings.double else inputs[:size])
            values = as_float32(tape.output)
            branches.join()
            next_values = allowed(next_values, held.next_mask)
            q, q_next = allowed(values[:size], held.mask), next_values
            if settings.double:
                q_next = allowed(values[size:], held.next_mask)
            step = None
            if self.rule.hooks:
                step = self._step(acting, given, batch, inputs)
                step.know(q=q, target_q_next=next_values)
                if settings.double:
                    step.know(q_next=q_next)
            if step is not None and "targets" in self.rule.hooks:
                errors = self._own_errors(step, given, q)
            else:
                errors = td_errors(held, q, self._bootstrap(next_values, q_next), settings.value_bound)
            error = output_error(held, self.loss.slope(errors), next_values)
            if step is not None and self.rule.hooks & AUTOGRAD:
                error = self._own_error(step, given, errors, error, q)
            online.backward(tape.head(size), error, given.s)
            if step is not None:
                self.rule.add_gradient(step)
            if self._weight_decay is not None:
                online.decay(self._weight_decay)
            self.optimizers[acting].step(given.rate)
            online.changed()
            if step is not None:
                self.rule.after_update(step)
            first = errors if first is None else first
        if self._tau is not None:
            target.follow(online, self._tau)
        return first

    def _step(self, acting: int, given: Given, batch: Batch | None, inputs: Any = None) -> Step:  # noqa: ANN401
        """What the rule sees of an update."""
        give = (lambda values: values) if self.rule.on_device else to_host
        return Step(self._networks[acting], self._networks[1 - acting], given, batch, self.updates, give, inputs)

    def _own_errors(self, step: Step, given: Given, values: Any) -> Any:  # noqa: ANN401
        """The TD errors towards the rule's own targets, float32 [batch], in the arrays of `values`."""
        step.targets = self.rule.targets(step)
        return chosen(values, given.columns.actions) - convert_like(step.targets, values)

    def _own_error(self, step: Step, given: Given, errors: Any, error: Any, values: Any) -> Any:  # noqa: ANN401
        """The gradient of the rule's own loss, or of the loss and its extra cost, at the outputs."""
        hooks = self.rule.hooks
        if step.targets is None:
            step.targets = chosen(values, given.columns.actions) - errors
        if "loss" in hooks:
            error = convert_like(slope_of(self.rule.loss, step, values), values)
        if "extra_cost" in hooks:
            error = error + convert_like(slope_of(self.rule.extra_cost, step, values), values)
        mask = given.columns.mask
        return error if mask is None else namespace(error).where(mask, error, 0.0)

    def own_td_errors(self, batch: Batch) -> Values | None:
        """The TD errors of a batch by the rule's own targets, float32 [batch]; None if it has none of its own."""
        if "targets" not in self.rule.hooks:
            return None
        device = None if self._networks[0].in_numpy else self.device
        with torch.inference_mode(), np.errstate(all="ignore"):
            given = Given.of(batch, self.config.learner.gamma, 0.0, 0.0, device)
            step = self._step(self.acting, given, batch)
            values = step.online.values(step.inputs[: len(batch)])
            return on_host(self._own_errors(step, given, values))

    def _bootstrap(self, next_values: Any, preferred: Any) -> Any:  # noqa: ANN401
        """V(x') by the method's rule, in the networks' arrays: float32 [batch]."""
        if self.rule.on_device:
            return self.rule.bootstrap(next_values, preferred)
        return convert_like(self.rule.bootstrap(on_host(next_values), on_host(preferred)), next_values)

    def _led(self, batch: Batch, s: float, rate: float) -> Values:
        """Do an update step by step."""
        device = None if self._networks[0].in_numpy else self.device
        return on_host(self._learn(self.acting, Given.of(batch, self.config.learner.gamma, s, rate, device), batch))

    def _repeated(self, batch: Batch, s: float, rate: float) -> Late | None:
        """Repeat the recorded update; None if none is, the batch does not fit it, or recording fails."""
        if self._recorded is None or not self._recorded.fits(batch):
            return None
        try:
            return self._recorded.run(self.acting, batch, s, rate)
        except RuntimeError as error:
            self.eager = first_line(error)
            self._recorded = None
            warn(f"updates are not recorded as CUDA graphs, and take longer: {self.eager}")
            return None

    def _obstacle(self) -> str:
        """Why updates can't be recorded; empty if they can."""
        if self._networks[0].in_numpy:
            return "the network is small and runs in numpy"
        if not self._networks[0].plain:
            return f"network.kind = {self.config.network.kind!r} is no plain stack of layers"
        if self.rule.hooks & AUTOGRAD:
            return f"the rule of {self.config.method} has a cost of its own, by autograd"
        if not self.rule.on_device:
            return f"the rule of {self.config.method} uses the host"
        if self.config.feedback == "weight-gradient":
            return "edl.feedback = 'weight-gradient' decomposes matrices on the host"
        return ""

    def swap(self) -> None:
        """Change the acting role; for the one-network methods, copy the network to its target."""
        if self.config.two_networks:
            # (swap)
            self.acting = 1 - self.acting
        else:
            self._networks[1].load(self.networks[0].flat)
            self.versions[1] = self.updates

    def epsilon(self, env_step: int) -> float:
        """Probability of a random action after `env_step` environment steps."""
        return schedules.epsilon(self.config.actor, env_step)

    def feedback_scale(self) -> float:
        """The present scale of s."""
        return self.feedback_scale_at(self.updates)

    def feedback_scale_at(self, update: int) -> float:
        """The scale of s in an update, counted from 0; 0 for the gradient methods."""
        return 0.0 if self.config.feedback == "none" else schedules.feedback_scale(self.config.edl, update)

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
        self.rule.load_state(state["rule"])

    def _draw_s(self) -> float:
        s = self.feedback_scale()
        # (draw of s)
        return s * float(self._noise.standard_normal()) if self.config.edl.noise == "normal" and s else s

    def _learning_rate(self) -> float:
        return schedules.learning_rate(self.config.learner, self.updates, self.config.planned_updates)

    def _count(self) -> bool:
        """Count an update; return True if the roles change after it."""
        self.updates += 1
        self.versions[self.acting] = self.updates
        settings = self.config.learner
        if self._tau is not None:
            self.versions[1] = self.updates
            return False
        # (swap due)
        due = settings.swap_unit == "updates" and self.updates % self.config.swap_period == 0
        if due:
            self.swap()
        return due


def _decay_vector(decay: tuple[float, ...], layout: Sequence[tuple[str, tuple[int, ...]]]) -> Tensor | None:
    """lambda(i) of each parameter in a network's layout, float32 [P]; a bias has its layer's."""
    if not any(decay):
        return None
    layers = list(dict.fromkeys(name.rsplit(".", 1)[0] for name, _ in layout))
    if len(decay) not in (1, len(layers)):
        raise UsageError(f"learner.weight_decay = {decay}: give one value, or one for each of {len(layers)} layers")
    by_layer = dict(zip(layers, decay * len(layers) if len(decay) == 1 else decay, strict=True))
    return torch.cat([torch.full((math.prod(shape),), by_layer[name.rsplit(".", 1)[0]]) for name, shape in layout])
