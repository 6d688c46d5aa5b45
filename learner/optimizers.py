"""Optimizers over one flat parameter: one call of each tensor operation for the whole network, and no bookkeeping.

With a small network, the bookkeeping of `torch.optim` costs more than its arithmetic; the arithmetic here is the same.
"""

from __future__ import annotations

from abc import ABC, abstractmethod

import torch
from torch import Tensor

from common.config import LearnerSettings

_TINY = 1e-37  # below any square that counts, above the denormals


class Optimizer(ABC):
    """Moves parameters theta against their gradient g.

    theta, gradient: float32 [P], read and written in place. buffers: running means by name, float32 [P]. steps: taken.
    """

    def __init__(self, theta: Tensor, gradient: Tensor, *buffers: str) -> None:
        self.theta, self.gradient = theta.detach(), gradient
        self.buffers = {name: torch.zeros_like(gradient) for name in buffers}
        self.steps = 0

    def step(self, rate: float) -> None:
        """Apply one update with learning rate `rate`."""
        self.steps += 1
        self._step(rate)

    @abstractmethod
    def _step(self, rate: float) -> None: ...

    def state(self) -> dict[str, Tensor | int]:
        """What `load_state` needs; loads with weights_only."""
        return {"steps": self.steps, **{name: buffer.cpu().clone() for name, buffer in self.buffers.items()}}

    def load_state(self, state: dict[str, Tensor | int]) -> None:
        """Go on where `state` was taken."""
        self.steps = int(state["steps"])
        for name, buffer in self.buffers.items():
            buffer.copy_(torch.as_tensor(state[name]))


def _root(square: Tensor, out: Tensor) -> Tensor:
    """sqrt(square) in `out`, for values >= 0: by rsqrt, since sqrt takes many times as long for 0 and denormals."""
    return torch.add(square, _TINY, out=out).rsqrt_().mul_(square)


class SGD(Optimizer):
    """m <- momentum m + g;  theta <- theta - rate m."""

    def __init__(self, theta: Tensor, gradient: Tensor, momentum: float) -> None:
        super().__init__(theta, gradient, *(["velocity"] if momentum else []))
        self._momentum = momentum

    def _step(self, rate: float) -> None:
        if self._momentum:
            velocity = self.buffers["velocity"].mul_(self._momentum).add_(self.gradient)
            self.theta.sub_(velocity, alpha=rate)
        else:
            self.theta.sub_(self.gradient, alpha=rate)


class RMSProp(Optimizer):
    """PyTorch's: v <- decay v + (1 - decay) g^2;  u = g / (sqrt(v) + constant).

    Then theta <- theta - rate u; with momentum, m <- momentum m + u takes the place of u.
    """

    def __init__(self, theta: Tensor, gradient: Tensor, decay: float, constant: float, momentum: float) -> None:
        super().__init__(theta, gradient, "square", *(["velocity"] if momentum else []))
        self._decay, self._constant, self._momentum = decay, constant, momentum
        self._scratch = torch.empty_like(gradient)

    def _step(self, rate: float) -> None:
        g = self.gradient
        square = self.buffers["square"].mul_(self._decay).addcmul_(g, g, value=1 - self._decay)
        root = _root(square, self._scratch).add_(self._constant)
        if self._momentum:
            velocity = self.buffers["velocity"].mul_(self._momentum).addcdiv_(g, root)
            self.theta.sub_(velocity, alpha=rate)
        else:
            self.theta.addcdiv_(g, root, value=-rate)


class MnihRMSProp(Optimizer):
    """Mnih et al. 2015: centred, with the constant inside the root.

    m <- momentum m + (1 - momentum) g;  v <- decay v + (1 - decay) g^2;
    theta <- theta - rate g / sqrt(v - m^2 + constant).
    """

    def __init__(self, theta: Tensor, gradient: Tensor, decay: float, constant: float, momentum: float) -> None:
        super().__init__(theta, gradient, "square", "mean")
        self._decay, self._constant, self._momentum = decay, constant, momentum
        self._scratch = torch.empty_like(gradient)

    def _step(self, rate: float) -> None:
        g = self.gradient
        mean = self.buffers["mean"].lerp_(g, 1 - self._momentum)
        square = self.buffers["square"].mul_(self._decay).addcmul_(g, g, value=1 - self._decay)
        inverse = torch.addcmul(square, mean, mean, value=-1, out=self._scratch).add_(self._constant).rsqrt_()
        self.theta.addcmul_(g, inverse, value=-rate)


class Adam(Optimizer):
    """Kingma & Ba 2015, after k steps.

    m <- b1 m + (1 - b1) g;  v <- b2 v + (1 - b2) g^2;
    theta <- theta - rate (m / (1 - b1^k)) / (sqrt(v / (1 - b2^k)) + constant).
    """

    def __init__(self, theta: Tensor, gradient: Tensor, decays: tuple[float, float], constant: float) -> None:
        super().__init__(theta, gradient, "mean", "square")
        self._decays, self._constant = decays, constant
        self._scratch = torch.empty_like(gradient)

    def _step(self, rate: float) -> None:
        g, (first, second) = self.gradient, self._decays
        mean = self.buffers["mean"].lerp_(g, 1 - first)
        square = self.buffers["square"].mul_(second).addcmul_(g, g, value=1 - second)
        correction = (1 - second**self.steps) ** 0.5
        root = _root(square, self._scratch).add_(self._constant * correction)
        self.theta.addcdiv_(mean, root, value=-rate * correction / (1 - first**self.steps))


def make_optimizer(settings: LearnerSettings, theta: Tensor, gradient: Tensor) -> Optimizer:
    """The configured optimizer of parameters theta, float32 [P], and their gradient."""
    decay, constant, momentum = settings.squared_decay, settings.denominator, settings.momentum
    match settings.optimizer:
        case "sgd":
            return SGD(theta, gradient, momentum)
        case "rmsprop":
            return RMSProp(theta, gradient, decay, constant, momentum)
        case "rmsprop-mnih":
            return MnihRMSProp(theta, gradient, decay, constant, momentum)
        case "adam":
            return Adam(theta, gradient, (momentum or 0.9, decay), constant)
