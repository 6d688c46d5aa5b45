"""Error-driven learning: gradients with the feedback B(i) = U (S + s I) V^T in place of T(i) = U S V^T.

For one sample, T(i) = d y / d a(i) is the [actions, n_i] Jacobian of the output with respect to layer i's
pre-activation. Backpropagation sends delta(i) = T(i)^T e to layer i, EDL sends sigma(i) = B(i)^T e. With the
orthogonal polar factor P(i) = U V^T,

    B(i) = T(i) + s P(i),        P(i) = G(i)^(-1/2) T(i),        G(i) = T(i) T(i)^T,
    sigma(i) = T(i)^T (I + s G(i)^(-1/2)) e.

Other code calls `edl_gradients` and `feedback_matrices`. A learner keeps one `FeedbackRule` per network:

    rule = FeedbackRule(make_backprop(network, x), feedback="transform")
    tape = rule.backprop.forward(x)                # tape.output: [batch, actions]
    rule.backward(tape, error, s, out)          # overwrites out[name], e.g. FlatNetwork.gradients

With s = 0, or feedback "none", backward is plain backpropagation and costs one gradient.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from functools import partial
from typing import Any, Generic

import numpy as np
import torch
from torch import Tensor, nn

from coop.common.process.memory import keep_freed_memory
from coop.learner.edl.arrays import ArrayT, at_least_float32, convert_like
from coop.learner.edl.backprop import Backprop, Tape
from coop.learner.edl.branches import Branches
from coop.learner.edl.layers import make_backprop
from coop.learner.edl.polar import polar, polar_of_product
from coop.learner.edl.transforms import Transforms

FEEDBACKS = ("none", "transform", "weight-gradient", "random")


class FeedbackRule(Generic[ArrayT]):
    """The backward pass of one network under one feedback.

    backprop: the passes of the network, in PyTorch or in numpy; all arrays are of the same library.
    feedback: "none" (backpropagation), "transform" (the equations above), "weight-gradient" (backpropagation, then
        U (S + s I) V^T of each weight gradient; biases plain) or "random" (fixed B(i), direct feedback alignment).
    seed: of the fixed matrices of "random".
    rng: draws the completion of rank-deficient gradients for "weight-gradient" (default: a generator from `seed`).
    """

    backprop: Backprop[ArrayT]

    def __init__(
        self,
        backprop: Backprop[ArrayT],
        feedback: str = "transform",
        seed: int = 0,
        rng: np.random.Generator | None = None,
    ) -> None:
        if feedback not in FEEDBACKS:
            raise ValueError(f"feedback: {feedback!r} is not one of {', '.join(FEEDBACKS)}")
        keep_freed_memory()
        self.backprop = backprop
        self.feedback = feedback
        self._seed = seed
        self._rng = rng or np.random.default_rng(seed)
        self._fixed: dict[int, ArrayT] = {}

    def backward(self, tape: Tape[ArrayT], error: ArrayT, s: Any, out: Mapping[str, ArrayT]) -> None:  # noqa: ANN401
        """Write one gradient per named parameter into `out`.

        tape: of the backprop's forward pass. error: [batch, actions], the output error e, already divided by the batch
        size. s: the exploration rate, a number, or a tensor of one on the network's device, whose value then decides
        nothing. The caller disables autograd and numpy's warnings of non-finite values.
        """
        branches = Branches(error)  # of each layer's parameters beside the others and what passes between layers
        for index, delta in self._feedback(tape, error, s):
            branches.run(partial(self.backprop.write_gradients, tape, index, delta, out), delta)
            if self.feedback == "weight-gradient" and _given(s):
                gradient = out[self.backprop.names[index] + "weight"]
                # (weight-gradient)
                gradient += s * _polar_of_gradient(gradient, delta, tape.inputs[index], self._rng)
        branches.join()
        self.backprop.write_rest(tape, error, out)

    def _feedback(self, tape: Tape[ArrayT], error: ArrayT, s: Any) -> Iterator[tuple[int, ArrayT]]:  # noqa: ANN401
        """Yield (step, what it is sent [batch, *output of step])."""
        if self.feedback == "random":
            yield from ((index, self._aligned(tape, index, error)) for index in self.backprop.parametrised)
        elif self.feedback == "transform" and _given(s):  # sigma(i) = T(i)^T (I + s G(i)^(-1/2)) e
            yield from Transforms(self.backprop, tape).apply_feedback(error, s)
        else:
            yield from ((index, delta[:, 0]) for index, delta in self.backprop.cotangents(tape, error[:, None]))

    def _aligned(self, tape: Tape[ArrayT], index: int, error: ArrayT) -> ArrayT:
        """B(i)^T e with the fixed B(i) of layer `index`; that of a last layer is the identity, like T(d)."""
        shape = tape.output_of(index).shape
        if index == self.backprop.parametrised[-1] and math.prod(shape) == math.prod(error.shape):
            return error.reshape(shape)
        if index not in self._fixed:
            size = math.prod(shape[1:])
            layer = self.backprop.parametrised.index(index)
            generator = torch.Generator().manual_seed(self._seed * 1000 + layer)
            draw = torch.randn(error.shape[1], size, generator=generator, dtype=torch.float64) / math.sqrt(size)
            self._fixed[index] = convert_like(draw, error)
        # (random feedback)
        delta: ArrayT = (error @ self._fixed[index]).reshape(shape)
        return delta


def _given(s: Any) -> bool:  # noqa: ANN401
    """Whether there may be an s U V^T."""
    return isinstance(s, Tensor) or s != 0


def _polar_of_gradient(gradient: ArrayT, delta: ArrayT, h: ArrayT, rng: np.random.Generator) -> ArrayT:
    """U V^T of a weight gradient [m, ...]; for a Linear layer it is delta^T h, rank-deficient in a small batch."""
    matrix = torch.as_tensor(gradient).flatten(1)
    if h.ndim == 2 and len(delta) < min(matrix.shape):
        left, right = (at_least_float32(torch.as_tensor(rows)) for rows in (delta, h))
        factor = polar_of_product(left, right, rng)
    else:
        factor = polar(matrix, rng)
    return convert_like(factor.view(gradient.shape), gradient)


def edl_gradients(
    network: nn.Module,
    obs: Tensor,
    output_error: Tensor,
    s: float,
    feedback: str = "transform",
    *,
    seed: int = 0,
) -> dict[str, Tensor]:
    """One gradient per named parameter of `network`, in the parameter's shape and dtype.

    obs: float [batch, *input]. output_error: [batch, actions], e, already divided by the batch size. s: the
    exploration rate. feedback, seed: see FeedbackRule. Raises UnsupportedLayerError, which names the
    layer, for a network on which the feedback has no meaning.
    """
    backprop = make_backprop(network, None if feedback == "none" else obs)
    out = {name: torch.empty_like(p) for name, p in network.named_parameters()}
    with torch.no_grad():
        FeedbackRule(backprop, feedback, seed).backward(backprop.forward(obs), output_error, s, out)
    return out


def feedback_matrices(network: nn.Module, obs: Tensor, s: float) -> dict[str, Tensor]:
    """B(i) = U (S + s I) V^T of each layer, by name in forward order: [batch, actions, n_i].

    n_i counts layer i's pre-activations, in the order [channels, height, width] for a convolution.
    """
    backprop = make_backprop(network, obs)
    with torch.no_grad():
        found = Transforms(backprop, backprop.forward(obs)).matrices(s)
    return {backprop.names[index].removesuffix("."): b for index, b in reversed(found)}
