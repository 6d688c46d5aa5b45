"""Optimizers over one flat parameter array: each tensor operation is called once for the whole network.

With a small network, the bookkeeping of `torch.optim` costs more than its arithmetic, which is the same here.
"""

from __future__ import annotations

from abc import ABC, abstractmethod

import torch
from torch import Tensor

from common.settings.config import LearnerSettings
from learner.edl.arrays import Array, assign, namespace

_TINY = 1e-37  # below any square that matters, above the denormals


class Optimizer(ABC):
    """Moves parameters theta against their gradient g.

    theta, gradient: float32 [P], of PyTorch or numpy, read and written in place. buffers: running means by name,
    float32 [P]. steps: number of steps taken.
    """

    def __init__(self, theta: Array, gradient: Array, *buffers: str) -> None:
        self.theta, self.gradient = theta, gradient
        self._xp = namespace(theta)
        self._fused = self._xp is torch  # numpy has no fused operations
        self.buffers = {name: self._xp.zeros_like(gradient) for name in buffers}
        self._scratch = self._xp.zeros_like(gradient)
        self.steps = 0

    def step(self, rate: float) -> None:
        """Apply one update with learning rate `rate`."""
        self.steps += 1
        if not self._fused:
            self._step(rate)
            return
        # Running means of parameters without gradient become denormals, with which an update takes 30 times as long.
        torch.set_flush_denormal(True)
        try:
            self._step(rate)
        finally:
            torch.set_flush_denormal(False)

    @abstractmethod
    def _step(self, rate: float) -> None: ...

    def state(self) -> dict[str, Tensor | int]:
        """The state for `load_state`; torch.load reads it with weights_only."""
        copies = {name: torch.as_tensor(buffer).cpu().clone() for name, buffer in self.buffers.items()}
        return {"steps": self.steps, **copies}

    def load_state(self, state: dict[str, Tensor | int]) -> None:
        """Restore a state from `state`."""
        self.steps = int(state["steps"])
        for name, buffer in self.buffers.items():
            assign(buffer, torch.as_tensor(state[name]))

    def _average(self, name: str, decay: float) -> Array:
        """Update the running mean `name` of g: x <- decay x + (1 - decay) g."""
        buffer = self.buffers[name]
        if self._fused:
            return buffer.lerp_(self.gradient, 1 - decay)
        buffer *= decay
        buffer += self._xp.multiply(self.gradient, 1 - decay, out=self._scratch)
        return buffer

    def _average_square(self, decay: float) -> Array:
        """Update the running mean "square" of g^2: v <- decay v + (1 - decay) g^2."""
        square = self.buffers["square"]
        square *= decay
        if self._fused:
            return square.addcmul_(self.gradient, self.gradient, value=1 - decay)
        scratch = self._xp.multiply(self.gradient, self.gradient, out=self._scratch)
        scratch *= 1 - decay
        square += scratch
        return square

    def _descend(self, direction: Array, rate: float, denominator: Array | None = None) -> None:
        """Apply theta <- theta - rate direction / denominator; both arguments may be in the scratch memory."""
        if denominator is None and self._fused:
            self.theta.add_(direction, alpha=-rate)
        elif denominator is None:
            self.theta -= self._xp.multiply(direction, rate, out=self._scratch)
        elif self._fused:
            self.theta.addcdiv_(direction, denominator, value=-rate)
        else:
            self._descend(self._xp.divide(direction, denominator, out=self._scratch), rate)

    def _variance(self, square: Array, mean: Array) -> Array:
        """The variance square - mean^2 in the scratch memory."""
        if self._fused:
            return self._xp.addcmul(square, mean, mean, value=-1, out=self._scratch)
        scratch = self._xp.multiply(mean, mean, out=self._scratch)
        return self._xp.subtract(square, scratch, out=scratch)

    def _root(self, square: Array) -> Array:
        """sqrt(square) in the scratch memory; avoids 0 and denormals, whose roots take many times as long."""
        scratch = self._xp.add(square, _TINY, out=self._scratch)
        return self._xp.sqrt(scratch, out=scratch)


class SGD(Optimizer):
    """m <- momentum m + g;  theta <- theta - rate m."""

    def __init__(self, theta: Array, gradient: Array, momentum: float) -> None:
        super().__init__(theta, gradient, *(["velocity"] if momentum else []))
        self._momentum = momentum

    def _step(self, rate: float) -> None:
        moved = self.gradient
        if self._momentum:
            moved = self.buffers["velocity"]
            moved *= self._momentum
            moved += self.gradient
        self._descend(moved, rate)


class RMSProp(Optimizer):
    """PyTorch's RMSprop: v <- alpha v + (1 - alpha) g^2;  u = g / (sqrt(v) + eps).

    Then theta <- theta - rate u; with momentum, m <- momentum m + u replaces u.
    """

    def __init__(self, theta: Array, gradient: Array, alpha: float, eps: float, momentum: float) -> None:
        super().__init__(theta, gradient, "square", *(["velocity"] if momentum else []))
        self._alpha, self._eps, self._momentum = alpha, eps, momentum

    def _step(self, rate: float) -> None:
        root = self._root(self._average_square(self._alpha))
        root += self._eps
        if self._momentum:
            velocity = self.buffers["velocity"]
            velocity *= self._momentum
            if self._fused:
                velocity.addcdiv_(self.gradient, root)
            else:
                velocity += self._xp.divide(self.gradient, root, out=root)
            self._descend(velocity, rate)
        else:
            self._descend(self.gradient, rate, root)


class MnihRMSProp(Optimizer):
    """The RMSProp of Mnih et al. 2015: centred, with eps inside the square root.

    m <- gradient_alpha m + (1 - gradient_alpha) g;  v <- alpha v + (1 - alpha) g^2;
    theta <- theta - rate g / sqrt(max(v - m^2, 0) + eps). The variance v - m^2 is never negative if both constants
    are equal, as theirs are.
    """

    def __init__(self, theta: Array, gradient: Array, alpha: float, eps: float, gradient_alpha: float) -> None:
        super().__init__(theta, gradient, "square", "mean")
        self._alpha, self._eps, self._gradient_alpha = alpha, eps, gradient_alpha

    def _step(self, rate: float) -> None:
        mean = self._average("mean", self._gradient_alpha)
        square = self._average_square(self._alpha)
        root = self._variance(square, mean)
        self._xp.clip(root, 0, None, out=root)
        root += self._eps
        self._descend(self.gradient, rate, self._xp.sqrt(root, out=root))


class Adam(Optimizer):
    """Kingma & Ba 2015, after k steps.

    m <- beta1 m + (1 - beta1) g;  v <- beta2 v + (1 - beta2) g^2;
    theta <- theta - rate (m / (1 - beta1^k)) / (sqrt(v / (1 - beta2^k)) + eps).
    """

    def __init__(self, theta: Array, gradient: Array, betas: tuple[float, float], eps: float) -> None:
        super().__init__(theta, gradient, "mean", "square")
        self._betas, self._eps = betas, eps

    def _step(self, rate: float) -> None:
        beta1, beta2 = self._betas
        mean = self._average("mean", beta1)
        correction = (1 - beta2**self.steps) ** 0.5
        root = self._root(self._average_square(beta2))
        root += self._eps * correction
        self._descend(mean, rate * correction / (1 - beta1**self.steps), root)


def make_optimizer(settings: LearnerSettings, theta: Array, gradient: Array) -> Optimizer:
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
