"""Modules of Linear layers and ReLUs as forward passes in numpy over their own parameters."""

from __future__ import annotations

import torch
from torch import nn

from coop.common.networks.forward import DenseForward

DTYPES = (torch.float32, torch.float64)


class Dense(DenseForward):
    """The forward pass of such a module."""

    def __init__(self, module: nn.Module) -> None:
        """`module` must fit (see `fits`)."""
        layers = [(name, step) for name, step in module.named_children() if isinstance(step, nn.Linear | nn.Conv2d)]
        super().__init__(
            [f"{name}." for name, _ in layers],
            [step.weight.detach().flatten(1).numpy() for _, step in layers],
            [step.bias.detach().numpy()[:, None] for _, step in layers if step.bias is not None],
        )

    @staticmethod
    def fits(module: nn.Module) -> bool:
        """Whether a network is Linear, ReLU, Linear, ..., Linear with biases, in float32 or float64 on the CPU.

        No two layers may share a parameter.
        """
        steps = list(module) if type(module) is nn.Sequential else []
        kinds = [type(step) for step in steps]
        return (
            len(steps) % 2 == 1
            and kinds == ([nn.Linear, nn.ReLU] * len(steps))[: len(steps)]
            and all(isinstance(step.bias, torch.Tensor) for step in steps[::2])
            and len(list(module.parameters())) == len(steps) + 1
            and all(p.device.type == "cpu" and p.dtype in DTYPES for p in module.parameters())
        )
