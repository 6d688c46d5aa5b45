"""Stream Q(lambda) of Elsayed, Vasan and Mahmood (arXiv 2410.14606): no replay buffer, no target network."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from coop.common.networks.forward import preprocess
from coop.common.networks.masks import allowed
from coop.common.networks.network import FlatNetwork
from coop.common.networks.normalised import NormalisedNetwork
from coop.common.settings import schedules
from coop.common.settings.config import RunConfig
from coop.common.settings.stream_q import StreamQSettings
from coop.common.transitions import Batch
from coop.common.types import Array, EnvSpec
from coop.learner.agent import Update
from coop.learner.losses import LOSSES, Values
from coop.learner.methods.moments import RewardScale, RunningMoments
from coop.learner.methods.rule import UpdateRule
from coop.learner.methods.traces import Traces, bounded_step
from coop.learner.qnetwork import make_network


class Transition(Batch, frozen=True):
    """A batch of one transition, the newest one.

    restart: <frame_dtype>[*obs_shape], the first observation of the next episode if the emulator was reset behind it.
    """

    restart: Array | None = None


class StreamAgent:
    """One network, learning from each transition once, in the order in which they happen.

    It stands where `coop.learner.agent.Agent` does.

    Each observation is shown to it once, by `begin` or at the end of a transition, and is standardized by the moments
    of all up to itself.

    Args:
        config: of the run. spec: of its environment.

    Attributes:
        updates: number of updates done, one for each step.
        networks: the network twice, as there is no second one.
    """

    acting = 0
    lag = 0

    def __init__(self, config: RunConfig, spec: EnvSpec) -> None:
        """Raise UsageError for a network that the method can't train."""
        assert isinstance(config.method_settings, StreamQSettings)
        self.config = config
        self.spec = spec
        self.loss = LOSSES["squared"]
        self.updates = 0
        self._settings = config.method_settings
        self.device = torch.device("cpu")
        self.rule = UpdateRule(config, np.random.default_rng(0))  # which draws no numbers
        self._network = make_network(config, spec, 0, self.device)
        assert isinstance(self._network.in_numpy, NormalisedNetwork)
        self._form = self._network.in_numpy
        self._traces = Traces(self._network, self._form)
        self._inputs = RunningMoments(spec.input_shape)
        self._scale = RewardScale(config.learner.gamma)

    @property
    def networks(self) -> list[FlatNetwork]:
        """The network, twice."""
        return [self._network, self._network]

    @property
    def versions(self) -> list[int]:
        """`updates` at the network's last change, twice."""
        return [self.updates, self.updates]

    def begin(self, obs: Array) -> None:
        """Begin an episode with an observation, <frame_dtype>[*obs_shape]."""
        self._traces.reset()
        self._observe(preprocess(obs[None], self.spec))

    def update(self, batch: Batch) -> Update:
        """Learn from the transition that follows the one before: one step of Stream Q(lambda)."""
        assert isinstance(batch, Transition)
        settings, gamma = self._settings, self.config.learner.gamma
        obs, next_obs = self._inputs_of(batch.obs_index, batch), self._inputs_of(batch.next_index, batch)
        action, terminated = int(batch.actions[0]), bool(batch.terminated[0])
        ended = terminated or batch.restart is not None
        records = self._form.record(obs)
        values = records[-1].normalised[0]
        self._observe(next_obs)
        reward = self._scale(float(batch.rewards[0]), ended=ended)
        bootstrap = 0.0 if terminated else float(allowed(self._form(next_obs), batch.next_mask).max())
        delta = reward + gamma * bootstrap - float(values[action])
        self._traces.add(records, action, gamma * settings.trace_decay)
        norm = float(torch.linalg.vector_norm(self._traces.z, 1))
        step = bounded_step(settings.step_size, settings.overshooting_bound, delta, norm)
        self._network.flat.add_(self._traces.z, alpha=step * delta)
        if batch.restart is not None:
            self.begin(batch.restart)
        elif ended or action != allowed(values[None], batch.mask).argmax():
            self._traces.reset()
        self.updates += 1
        return Update(np.array([delta], np.float32), 0.0, swapped=False)

    def swap(self) -> None:
        """Do nothing: there is one network."""

    def epsilon(self, env_step: int) -> float:
        """Probability of a random action after `env_step` environment steps."""
        settings = self._settings
        progress = env_step / (settings.epsilon_share * self.config.total_steps)
        return schedules.linear(settings.epsilon_start, settings.epsilon_final, progress)

    def feedback_scale(self) -> float:
        """The scale of s: 0, as the ordinary gradient is taken."""
        return 0.0

    def finite(self) -> bool:
        """True while every parameter is finite."""
        return self._network.finite()

    def q_values(self, obs: Array) -> tuple[Values, Values]:
        """Q, float32 [batch, actions], of stored observations <frame_dtype>[batch, *obs_shape], twice."""
        values = self._form(preprocess(obs, self.spec))
        return values, values

    def own_td_errors(self, batch: Batch) -> Values | None:
        """None: the targets of the archive are the usual ones."""

    def state(self) -> dict[str, Any]:
        """The state for `load_state`; torch.load reads it with weights_only."""
        return {
            "networks": [network.flat.clone() for network in self.networks],
            "traces": self._traces.z.clone(),
            "inputs": self._inputs.state(),
            "rewards": self._scale.state(),
            "acting": self.acting,
            "updates": self.updates,
        }

    def load_state(self, state: dict[str, Any]) -> None:
        """Restore a state from `state`."""
        self._network.load(state["networks"][0])
        self._traces.z.copy_(state["traces"])
        self._inputs.load_state(state["inputs"])
        self._scale.load_state(state["rewards"])
        self.updates = state["updates"]

    def _inputs_of(self, index: Array, batch: Batch) -> Array:
        """The network's input [1, *input] for the frames at int32 [1, stack]."""
        return preprocess(batch.frames[index].reshape(1, *self.spec.obs_shape), self.spec)

    def _observe(self, inputs: Array) -> None:
        """Add an observation, float32 [1, *input], to the moments by which the network standardizes."""
        self._inputs.add(inputs[0])
        self._form.mean[...] = self._inputs.mean
        self._form.sd[...] = self._inputs.sd
