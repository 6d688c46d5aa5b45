"""What a feedback does to gradient and step, layer by layer, measured on the batch of the last update."""

from __future__ import annotations

import torch
from torch import Tensor

from coop.studies.stacked import networks
from coop.studies.stacked.stack import COLUMNS, Stack

# By layer: the plain gradient's length; of the gradient as it is fed back, the length relative to it and the cosine
# with it; the same of the optimizer's step, relative to that with the plain gradient; means over the batch of the
# smallest and the largest singular value of T; the share of units that are 0 for the whole batch.
NAMES = (
    "gradient_norm", "gradient_ratio", "gradient_cosine", "step_ratio", "step_cosine", "least", "largest", "dead",
)  # fmt: skip
S = 0.1  # of the transform feedback, whose gradient stands for that of runs which follow the plain one
_TINY = 1e-30


def measure(stack: Stack) -> Tensor:
    """NAMES of every layer and run, float32 [len(NAMES), K, layers], nan for what the last layer lacks.

    Nothing of the runs changes. At least one update must be done.
    """
    settings, shape = stack.settings, stack.shape
    with torch.inference_mode():
        draws = stack.chance.draws(stack.step - 1, 1)
        role = settings.role(stack.updates - 1)
        batch = stack.table.index_select(0, draws.batch[0].view(-1)).view(*draws.batch[0].shape, COLUMNS)
        tape, error = stack.errors(batch, role)
        theta = stack.theta[role]
        deltas = networks.backward(shape, theta, tape, error)
        plain = networks.write_gradient(shape, tape, deltas, torch.zeros_like(stack.gradient))
        if settings.feedback in ("none", "matched"):
            s = torch.full_like(draws.s[0], S)
            sigmas = networks.error_driven(shape, theta, tape, error, s)
            driven = networks.write_gradient(shape, tape, sigmas, torch.zeros_like(plain))
        else:
            stack.feedback(tape, error, draws, 0, role)
            driven = stack.gradient
        steps = []
        for gradient in (plain, driven):
            parts = [
                networks.step_of(
                    settings, name, gradient[part], stack.mean[role, part].clone(), stack.square[role, part].clone(),
                    draws.corrections[0],
                )
                for name, part in stack.segments
            ]  # fmt: skip
            steps.append(torch.cat(parts))
        norm = shape.sums(plain.square()).sqrt()
        found = [norm, *_compared(stack, plain, driven), *_compared(stack, *steps)]
        nothing = torch.full_like(norm[:, :1], torch.nan)
        values = [_singular(t) for t in networks.transforms(shape, theta, tape)]
        for which in (0, 1):
            found.append(torch.cat([*(pair[which][:, None] for pair in values), nothing], 1))
        dead = [(h <= 0).all(1).float().mean(1, keepdim=True) for h in tape.h[1:]]
        return torch.stack([*found, torch.cat([*dead, nothing], 1)]).float()


def _compared(stack: Stack, one: Tensor, other: Tensor) -> tuple[Tensor, Tensor]:
    """By layer, [K, layers]: |other| / |one|, and their cosine."""
    shape = stack.shape
    first, second = shape.sums(one.square()).sqrt(), shape.sums(other.square()).sqrt()
    return second / first.clamp_min(_TINY), shape.sums(one * other) / (first * second).clamp_min(_TINY)


def _singular(t: Tensor) -> tuple[Tensor, Tensor]:
    """The means over the batch of T's smallest and largest singular value, T [K, batch, 2, n]: float64 [K] each."""
    t1, t2 = t.double().unbind(2)
    a, b, c = (t1 * t1).sum(-1), (t2 * t2).sum(-1), (t1 * t2).sum(-1)
    largest = (a + b + ((a - b).square() + 4 * c * c).sqrt()) / 2
    least = ((a * b - c * c) / largest.clamp_min(_TINY)).clamp_min(0)
    return least.sqrt().mean(1), largest.sqrt().mean(1)
