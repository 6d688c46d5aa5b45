"""A hand-written forward and backward for Linear, Conv2d, ReLU and Flatten in PyTorch, without autograd."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import torch
import torch.nn.functional as F  # noqa: N812 - the name that PyTorch itself uses
from torch import Tensor, nn

from coop.common.networks.folding import fold, folds, unfold
from coop.common.networks.network import layer_functions
from coop.learner.edl.backprop import Backprop, Tape, UnsupportedLayerError

Parametrised = nn.Linear | nn.Conv2d


class TorchBackprop(Backprop[Tensor]):
    """The steps of a network, checked once, and the products of backpropagation.

    names: prefix of the parameters' names of each step. parametrised: indices of the Linear and Conv2d steps.
    """

    def __init__(self, network: nn.Module) -> None:
        """Raise UnsupportedLayerError for any other layer, and for unsupported options of a known one."""
        leaves = list(_leaves(network, ""))
        for name, step in leaves:
            _check(name.removesuffix("."), step)
        self.names = [name for name, _ in leaves]
        self._steps = [step for _, step in leaves]
        self._functions = layer_functions(self._steps)
        # Looking up a module's attribute costs as much as a small product, so the parameters are kept here.
        self._weights = [step.weight if isinstance(step, Parametrised) else None for step in self._steps]
        self._biases = [step.bias if isinstance(step, Parametrised) else None for step in self._steps]
        self.parametrised = [i for i, weight in enumerate(self._weights) if weight is not None]
        held = sum(self._biases[i] is not None for i in self.parametrised) + len(self.parametrised)
        if not self.parametrised or len(list(network.parameters())) < held:
            raise UnsupportedLayerError("the network must hold parameters, and none twice")

    @property
    def output_weight(self) -> Tensor | None:
        """The weight [actions, n] of the last step, None if that is not Linear."""
        return self._weights[-1] if isinstance(self._steps[-1], nn.Linear) else None

    def forward(self, x: Tensor) -> Tape[Tensor]:
        """Run the network on x, float [batch, *input]."""
        inputs: list[Tensor] = []
        if x.dim() == 4:
            x = x.contiguous(memory_format=torch.channels_last)
        with torch.no_grad():
            for function in self._functions:
                inputs.append(x)
                x = function(x)
        return Tape(x, inputs)

    def cotangents(self, tape: Tape[Tensor], cotangent: Tensor) -> Iterator[tuple[int, Tensor]]:
        """Propagate cotangents of the output to every pre-activation: (step, [b, k, *output of step]), last first.

        cotangent: [b, k, actions], k cotangents for each sample; b is the batch, or 1 for cotangents that all samples
        share, and then stays 1 until a ReLU makes samples differ.
        """
        rows = cotangent
        fresh = False  # whether `rows` may be overwritten
        first = self.parametrised[0]
        for index in reversed(range(len(self._steps))):
            step, weight, h = self._steps[index], self._weights[index], tape.inputs[index]
            if weight is not None:
                yield index, rows
                if index == first:
                    return
                rows = _transposed(step, rows, weight, h) if isinstance(step, nn.Conv2d) else rows @ weight
                fresh = True
            elif isinstance(step, nn.ReLU):
                rows = _masked(rows, tape.output_of(index), fresh)
                fresh = True
            elif h.dim() == 4:
                pictures = rows.reshape(-1, *h.shape[1:]).contiguous(memory_format=torch.channels_last)
                rows = pictures.view(*rows.shape[:2], *h.shape[1:])
            else:
                rows = rows.view(*rows.shape[:2], *h.shape[1:])

    def write_gradients(self, tape: Tape[Tensor], index: int, delta: Tensor, out: Mapping[str, Tensor]) -> None:
        """Write the gradients of step `index`'s parameters, given delta [batch, *output] at its pre-activation."""
        step, bias, name = self._steps[index], self._biases[index], self.names[index]
        h = tape.inputs[index]
        if isinstance(step, nn.Linear):
            torch.mm(delta.t(), h, out=out[name + "weight"])
            if bias is not None:
                torch.sum(delta, 0, out=out[name + "bias"])
        elif isinstance(step, nn.Conv2d):
            weight, (down, across) = step.weight, step.stride
            folded = delta.is_cuda and folds(step, h.shape[3])
            if folded:
                h, weight = fold(h, across), fold(weight, across)
            _, weight_grad, bias_grad = torch.ops.aten.convolution_backward(
                delta, h, weight, [step.out_channels], (down, 1) if folded else step.stride, step.padding,
                step.dilation, False, [0, 0], step.groups, [False, True, bias is not None],
            )  # fmt: skip
            out[name + "weight"].copy_(unfold(weight_grad, across) if folded else weight_grad)
            if bias is not None:
                out[name + "bias"].copy_(bias_grad)


def _masked(rows: Tensor, activation: Tensor, in_place: bool) -> Tensor:
    """Propagate cotangents [b, k, *shape] through a ReLU whose output is `activation` [batch, *shape]."""
    if rows.shape[1] == 1 or rows.is_cuda:
        masked: Tensor = torch.ops.aten.threshold_backward(rows, activation.unsqueeze(1), 0)
        return masked
    mask = activation.sign().to(rows.dtype).unsqueeze(1)  # a ReLU's output is never negative
    return rows.mul_(mask) if in_place and rows.shape[0] == mask.shape[0] else rows * mask


def _transposed(conv: nn.Conv2d, rows: Tensor, weight: Tensor, h: Tensor) -> Tensor:
    """Propagate cotangents [b, k, *output] through a convolution of h [batch, *input]: [b, k, *input]."""
    spare = [
        h.shape[2 + i] + 2 * int(conv.padding[i]) - conv.dilation[i] * (conv.kernel_size[i] - 1) - 1
        - (rows.shape[3 + i] - 1) * conv.stride[i]
        for i in (0, 1)
    ]  # fmt: skip
    padding = [int(p) for p in conv.padding]
    pictures = F.conv_transpose2d(
        rows.flatten(0, 1), weight, None, conv.stride, padding, spare, conv.groups, conv.dilation
    )
    return pictures.view(*rows.shape[:2], *pictures.shape[1:])


def _leaves(module: nn.Module, prefix: str) -> Iterator[tuple[str, nn.Module]]:
    """Yield (prefix of parameter names, layer) in order, including those of nested Sequentials."""
    if type(module) is not nn.Sequential:  # a subclass may have a forward of its own
        yield prefix, module
        return
    for name, child in module._modules.items():
        if child is not None:
            yield from _leaves(child, f"{prefix}{name}.")


def _check(name: str, step: nn.Module) -> None:
    if type(step) not in (nn.Linear, nn.Conv2d, nn.ReLU, nn.Flatten):
        kind = type(step).__name__
        raise UnsupportedLayerError(f"layer {name!r} is a {kind}; handled are Linear, Conv2d, ReLU and Flatten")
    if isinstance(step, nn.Flatten) and (step.start_dim, step.end_dim) != (1, -1):
        raise UnsupportedLayerError(f"layer {name!r}: a Flatten must start at dimension 1 and end at -1")
    if isinstance(step, nn.Conv2d) and (step.padding_mode != "zeros" or isinstance(step.padding, str)):
        raise UnsupportedLayerError(f"layer {name!r}: a Conv2d must pad with zeros, by a given size")
