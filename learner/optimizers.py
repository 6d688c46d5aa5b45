"""Optimizers over one flat parameter array: each tensor operation is called once for the whole network.

With a small network, the bookkeeping of `torch.optim` costs more than its arithmetic, which is the same here.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Generic

import torch
from torch import Tensor

from coop.common.settings.config import LearnerSettings
from coop.learner.edl import kernels
from coop.learner.edl.arrays import ArrayT, Namespace, assign, namespace

TINY = 1e-37  # below any square that matters, above the denormals


@dataclass(eq=False)
class Optimizer(ABC, Generic[ArrayT]):
    """Moves parameters theta against their gradient g.

    theta, gradient: float32 [P], of PyTorch or numpy, read and written in place. buffers: running means by name,
    float32 [P]. steps: number of steps taken. PyTorch has fused operations, numpy has not.

    On a GPU a step needs nothing of the host: the rate may be a tensor, and the steps are counted on the device too.
    """

    theta: ArrayT
    gradient: ArrayT
    buffers: dict[str, ArrayT] = field(init=False)
    steps: int = field(init=False, default=0)
    _count: Tensor | None = field(init=False, default=None)
    _xp: Namespace[ArrayT] = field(init=False)
    _scratch: ArrayT = field(init=False)

    def __post_init__(self) -> None:
        """Start all running means at 0."""
        self._xp = namespace(self.theta)
        self.buffers = {name: self._xp.zeros_like(self.gradient) for name in self._means()}
        self._scratch = self._xp.zeros_like(self.gradient)
        if isinstance(self.theta, Tensor) and self.theta.is_cuda:
            self._count = torch.zeros((), device=self.theta.device)

    def step(self, rate: float | Tensor) -> None:
        """Apply one update with learning rate `rate`, a number, or a tensor of one on theta's device."""
        self.steps += 1
        if self._count is not None:
            self._count += 1
            self._step(rate)
            return
        # Running means of parameters without gradient become denormals, with which an update takes 30 times as long.
        # PyTorch sets the processor's mode, which is numpy's too.
        torch.set_flush_denormal(True)
        try:
            self._step(rate)
        finally:
            torch.set_flush_denormal(False)

    @abstractmethod
    def _means(self) -> Sequence[str]:
        """The names of the running means."""

    @abstractmethod
    def _step(self, rate: float | Tensor) -> None: ...

    def state(self) -> dict[str, Tensor | int]:
        """The state for `load_state`; torch.load reads it with weights_only."""
        copies = {name: torch.as_tensor(buffer).cpu().clone() for name, buffer in self.buffers.items()}
        return {"steps": self.steps, **copies}

    def load_state(self, state: dict[str, Tensor | int]) -> None:
        """Restore a state from `state`."""
        self.steps = int(state["steps"])
        if self._count is not None:
            self._count.fill_(self.steps)
        for name, buffer in self.buffers.items():
            assign(buffer, torch.as_tensor(state[name]))

    def _average(self, name: str, decay: float) -> ArrayT:
        """Update the running mean `name` of g: x <- decay x + (1 - decay) g."""
        buffer: ArrayT = self.buffers[name]
        if isinstance(buffer, Tensor):
            return buffer.lerp_(self.gradient, 1 - decay)
        buffer *= decay
        buffer += self._xp.multiply(self.gradient, 1 - decay, out=self._scratch)
        return buffer

    def _average_square(self, decay: float) -> ArrayT:
        """Update the running mean "square" of g^2: v <- decay v + (1 - decay) g^2."""
        square: ArrayT = self.buffers["square"]
        square *= decay
        if isinstance(square, Tensor):
            return square.addcmul_(self.gradient, self.gradient, value=1 - decay)
        scratch: ArrayT = self._xp.multiply(self.gradient, self.gradient, out=self._scratch)
        scratch *= 1 - decay
        square += scratch
        return square

    def _descend(self, direction: ArrayT, rate: float | Tensor, denominator: ArrayT | None = None) -> None:
        """Apply theta <- theta - rate direction / denominator; both arguments may be in the scratch memory."""
        if isinstance(self.theta, Tensor):
            if isinstance(rate, Tensor):
                if denominator is not None:
                    direction = torch.div(direction, denominator, out=self._scratch)
                self.theta.addcmul_(direction, rate, value=-1)
            elif denominator is None:
                self.theta.add_(direction, alpha=-rate)
            else:
                self.theta.addcdiv_(direction, denominator, value=-rate)
        else:
            assert not isinstance(rate, Tensor)
            if denominator is not None:
                direction = self._xp.divide(direction, denominator, out=self._scratch)
            self.theta -= self._xp.multiply(direction, rate, out=self._scratch)

    def _variance(self, square: ArrayT, mean: ArrayT) -> ArrayT:
        """The variance square - mean^2 in the scratch memory."""
        if isinstance(square, Tensor):
            return torch.addcmul(square, mean, mean, value=-1, out=self._scratch)
        scratch: ArrayT = self._xp.multiply(mean, mean, out=self._scratch)
        return self._xp.subtract(square, scratch, out=scratch)

    def _root(self, square: ArrayT) -> ArrayT:
        """sqrt(square) in the scratch memory; avoids 0 and denormals, whose roots take many times as long."""
        scratch: ArrayT = self._xp.add(square, TINY, out=self._scratch)
        return self._xp.sqrt(scratch, out=scratch)


@dataclass(eq=False)
class SGD(Optimizer[ArrayT]):
    """m <- momentum m + g;  theta <- theta - rate m."""

    momentum: float

    def _means(self) -> Sequence[str]:
        return ["velocity"] if self.momentum else []

    def _step(self, rate: float | Tensor) -> None:
        moved: ArrayT = self.gradient
        if self.momentum:
            moved = self.buffers["velocity"]
            moved *= self.momentum
            moved += self.gradient
        self._descend(moved, rate)


@dataclass(eq=False)
class RMSProp(Optimizer[ArrayT]):
    """PyTorch's RMSprop: v <- alpha v + (1 - alpha) g^2;  u = g / (sqrt(v) + eps).

    Then theta <- theta - rate u; with momentum, m <- momentum m + u replaces u.
    """

    alpha: float
    eps: float
    momentum: float

    def _means(self) -> Sequence[str]:
        return ["square", "velocity"] if self.momentum else ["square"]

    def _step(self, rate: float | Tensor) -> None:
        root: ArrayT = self._root(self._average_square(self.alpha))
        root += self.eps
        if self.momentum:
            velocity: ArrayT = self.buffers["velocity"]
            velocity *= self.momentum
            if isinstance(velocity, Tensor):
                velocity.addcdiv_(self.gradient, root)
            else:
                velocity += self._xp.divide(self.gradient, root, out=root)
            self._descend(velocity, rate)
        else:
            self._descend(self.gradient, rate, root)


@dataclass(eq=False)
class MnihRMSProp(Optimizer[ArrayT]):
    """The RMSProp of Mnih et al. 2015: centred, with eps inside the square root.

    m <- gradient_alpha m + (1 - gradient_alpha) g;  v <- alpha v + (1 - alpha) g^2;
    theta <- theta - rate g / sqrt(max(v - m^2, 0) + eps). The variance v - m^2 is never negative if both constants
    are equal, as theirs are.
    """

    alpha: float
    eps: float
    gradient_alpha: float

    def _means(self) -> Sequence[str]:
        return ["square", "mean"]

    def _step(self, rate: float | Tensor) -> None:
        mean: ArrayT = self._average("mean", self.gradient_alpha)
        square = self._average_square(self.alpha)
        root: ArrayT = self._variance(square, mean)
        self._xp.clip(root, 0, None, out=root)
        root += self.eps
        self._descend(self.gradient, rate, self._xp.sqrt(root, out=root))


@dataclass(eq=False)
class Adam(Optimizer[ArrayT]):
    """Kingma & Ba 2015, after k steps.

    m <- beta1 m + (1 - beta1) g;  v <- beta2 v + (1 - beta2) g^2;
    theta <- theta - rate (m / (1 - beta1^k)) / (sqrt(v / (1 - beta2^k)) + eps).
    """

    betas: tuple[float, float]
    eps: float

    def _means(self) -> Sequence[str]:
        return ["mean", "square"]

    def _step(self, rate: float | Tensor) -> None:
        beta1, beta2 = self.betas
        if isinstance(self.theta, Tensor):
            # One pass over the memory; it takes a third of the time of the operations one by one.
            mean, square = self.buffers["mean"], self.buffers["square"]
            if kernels.usable(self.theta):
                kernels.adam(self.theta, self.gradient, mean, square, self._count, rate, self.betas, self.eps)
                return
            count = torch.tensor(float(self.steps)) if self._count is None else self._count
            torch._fused_adam_(
                [self.theta], [self.gradient], [mean], [square], [], [count],
                lr=rate, beta1=beta1, beta2=beta2, weight_decay=0.0, eps=self.eps, amsgrad=False, maximize=False,
            )  # fmt: skip
            return
        average: ArrayT = self._average("mean", beta1)
        correction = (1 - beta2**self.steps) ** 0.5
        root: ArrayT = self._root(self._average_square(beta2))
        root += self.eps * correction
        self._descend(average, rate * correction / (1 - beta1**self.steps), root)


def make_optimizer(settings: LearnerSettings, theta: ArrayT, gradient: ArrayT) -> Optimizer[ArrayT]:
    """The configured optimizer of parameters theta, float32 [P], and their gradient."""
    alpha, eps, momentum = settings.alpha, settings.eps, settings.momentum
    match settings.optimizer:
        case "sgd":
            return SGD(theta, gradient, momentum)
        case "rmsprop":
            return RMSProp(theta, gradient, alpha, eps, momentum)
        case "rmsprop-mnih":
            # Mnih's gradients are sums over the batch, these are means; this affects the update only through eps.
            return MnihRMSProp(theta, gradient, alpha, eps / settings.batch_size**2, settings.gradient_alpha)
        case "adam":
            return Adam(theta, gradient, (settings.beta1, settings.beta2), eps)
