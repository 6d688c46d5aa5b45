"""Optimizers over one flat parameter: PyTorch's own, and the RMSProp of Mnih et al. 2015."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn

from common.config import LearnerSettings


class MnihRMSProp(torch.optim.Optimizer):
    """RMSProp as Mnih et al. 2015 ran it: centred, with the constant inside the root.

    m <- momentum m + (1 - momentum) g;  v <- decay v + (1 - decay) g^2;
    theta <- theta - lr g / sqrt(v - m^2 + constant).
    """

    def __init__(self, params: list[nn.Parameter], lr: float, momentum: float, decay: float, constant: float) -> None:
        super().__init__(params, {"lr": lr, "momentum": momentum, "decay": decay, "constant": constant})

    @torch.no_grad()
    def step(self, closure: Callable[[], float] | None = None) -> None:  # type: ignore[override]
        """Apply one update from `.grad`; `closure` is not used."""
        for group in self.param_groups:
            for theta in group["params"]:
                state = self.state[theta]
                if not state:
                    state["mean"], state["square"] = torch.zeros_like(theta), torch.zeros_like(theta)
                mean: Tensor = state["mean"]
                square: Tensor = state["square"]
                mean.lerp_(theta.grad, 1 - group["momentum"])
                square.mul_(group["decay"]).addcmul_(theta.grad, theta.grad, value=1 - group["decay"])
                root = torch.addcmul(square, mean, mean, value=-1).add_(group["constant"]).sqrt_()
                theta.addcdiv_(theta.grad, root, value=-group["lr"])


def make_optimizer(settings: LearnerSettings, flat: nn.Parameter) -> torch.optim.Optimizer:
    """The configured optimizer over one flat parameter."""
    rate, momentum, decay, constant = (
        settings.learning_rate,
        settings.momentum,
        settings.squared_decay,
        settings.denominator,
    )
    options: dict[str, Any]
    match settings.optimizer:
        case "sgd":
            return torch.optim.SGD([flat], rate, momentum=momentum)
        case "rmsprop":
            return torch.optim.RMSprop([flat], rate, alpha=decay, eps=constant, momentum=momentum, foreach=False)
        case "rmsprop-mnih":
            return MnihRMSProp([flat], rate, momentum, decay, constant)
        case "adam":
            options = {"betas": (momentum or 0.9, decay), "eps": constant, "fused": True}
            return torch.optim.Adam([flat], rate, **options)
