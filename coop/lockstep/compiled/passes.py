"""The updates of K networks side by side: lockstep's products for each run, and compiled loops between them.

Products are numpy's, as in lockstep, of the same matrices in the same order in memory; a block of runs passes through
all of them before the next one, so that what it reads stays in the processor's caches.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import torch
from numpy.typing import NDArray

from coop.common.settings.config import LearnerSettings
from coop.learner.agent import Agent
from coop.learner.edl.arrays import convert_like
from coop.learner.edl.polar import LIMITS, polar_by_svd
from coop.learner.edl.transforms import SUM_AND_DIFFERENCE
from coop.learner.optimizers import TINY, Adam, make_optimizer
from coop.lockstep.compiled import loops
from coop.lockstep.compiled.tables import Batches, Packing

Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]
Views = list[tuple[Floats, Floats]]
"""Weight [n, outputs, inputs] and bias [n, outputs] of each layer, first to last."""

BLOCK = 4  # runs that pass through an update together
LOSSES = {"squared": 0, "mse": 1, "huber": 2}
INPUTS, ACTIONS = 4, 2
PAGE = 1024  # numbers; loads and stores of arrays whose addresses differ by whole pages don't hold each other up


def loss_of(learner: LearnerSettings) -> tuple[np.float32, int]:
    """The bound of values and the loss, as `loops.temporal` has them."""
    return np.float32(learner.value_bound or 0), LOSSES[learner.loss]


def size_of(hidden: tuple[int, ...]) -> int:
    """Parameters of a network."""
    return sum((inputs + 1) * outputs for inputs, outputs in pairwise((INPUTS, *hidden, ACTIONS)))


def views_of(flat: Floats, hidden: tuple[int, ...]) -> Views:
    """The layers' parts of networks float32 [n, P], in the order of `FlatNetwork.layout`."""
    found: Views = []
    start = 0
    for inputs, outputs in pairwise((INPUTS, *hidden, ACTIONS)):
        middle = start + inputs * outputs
        weight = np.reshape(flat[:, start:middle], (-1, outputs, inputs), copy=False)
        start = middle + outputs
        found.append((weight, flat[:, middle:start]))
    return found


def pages(*shape: int) -> Floats:
    """Zeros that begin at a page."""
    count = math.prod(shape)
    room = np.zeros(count + PAGE, np.float32)
    start = -room.ctypes.data // 4 % PAGE
    return room[start : start + count].reshape(shape)


class Networks:
    """Both networks of K runs, with their optimizers.

    Attributes:
        theta: float32 [2, K, P], P rounded up to whole pages, zeros behind a network's parameters. buffers: the
            optimizers' running means by name, float32 [trained, K, P].
        steps: that each optimizer has taken.
        block: runs that pass through an update together. batches: theirs, for `update`.
    """

    block = BLOCK

    def __init__(self, agents: Sequence[Agent]) -> None:
        """Begin with the networks of these agents."""
        self._agents, count, config = list(agents), len(agents), agents[0].config
        self.config = config
        hidden, trained = config.network.hidden, 2 if config.two_networks else 1
        self._used = size_of(hidden)
        size = -(-self._used // PAGE) * PAGE
        self.theta = pages(2, count, size)
        self.steps = [0] * trained
        probe = make_optimizer(config.learner, self.theta[0, 0], self.theta[0, 0])
        self.buffers = {name: pages(trained, count, size) for name in probe.buffers}
        self._finite = np.ones(count, np.bool_)
        self._adam = isinstance(probe, Adam)
        self._gradient = pages(BLOCK, size)
        self._parts = views_of(self._gradient, hidden)
        self._views: dict[tuple[int, int, int], Views] = {}
        self._flats: dict[tuple[int, int, int], tuple[Floats, dict[str, Floats]]] = {}
        self.batches = Batches.room(Packing(agents[0].spec), BLOCK, config.learner.batch_size)
        self._make_buffers()
        learner, f = config.learner, np.float32
        self._loss = loss_of(learner)
        self._decays = f(learner.beta1), f(1 - learner.beta1), f(learner.beta2), f(1 - learner.beta2)
        self._limits = f(2 / LIMITS[4].inflation), f(LIMITS[4].square)
        self._basis = convert_like(SUM_AND_DIFFERENCE, self.theta)
        for k, agent in enumerate(agents):
            for number, network in enumerate(agent.networks):
                self.theta[number, k, : self._used] = network.flat.numpy()
            for number, optimizer in enumerate(agent.optimizers):
                self.steps[number] = optimizer.steps
                for name, buffer in self.buffers.items():
                    buffer[number, k, : self._used] = optimizer.buffers[name]

    def _make_buffers(self) -> None:
        """What an update of a block writes between its steps."""
        learner, hidden = self.config.learner, self.config.network.hidden
        batch = learner.batch_size

        def room(*shape: int) -> Floats:
            return np.zeros((BLOCK, *shape), np.float32)

        self._columns = [room(units, 2 * batch if learner.double else batch) for units in (*hidden, ACTIONS)]
        self._next = [room(units, batch) for units in (*hidden, ACTIONS)]
        self._h = [room(batch, units) for units in hidden]
        self._deltas = [room(batch, units) for units in hidden]
        self._error = room(ACTIONS, batch)
        if self.config.feedback == "transform":
            self._t = [room(ACTIONS, batch, units) for units in hidden]
            self._shared, self._e = room(ACTIONS, 1, hidden[-1]), room(batch, ACTIONS)
            shape = (len(hidden), BLOCK, batch)
            self._grams, self._weights = np.zeros((3, *shape), np.float32), np.zeros((*shape, ACTIONS), np.float32)
            self._doubtful = np.zeros(shape, np.bool_)

    def _layers(self, role: int, runs: slice) -> Views:
        """The parameters of a block of runs."""
        key = (role, runs.start, runs.stop)
        if key not in self._views:
            self._views[key] = views_of(self.theta[role, runs], self.config.network.hidden)
        return self._views[key]

    def _flat(self, role: int, runs: slice) -> tuple[Floats, dict[str, Floats]]:
        """The parameters of a block of runs as one array, and their optimizers' running means."""
        key = (role, runs.start, runs.stop)
        if key not in self._flats:
            means = {name: buffer[role, runs] for name, buffer in self.buffers.items()}
            self._flats[key] = self.theta[role, runs], means
        return self._flats[key]

    def values(self, role: int, runs: slice, obs: Floats, chosen: NDArray[np.int64]) -> Floats:
        """Q of one observation of each run, float32 [n, 4] -> [n, 2]; of all, whatever is chosen."""
        column = obs[:, :, None]
        layers = self._layers(role, runs)
        for number, (weight, bias) in enumerate(layers, 1):
            column = np.matmul(weight, column)
            (loops.rectify if number < len(layers) else loops.shift)(column, bias)
        return column[:, :, 0]

    def update(
        self,
        role: int,
        runs: slice,
        s: Doubles,
        rate: float,
        errors: Floats,
    ) -> bool:
        """Train network `role` of a block of runs with the batches given, towards the other one's targets.

        `batches` holds theirs. s: [n]. errors: the TD errors before the update, [n, batch], written. Returns whether
        all are finite.
        """
        n, size = errors.shape
        given = self.batches.first(n)
        layers, x, double = self._layers(role, runs), given.x, self.config.learner.double
        next_values = self._target(self._layers(1 - role, runs), x[:, size:])
        h = self._forward(layers, x if double else x[:, :size])
        values, error, gradient = self._columns[-1][:n], self._error[:n], self._gradient[:n]
        preferred = values[:, :, size:] if double else next_values
        finite = loops.temporal(
            values, next_values, preferred, given.taken, given.rewards, given.discounts, *self._loss, errors, error
        )  # fmt: skip
        parts = [(weight[:n], bias[:n]) for weight, bias in self._parts]
        if self.config.feedback == "transform" and s.any():
            self._driven(layers, h, error, s, parts)
        else:
            self._backward(layers, h, error, parts)
        self._descend(role, runs, gradient, rate)
        return bool(finite)

    def _forward(self, layers: Views, x: Floats) -> list[Floats]:
        """Fill the columns; return the input and the output of each hidden layer for the batch, [n, batch, units]."""
        n, column = len(x), x.swapaxes(1, 2)
        h = [x[:, : self.config.learner.batch_size]]
        for number, (weight, bias) in enumerate(layers):
            column = np.matmul(weight, column, out=self._columns[number][:n])
            if number < len(self._h):
                h.append(self._h[number][:n])
                loops.rectify_both(column, bias, h[-1])
            else:
                loops.shift(column, bias)
        return h

    def _target(self, layers: Views, x: Floats) -> Floats:
        """The values of next observations, [n, 2, batch]."""
        n, column = len(x), x.swapaxes(1, 2)
        for number, (weight, bias) in enumerate(layers):
            column = np.matmul(weight, column, out=self._next[number][:n])
            (loops.rectify if number < len(self._h) else loops.shift)(column, bias)
        return column

    def _backward(self, layers: Views, h: list[Floats], error: Floats, parts: Views) -> None:
        """Write the gradient into its parts; error [n, 2, batch]."""
        _last(error, h[-1], parts)
        rows = error.swapaxes(1, 2)
        for number in reversed(range(len(self._h))):
            delta = np.matmul(rows, layers[number + 1][0], out=self._deltas[number][: len(error)])
            weight, bias = parts[number]
            loops.masked(delta, h[number + 1], bias)
            np.matmul(delta.swapaxes(1, 2), h[number], out=weight)
            rows = delta

    def _driven(self, layers: Views, h: list[Floats], error: Floats, s: Doubles, parts: Views) -> None:
        """As `_backward`, with the transform feedback (see `coop.learner.edl.transforms`)."""
        n, last = len(error), len(self._h) - 1
        grams, weights, doubtful = self._grams[:, :, :n], self._weights[:, :n], self._doubtful[:, :n]
        shared = np.matmul(self._basis[:, None], layers[-1][0][:, None], out=self._shared[:n])
        ts: list[Floats] = [t[:n] for t in self._t]
        for place, number in enumerate(range(last, -1, -1)):
            t = ts[number]
            if number == last:
                loops.spread(shared, h[number + 1], t)
            else:
                np.matmul(ts[number + 1], layers[number + 1][0][:, None], out=t)
                loops.muted(t, h[number + 1])
            for row, (one, other) in enumerate(((0, 0), (1, 1), (0, 1))):
                np.vecdot(t[:, one], t[:, other], out=grams[row, place])
        e = np.matmul(error.swapaxes(1, 2), self._basis.T, out=self._e[:n])
        rates = s.astype(np.float32)
        doubt = loops.whiten(grams, e, rates, *self._limits, weights, doubtful)
        _last(error * (1 + s).astype(np.float32)[:, None, None], h[-1], parts)
        for place, number in enumerate(range(last, -1, -1)):
            t, delta, (weight, bias) = ts[number].swapaxes(1, 2), self._deltas[number][:n], parts[number]
            np.matmul(weights[place][:, :, None], t, out=delta[:, :, None])
            if doubt:
                for k in np.flatnonzero(doubtful[place].any(1)).tolist():
                    where = doubtful[place, k]
                    polar = polar_by_svd(torch.as_tensor(t[k][where])).numpy()
                    delta[k, where] += rates[k] * (e[k, where][:, None] @ polar)[:, 0]
            loops.summed(delta, bias)
            np.matmul(delta.swapaxes(1, 2), h[number], out=weight)

    def _descend(self, role: int, runs: slice, gradient: Floats, rate: float) -> None:
        """Take step number `steps` + 1 of the optimizers; `count` counts it."""
        learner, steps = self.config.learner, self.steps[role] + 1
        theta, means = self._flat(role, runs)
        if not self._adam:
            for k, (parameters, its) in enumerate(zip(theta, gradient, strict=True), runs.start):
                one = make_optimizer(learner, parameters, its)
                one.buffers = {name: buffer[role, k] for name, buffer in self.buffers.items()}
                one.step(rate)
            self._finite[runs] = np.isfinite(theta).all(1)
            return
        correction, f = (1 - learner.beta2**steps) ** 0.5, np.float32
        torch.set_flush_denormal(True)  # as the optimizers do
        try:
            loops.adam(
                theta, gradient, means["mean"], means["square"], *self._decays,
                f(TINY), f(learner.eps * correction), f(rate * correction / (1 - learner.beta1**steps)),
                self._finite[runs],
            )  # fmt: skip
        finally:
            torch.set_flush_denormal(False)

    def count(self, role: int) -> None:
        """Count an update of network `role` of every run."""
        self.steps[role] += 1

    def finite(self, role: int) -> NDArray[np.bool_]:
        """Whether network `role` of each run, the one trained last, is finite: bool [K]."""
        return self._finite

    def copy(self) -> None:
        """Copy the first network of each run to its second one."""
        self.theta[1] = self.theta[0]

    def save(self, k: int) -> None:
        """Write run k's networks into its agent."""
        for network, flat in zip(self._agents[k].networks, self.theta[:, k], strict=True):
            network.load(flat[: self._used])

    def save_means(self, k: int) -> None:
        """Write the state of run k's optimizers into its agent."""
        for number, optimizer in enumerate(self._agents[k].optimizers):
            means = {name: torch.from_numpy(buffer[number, k, : self._used]) for name, buffer in self.buffers.items()}
            optimizer.load_state({"steps": self.steps[number], **means})

    def kept(self, runs: NDArray[np.intp]) -> Networks:
        """The networks of these runs alone."""
        found = Networks([self._agents[k] for k in runs])
        found.theta[:] = self.theta[:, runs]
        for name, buffer in self.buffers.items():
            found.buffers[name][:] = buffer[:, runs]
        found.steps = self.steps
        return found


def _last(error: Floats, h: Floats, parts: Views) -> None:
    """Write the last layer's gradient: error [n, 2, batch], h [n, batch, units]."""
    weight, bias = parts[-1]
    np.matmul(error, h, out=weight)
    np.add.reduce(error, 2, out=bias)
