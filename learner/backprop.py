"""A hand-written forward and backward for sequences of Linear, Conv2d, ReLU and Flatten, without autograd."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor, nn


class UnsupportedLayerError(ValueError):
    """A network holds something that is neither Linear, Conv2d, ReLU nor Flatten; the message names it."""


@dataclass(slots=True)
class Tape:
    """What one forward pass leaves behind for the backward passes.

    output: [batch, actions]. saved: per step of the chain, the input of a Linear or Conv2d, the output of a ReLU,
    the shape that a Flatten removed (as an empty view of its input).
    """

    output: Tensor
    saved: list[Tensor]


class Chain:
    """The steps of a network, checked once, with the three products that backpropagation is made of."""

    def __init__(self, network: nn.Module) -> None:
        """Raises UnsupportedLayerError for any other layer, and for options of a known one that are not handled."""
        self.steps = list(_leaves(network, ""))
        seen: set[int] = set()
        for name, step in self.steps:
            _check(name, step)
            if isinstance(step, nn.Linear | nn.Conv2d) and id(step) in seen:
                raise UnsupportedLayerError(f"layer {name!r} appears twice; shared layers are not handled")
            seen.add(id(step))

    def forward(self, x: Tensor) -> Tape:
        """Run the network on x [batch, *input] and keep what `backward` needs."""
        saved: list[Tensor] = []
        with torch.no_grad():
            for _, step in self.steps:
                y: Tensor = torch.relu(x) if isinstance(step, nn.ReLU) else step(x)
                saved.append(y if isinstance(step, nn.ReLU) else x)
                x = y
        return Tape(x, saved)

    def pull(self, tape: Tape, index: int, cotangent: Tensor) -> Tensor:
        """Send a cotangent of step `index`'s output to its input.

        cotangent: [rows, *output] with rows = batch * k, the k cotangents of a sample next to each other.
        """
        step, kept = self.steps[index][1], tape.saved[index]
        if isinstance(step, nn.Linear):
            return cotangent @ step.weight.detach()
        if isinstance(step, nn.Conv2d):
            rows = kept.new_empty(1).expand(len(cotangent), *kept.shape[1:])
            return _convolution_backward(step, cotangent, rows, (True, False, False))[0]
        if isinstance(step, nn.ReLU):
            per_sample = cotangent.view(len(kept), -1, *kept.shape[1:])
            return (per_sample * (kept > 0).unsqueeze(1)).view(cotangent.shape)
        return cotangent.reshape(len(cotangent), *kept.shape[1:])

    def write(self, tape: Tape, index: int, delta: Tensor, out: Mapping[str, Tensor]) -> None:
        """Write the gradients of step `index`'s parameters, given delta [batch, *output] at its pre-activation."""
        name, step = self.steps[index]
        h = tape.saved[index]
        if isinstance(step, nn.Linear):
            torch.mm(delta.t(), h, out=out[f"{name}weight"])
            if step.bias is not None:
                torch.sum(delta, 0, out=out[f"{name}bias"])
        elif isinstance(step, nn.Conv2d):
            _, weight, bias = _convolution_backward(step, delta, h, (False, True, step.bias is not None))
            out[f"{name}weight"].copy_(weight)
            if step.bias is not None:
                out[f"{name}bias"].copy_(bias)

    def backward(self, tape: Tape, error: Tensor, out: Mapping[str, Tensor]) -> None:
        """Write the gradient of error . output into `out`: error [batch, actions], one tensor per named parameter."""
        first = self.parametrised[0]
        for index in range(len(self.steps) - 1, first - 1, -1):
            self.write(tape, index, error, out)
            if index > first:
                error = self.pull(tape, index, error)

    @property
    def parametrised(self) -> list[int]:
        """Indices of the steps that hold parameters, in order."""
        return [i for i, (_, step) in enumerate(self.steps) if isinstance(step, nn.Linear | nn.Conv2d)]


def _leaves(module: nn.Module, prefix: str) -> list[tuple[str, nn.Module]]:
    """(parameter-name prefix, layer) in order; nested Sequentials are walked through."""
    if not isinstance(module, nn.Sequential):
        return [(prefix, module)]
    return [leaf for name, child in module._modules.items() for leaf in _leaves(child, f"{prefix}{name}.")]


def _check(name: str, step: nn.Module) -> None:
    kind = type(step).__name__
    if not isinstance(step, nn.Linear | nn.Conv2d | nn.ReLU | nn.Flatten):
        raise UnsupportedLayerError(
            f"layer {name.rstrip('.')!r} is a {kind}; handled are Linear, Conv2d, ReLU and Flatten"
        )
    if isinstance(step, nn.Flatten) and (step.start_dim, step.end_dim) != (1, -1):
        raise UnsupportedLayerError(f"layer {name.rstrip('.')!r}: Flatten must start at dimension 1 and end at -1")
    if isinstance(step, nn.Conv2d) and (step.padding_mode != "zeros" or isinstance(step.padding, str)):
        raise UnsupportedLayerError(f"layer {name.rstrip('.')!r}: Conv2d padding must be zeros of a given size")


def _convolution_backward(
    conv: nn.Conv2d, delta: Tensor, h: Tensor, mask: tuple[bool, bool, bool]
) -> tuple[Tensor, Tensor, Tensor]:
    result: tuple[Tensor, Tensor, Tensor] = torch.ops.aten.convolution_backward(
        delta, h, conv.weight.detach(), [conv.out_channels], conv.stride, conv.padding, conv.dilation,
        False, [0, 0], conv.groups, list(mask),
    )  # fmt: skip
    return result
