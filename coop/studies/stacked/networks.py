"""K networks of one shape as stacked tensors: passes, error-driven feedback in closed form, optimizers.

Networks are rows of theta, float32 [K, size]: the parameters in the product's order, and zeros up to a multiple of 32.
A layer i has T(i), float32 [K, batch, 2, n], the Jacobian of both actions' values in the basis of their sum and
difference, as `coop.learner.edl.transforms` has it.
"""

from __future__ import annotations

import math
from functools import cache
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from coop.learner.edl.polar import polar_by_svd, svd
from coop.studies.stacked.settings import StackSettings

ACTIONS, INPUTS = 2, 4
_HALF = 0.5**0.5
_RANK = 1e-12  # of det G / (|t_1|^2 |t_2|^2): below it, T counts as one of rank 1
_TINY = 1e-37  # below any square that matters, above the denormals


class LayerSlice(NamedTuple):
    """Where a layer lies in a row of theta: weight [outputs, inputs] from `start`, then bias; `stop` is behind it."""

    start: int
    outputs: int
    inputs: int
    stop: int


@cache
def shape_of(hidden: int, width: int) -> Shape:
    """The shape, always the same object."""
    return Shape(hidden, width)


class Shape:
    """The layers of a network of `hidden` equal layers, and the padded length of its row."""

    def __init__(self, hidden: int, width: int) -> None:
        self.hidden, self.width = hidden, width
        sizes = [INPUTS, *[width] * hidden, ACTIONS]
        self.layers: list[LayerSlice] = []
        start = 0
        for inputs, outputs in pairwise(sizes):
            stop = start + outputs * (inputs + 1)
            self.layers.append(LayerSlice(start, outputs, inputs, stop))
            start = stop
        self._counts: dict[torch.device, Tensor] = {}
        self.parameters = start
        self.size = -(-start // 32) * 32

    def views(self, theta: Tensor) -> list[tuple[Tensor, Tensor]]:
        """Weight [K, outputs, inputs] and bias [K, outputs] of each layer, as views."""
        return [
            (
                theta[:, at.start : at.stop - at.outputs].view(-1, at.outputs, at.inputs),
                theta[:, at.stop - at.outputs : at.stop],
            )
            for at in self.layers
        ]

    def counts(self, device: torch.device) -> Tensor:
        """Parameters of each layer: int64 [layers]."""
        if device not in self._counts:
            self._counts[device] = torch.tensor([at.stop - at.start for at in self.layers], device=device)
        return self._counts[device]

    def by_layer(self, values: Tensor) -> Tensor:
        """A value for each layer, [K, layers], as one for each parameter: [K, size]; 0 behind the parameters."""
        wide = values.repeat_interleave(self.counts(values.device), 1, output_size=self.parameters)
        return torch.nn.functional.pad(wide, (0, self.size - self.parameters))

    def sums(self, values: Tensor) -> Tensor:
        """The sum of each layer's part of [K, size]: [K, layers]."""
        return torch.stack([values[:, at.start : at.stop].sum(1) for at in self.layers], 1)

    @cache  # noqa: B019 (some megabytes, wanted until the end)
    def initial(self, seed: int, number: int) -> Tensor:
        """The parameters with which lockstep begins network `number` of a run, float32 [size]."""
        words = np.random.SeedSequence([seed, number]).generate_state(1)
        flat = torch.zeros(self.size)
        with torch.random.fork_rng(devices=[]):
            torch.default_generator.manual_seed(int(words[0]))
            layers = [nn.Linear(at.inputs, at.outputs) for at in self.layers]
        parts = [p.detach().reshape(-1) for layer in layers for p in (layer.weight, layer.bias)]
        torch.cat(parts, out=flat[: self.parameters])
        return flat


class StackTape(NamedTuple):
    """A forward pass: h [K, batch, n] of the input and of each hidden layer, and the values [K, batch, 2]."""

    h: list[Tensor]
    values: Tensor


def forward(shape: Shape, theta: Tensor, x: Tensor) -> StackTape:
    """Run the networks theta [K, size] on x, float32 [K, batch, 4]."""
    h = [x]
    for weight, bias in shape.views(theta)[:-1]:
        h.append(torch.baddbmm(bias[:, None], h[-1], weight.mT).relu_())
    weight, bias = shape.views(theta)[-1]
    return StackTape(h, torch.baddbmm(bias[:, None], h[-1], weight.mT))


def td_errors(settings: StackSettings, batch: Tensor, values: Tensor, chosen: Tensor, target: Tensor) -> Tensor:
    """E of each action taken, float32 [K, batch], by the product's `coop.learner.losses`.

    batch: float32 [K, batch, 10] of the table. values, chosen, target: [K, batch, 2], Q(x), the values that choose the
    next action, and those that it gets.
    """
    best = torch.where(chosen[..., 1] > chosen[..., 0], target[..., 1], target[..., 0])
    if settings.value_bound is not None:
        best = best.clamp(-settings.value_bound, settings.value_bound)
    taken = torch.where(batch[..., 8] > 0, values[..., 1], values[..., 0])
    return taken - (1.0 + settings.gamma * (1 - batch[..., 9]) * best)


def output_error(settings: StackSettings, errors: Tensor, actions: Tensor) -> Tensor:
    """The gradient of the mean loss with respect to the outputs, float32 [K, batch, 2]."""
    match settings.loss:
        case "mse":
            errors = 2 * errors
        case "huber":
            errors = errors.clamp(-1, 1)
    errors = errors / errors.shape[1]
    return torch.stack((errors * (actions == 0), errors * (actions > 0)), -1)


class White(NamedTuple):
    """The polar factor's part of the feedback, (U V^T)^T e = w_1 t_1 + w_2 t_2 + x_1 u_1 + x_2 u_2, of one layer.

    w: float32 [K, batch, 2]. x: float32 [K, batch, 2], along the first two units: of a T that lacks rank, null
    directions go there. least: float64 [K, batch], T's smallest singular value.
    """

    w: Tensor
    x: Tensor
    least: Tensor


def whiten(t: Tensor, e: Tensor) -> White:
    """G^(-1/2) e for T, t float32 [K, batch, 2, n], and e float32 [K, batch, 2] in T's basis; in float64.

    No value decides which operations run.
    """
    t1, t2 = t.double().unbind(2)
    a, b, c = (t1 * t1).sum(-1), (t2 * t2).sum(-1), (t1 * t2).sum(-1)
    e1, e2 = e.double().unbind(-1)
    trace, det = a + b, a * b - c * c
    full = det > _RANK * a * b
    d = torch.where(full, det, 1.0).sqrt()
    scale = d * (trace + 2 * d).sqrt()
    # Rank 1 or 0: T = root v^T along the direction u of the actions, and v' completes it.
    largest = (trace + ((a - b).square() + 4 * c * c).sqrt()) / 2
    some = largest > 0
    u1, u2 = torch.where(a >= b, largest - b, c), torch.where(a >= b, c, largest - a)
    length = torch.where(some, (u1 * u1 + u2 * u2).sqrt(), 1.0)
    u1, u2 = torch.where(some, u1 / length, 1.0), u2 / length
    root = torch.where(some, largest, 1.0).sqrt()
    at1 = torch.where(some, (u1 * t1[..., 0] + u2 * t2[..., 0]) / root, 1.0)
    at2 = (u1 * t1[..., 1] + u2 * t2[..., 1]) / root
    first = at1.abs() <= at2.abs()  # v' is the unit vector of unit 1 or 2, less its part along v
    part = torch.where(first, at1, at2)
    null = (u1 * e2 - u2 * e1) / (1 - part * part).sqrt()
    along = (u1 * e1 + u2 * e2 - null * part) / root
    w1 = torch.where(full, ((b + d) * e1 - c * e2) / scale, torch.where(some, along * u1, 0.0))
    w2 = torch.where(full, ((a + d) * e2 - c * e1) / scale, torch.where(some, along * u2, 0.0))
    x1 = torch.where(full, 0.0, torch.where(first, null, 0.0) + torch.where(some, 0.0, e1))
    x2 = torch.where(full, 0.0, torch.where(first, 0.0, null))
    least = torch.where(full, det / largest, 0.0).clamp_min(0).sqrt()
    return White(torch.stack((w1, w2), -1).float(), torch.stack((x1, x2), -1).float(), least)


def backward(shape: Shape, theta: Tensor, tape: StackTape, error: Tensor) -> list[Tensor]:
    """Backpropagate: delta(i), float32 [K, batch, n], of each layer, first to last."""
    deltas = [error]
    for (weight, _), h in zip(shape.views(theta)[:0:-1], tape.h[:0:-1], strict=True):
        deltas.insert(0, torch.bmm(deltas[0], weight).mul_(h > 0))
    return deltas


def transforms(shape: Shape, theta: Tensor, tape: StackTape) -> list[Tensor]:
    """T(i), float32 [K, batch, 2, n], of each hidden layer, first to last."""
    views = shape.views(theta)
    last = views[-1][0] * _HALF
    t = torch.stack((last[:, 0] + last[:, 1], last[:, 0] - last[:, 1]), 1)[:, None]
    found: list[Tensor] = []
    for number in reversed(range(shape.hidden)):
        mask = (tape.h[number + 1] > 0)[:, :, None]
        t = t * mask
        found.insert(0, t)
        if number:
            t = torch.bmm(t.flatten(1, 2), views[number][0]).view(*t.shape[:3], -1)
    return found


def rotated(error: Tensor) -> Tensor:
    """An output error [K, batch, 2] in the basis of T."""
    return torch.stack((error[..., 0] + error[..., 1], error[..., 0] - error[..., 1]), -1) * _HALF


def polar_parts(ts: list[Tensor], error: Tensor) -> tuple[list[Tensor], list[White]]:
    """(U V^T)^T e of each hidden layer, and the algebra behind it; error [K, batch, 2], not rotated."""
    e = rotated(error)
    whites = [whiten(t, e) for t in ts]
    parts = []
    for t, white in zip(ts, whites, strict=True):
        part = (white.w[..., None] * t).sum(2)
        part[..., :2] += white.x
        parts.append(part)
    return parts, whites


def error_driven(shape: Shape, theta: Tensor, tape: StackTape, error: Tensor, s: Tensor) -> list[Tensor]:
    """sigma(i) = B(i)^T e of each layer, first to last, by the transform feedback; s: float32 [K]."""
    ts, scale = transforms(shape, theta, tape), s[:, None, None]
    parts, _ = polar_parts(ts, error)
    e = rotated(error)[..., None]
    plain = [(e * t).sum(2) for t in ts]
    return [delta + scale * part for delta, part in zip(plain, parts, strict=True)] + [error * (1 + scale)]


def aligned(fixed: Tensor, error: Tensor) -> list[Tensor]:
    """Direct feedback alignment: e B of each hidden layer, fixed float32 [K, hidden, 2, width], and e itself."""
    return [*torch.einsum("kba,klan->lkbn", error, fixed).unbind(0), error]


def write_gradient(shape: Shape, tape: StackTape, deltas: list[Tensor], out: Tensor) -> Tensor:
    """The sums of delta h^T and of delta over the batch, into out, float32 [K, size]."""
    for (weight, bias), delta, h in zip(shape.views(out), deltas, tape.h, strict=True):
        weight.copy_(torch.bmm(delta.mT, h))
        torch.sum(delta, 1, out=bias)
    return out


def fixed_feedback(shape: Shape, seed: int) -> Tensor:
    """The fixed matrices of the random feedback of one run, as the product draws them: float32 [hidden, 2, width]."""
    draws = []
    for layer in range(shape.hidden):
        generator = torch.Generator().manual_seed(seed * 1000 + layer)
        draws.append(torch.randn(ACTIONS, shape.width, generator=generator, dtype=torch.float64))
    return (torch.stack(draws) / math.sqrt(shape.width)).float()


def step_of(
    settings: StackSettings, optimizer: str, gradient: Tensor, mean: Tensor, square: Tensor, corrections: Tensor
) -> Tensor:
    """Update the running means in place and return the step per unit of learning rate, all float32 [K, size].

    corrections: float32 [2], Adam's two.
    """
    match optimizer:
        case "sgd":
            return gradient
        case "rmsprop":
            square.mul_(settings.alpha).addcmul_(gradient, gradient, value=1 - settings.alpha)
            return gradient / ((square + _TINY).sqrt_() + settings.eps)
        case _:
            mean.lerp_(gradient, 1 - settings.beta1)
            square.mul_(settings.beta2).addcmul_(gradient, gradient, value=1 - settings.beta2)
            return mean * corrections[0] / ((square + _TINY).sqrt_() + corrections[1])


def polar_of_gradient(delta: Tensor, h: Tensor, noise: Tensor) -> Tensor:
    """U V^T, float32 [K, m, n], of each weight gradient delta^T h, by the product's `coop.learner.edl.polar`.

    It is nan where a run's gradient is not finite: that run has diverged, those beside it go on.

    delta: [K, batch, m]. h: [K, batch, n]. noise: N(0, 1), [K, 2 max(m, n)], which pairs the null directions.
    """
    rows, m, n = delta.shape[1], delta.shape[2], h.shape[2]
    if rows >= min(m, n):
        return polar_by_svd(torch.bmm(delta.mT, h))
    diverged = ~(delta.isfinite().all(2).all(1) & h.isfinite().all(2).all(1))[:, None, None]
    delta, h = delta.masked_fill(diverged, 0), h.masked_fill(diverged, 0)
    q, upper = torch.linalg.qr(delta.mT.double(), mode="complete")
    p, lower = torch.linalg.qr(h.mT.double(), mode="complete")
    u, values, vh = svd(upper[:, :rows] @ lower[:, :rows].mT)
    rank = (values > torch.finfo(torch.float32).eps * values[:, :1]).sum(1, keepdim=True)
    short, long = min(m, n), max(m, n)
    place = torch.arange(long, device=delta.device)
    order = torch.where(place < rank, place - 1000.0, noise[:, :long]).argsort(1)[:, :short]
    sign = torch.where(place[:short] < rank, 1.0, noise[:, long : long + short].sign())
    paired = torch.zeros(len(delta), short, long, dtype=torch.float64, device=delta.device)
    paired.scatter_(2, order[..., None], sign.double()[..., None])
    core = paired if m <= n else paired.mT.contiguous()
    core[:, :rows] = u @ core[:, :rows]
    core[:, :, :rows] = core[:, :, :rows] @ vh
    whole: Tensor = q @ core @ p.mT
    return whole.float().masked_fill_(diverged, torch.nan)
