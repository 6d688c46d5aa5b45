"""The updates of networks with one convolution, run by run: lockstep's products, and compiled loops between them.

Networks and optimizers are those of the runs' agents, in place. Pictures come as rows of bits (see `Packing`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from coop.common.networks.convolution import ConvolutionNetwork, bound_product
from coop.common.types import Array
from coop.learner.agent import Agent
from coop.learner.edl.backprop import Tape
from coop.learner.edl.convolution import ConvolutionBackprop
from coop.learner.edl.feedback import FeedbackRule
from coop.learner.edl.numpy_backprop import NumpyBackprop
from coop.learner.edl.polar import LIMITS
from coop.lockstep.compiled import loops, picture_loops
from coop.lockstep.compiled.passes import Doubles, Floats, loss_of
from coop.lockstep.compiled.tables import Batches, Packing

_Shared = dict[int, tuple[Floats, list[Floats]]]
"""Arrays that both networks of a run write to, by the number of pictures; see `_hidden_arrays`."""


class PictureNetworks:
    """Both networks of K runs, with the interface of `Networks`; a block is one run."""

    block = 1

    def __init__(self, agents: Sequence[Agent]) -> None:
        self._agents, config, spec = list(agents), agents[0].config, agents[0].spec
        self._size, self._double, self._loss = config.learner.batch_size, config.learner.double, loss_of(config.learner)
        self.batches = Batches.room(Packing(spec), 1, self._size)
        self._error = np.zeros((1, spec.num_actions, self._size), np.float32)
        self._passes = []
        for agent in agents:
            shared: _Shared = {}
            self._passes.append([_Passes(agent, role, shared) for role in (0, 1)])

    def finite(self, role: int) -> NDArray[np.bool_]:
        """Whether network `role` of each run is finite, bool [K]."""
        return np.array([agent.networks[role].finite() for agent in self._agents])

    def values(self, role: int, runs: slice, obs: Array, chosen: NDArray[np.int64]) -> Floats:
        """Q of one observation of each run, rows [n, width] -> [n, actions]; zeros where an action is chosen, >= 0."""
        found = np.zeros((len(obs), self._error.shape[1]), np.float32)
        for k in np.flatnonzero(chosen < 0).tolist():
            found[k] = self._passes[runs.start + k][role].forward(obs[k : k + 1]).output[0]
        return found

    def update(self, role: int, runs: slice, s: Doubles, rate: float, errors: Floats) -> bool:
        """Train network `role` of one run, as `Networks.update`."""
        k, size, given = runs.start, self._size, self.batches
        next_values = self._passes[k][1 - role].forward(given.x[0, size:]).output.T[None]
        online = self._passes[k][role]
        tape = online.forward(given.x[0] if self._double else given.x[0, :size])
        values = tape.output.T[None]
        preferred = values[:, :, size:] if self._double else next_values
        finite = loops.temporal(
            values, next_values, preferred, given.taken, given.rewards, given.discounts, *self._loss, errors,
            self._error,
        )  # fmt: skip
        online.backward(tape.head(size) if self._double else tape, self._error[0].T, float(s[0]))
        self._agents[k].optimizers[role].step(rate)
        return bool(finite)

    def count(self, role: int) -> None:
        """The optimizers count their steps."""

    def copy(self) -> None:
        """Copy the first network of each run to its second one."""
        for agent in self._agents:
            agent.networks[1].load(agent.networks[0].flat)

    def save(self, k: int) -> None:
        """The agents' networks are these."""

    def save_means(self, k: int) -> None:
        """The agents' optimizers are these."""

    def kept(self, runs: NDArray[np.intp]) -> PictureNetworks:
        """The networks of these runs alone."""
        return PictureNetworks([self._agents[k] for k in runs])


@dataclass
class _Room:
    """Arrays of a forward pass of so many pictures, and the products that fill them.

    windows: see `picture_loops.windows`. columns: [1, units, batch] of each layer. tape: views of them.
    """

    windows: Floats
    columns: list[Floats]
    products: list[Callable[[], object]]
    tape: Tape[Array]


def _hidden_arrays(form: ConvolutionNetwork, places: tuple[int, ...], count: int) -> tuple[Floats, list[Floats]]:
    """What the kernel sees of so many pictures, and the outputs of the hidden layers, [units, count]."""
    down, across = places
    windows = np.ones((form.weights[0].shape[1] + 1, down, across * count), np.float32)
    return windows, [np.empty((weight.shape[1], count), np.float32) for weight in form.weights[1:]]


class _Passes(ConvolutionBackprop):
    """The passes of one network, whose pictures are rows of bits, uint8 [batch, width]."""

    def __init__(self, agent: Agent, role: int, shared: _Shared) -> None:
        network, config, spec = agent.networks[role], agent.config, agent.spec
        form = network.in_numpy
        assert isinstance(form, ConvolutionNetwork)
        super().__init__(form)
        self._form = form
        self._rule = FeedbackRule(self, config.feedback, rng=agent._noise)
        self._gradients = agent._networks[role]._trained.gradients
        self._geometry = np.array((*spec.frame_shape, *form.kernel))
        self._places = form.places(spec.frame_shape[:2])
        self._kernel = np.empty((form.weights[0].shape[0], form.weights[0].shape[1] + 1), np.float32)
        units = [weight.shape[1] for weight in form.weights[1:]]
        self._biases = [np.zeros((1, units[0]), np.float32), *(bias.T for bias in form.biases[1:])]
        self._shared, self._rooms = shared, dict[int, _Room]()

    def _room(self, count: int) -> _Room:
        """For so many pictures; both networks of a run write to the same arrays, except for their values."""
        if count not in self._shared:
            self._shared[count] = _hidden_arrays(self._form, self._places, count)
        windows, hidden = self._shared[count]
        columns = [*hidden, np.empty((len(self._form.weights[-1]), count), np.float32)]
        seen = windows.reshape(len(windows), -1)
        inputs, first = [seen, *hidden], columns[0].reshape(len(self._kernel), -1)
        products = [
            bound_product(weight, x, out)
            for weight, x, out in zip(
                (self._kernel, *self._form.weights[1:]), inputs, (first, *columns[1:]), strict=True
            )
        ]
        tape = Tape(columns[-1].T, [windows.reshape(len(windows), -1, count).T, *(column.T for column in hidden)])
        return _Room(windows, [column[None] for column in columns], products, tape)

    def forward(self, x: Array) -> Tape[Array]:
        """As `ConvolutionBackprop.forward`; the next call with as many pictures, of either network, overwrites it.

        The values stay until the next call of this one.
        """
        count, form = len(x), self._form
        if count not in self._rooms:
            self._rooms[count] = self._room(count)
        room = self._rooms[count]
        picture_loops.windows(x, self._geometry, room.windows)
        self._kernel[:, :-1], self._kernel[:, -1:] = form.weights[0], form.biases[0]
        for work, column, bias in zip(room.products, room.columns, self._biases, strict=True):
            work()
            (loops.shift if bias is self._biases[-1] else loops.rectify)(column, bias)
        return room.tape

    def backward(self, tape: Tape[Array], error: Array, s: float) -> None:
        """Write the gradient, as `QNetwork.backward`."""
        self._rule.backward(tape, error, s, self._gradients)

    @staticmethod
    def _muted(column: Array, h: Array) -> Array:
        picture_loops.muted_column(column, h)
        return column

    @staticmethod
    def _turned(delta: Array) -> Array:
        if delta.T.flags.c_contiguous:
            return delta.T
        out = np.empty(delta.shape[::-1], delta.dtype)
        picture_loops.turned(delta, out)
        return out

    @staticmethod
    def whitened(grams: Array, e: Array) -> tuple[Array, Array | None]:
        """As `NumpyBackprop.whitened`; three actions in a loop, unless some are not accurate."""
        if grams.shape[-1] == 3:
            white, limits = np.empty(grams.shape[:-1]), LIMITS[4]
            if picture_loops.whiten_triples(grams, e, limits.square, limits.ratio, limits.inflation, white):
                return white.astype(np.float32), None
        return NumpyBackprop.whitened(grams, e)
