"""Chooses the passes of a module, and examines which of its layers take error-driven feedback."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace

import torch
from torch import Tensor, nn
from torch.func import functional_call

from coop.common.networks.custom import state_problems
from coop.learner.edl.autograd_backprop import AutogradBackprop, Call, FeedbackLayer, record
from coop.learner.edl.backprop import Backprop, Subspace, UnsupportedLayerError
from coop.learner.edl.torch_backprop import TorchBackprop

_ROUNDING = 1e-5  # of singular values of T in float32, relative to the largest
_TRIALS = 3
_SAMPLES = 8  # of an example


def make_backprop(module: nn.Module, example: Tensor | None) -> Backprop[Tensor]:
    """The hand-written chain for a plain stack of Linear, Conv2d, ReLU and Flatten; autograd for any other module.

    example: float [batch, *input], on which the module is tried; None if it is trained by ordinary gradients only.

    Raises:
        UnsupportedLayerError: error-driven feedback has no meaning for a layer.
    """
    try:
        return TorchBackprop(module)
    except UnsupportedLayerError:
        return AutogradBackprop(module) if example is None else _examined(module, example[:_SAMPLES])


def _examined(module: nn.Module, x: Tensor) -> AutogradBackprop:
    """The passes with feedback for each Linear and Conv2d that the output depends on."""
    if problem := next(state_problems(module), None):
        raise UnsupportedLayerError(problem)
    candidates = list(_candidates(module))
    _check_sharing(module, candidates)
    # Random weights show what a module does; at the initial ones, some of which may be 0, T may be 0 too.
    generator = torch.Generator().manual_seed(0)
    trials = [_Trial(module, candidates, x, generator) for _ in range(_TRIALS)]
    layers = trials[0].used_layers()
    if not layers:
        raise UnsupportedLayerError("no Linear or Conv2d layer takes error-driven feedback")
    last = layers[-1]
    ends = isinstance(last.module, nn.Linear) and trials[0].ends_with(last)
    return AutogradBackprop(module, [replace(layer, range=_range(trials, layer)) for layer in layers], ends=ends)


def _candidates(module: nn.Module) -> Iterator[FeedbackLayer]:
    """Every Linear and Conv2d with its own weight and the usual forward."""
    for name, layer in module.named_modules():
        kind = next((kind for kind in (nn.Linear, nn.Conv2d) if isinstance(layer, kind)), None)
        own = {part for part, _ in layer.named_parameters()}
        if kind is not None and type(layer).forward is kind.forward and own in ({"weight"}, {"weight", "bias"}):
            yield FeedbackLayer(name, layer)


def _check_sharing(module: nn.Module, layers: list[FeedbackLayer]) -> None:
    """Refuse parameters that two modules share, where one of them is a layer with feedback."""
    holders: dict[int, list[str]] = {}
    for name, part in module.named_modules():
        for parameter in part.parameters(recurse=False):
            holders.setdefault(id(parameter), []).append(name)
    for layer in layers:
        for parameter in layer.module.parameters():
            if len(names := holders[id(parameter)]) > 1:
                raise UnsupportedLayerError(f"layers {names[0]!r} and {names[1]!r} share a parameter")


class _Trial:
    """One forward pass with random weights."""

    def __init__(
        self, module: nn.Module, layers: Sequence[FeedbackLayer], x: Tensor, generator: torch.Generator
    ) -> None:
        weights = {
            name: (torch.randn(p.shape, generator=generator) / math.sqrt(p[0].numel() if p.dim() > 1 else 1)).to(p)
            for name, p in module.named_parameters()
        }
        with torch.enable_grad():
            for weight in weights.values():
                weight.requires_grad_()
            self._root, calls = record(lambda inputs: functional_call(module, weights, (inputs,)), layers, x)
        self._weights, self._layers, self._batch = weights, layers, len(x)
        self._calls: dict[str, Call] = {}
        for call in calls:
            self._add(layers[call.index], call)

    def _add(self, layer: FeedbackLayer, call: Call) -> None:
        if layer.name in self._calls:
            raise UnsupportedLayerError(f"layer {_named(layer)} is used twice in a forward pass")
        if call.output.shape[0] != self._batch:
            shape = f"{list(call.output.shape)} for a batch of {self._batch}"
            raise UnsupportedLayerError(f"layer {_named(layer)} gives {shape}; its first axis must be the batch")
        self._calls[layer.name] = call

    def used_layers(self) -> list[FeedbackLayer]:
        """The layers that the output depends on, in the order of their calls, each checked."""
        layers = [self._layers[call.index] for call in self._calls.values()]
        used = [layer for layer in layers if self._depends_on(layer)]
        return sorted(used, key=self.ends_with)  # stable

    def ends_with(self, layer: FeedbackLayer) -> bool:
        """Whether the layer's output is the module's."""
        return self._calls[layer.name].passed is self._root

    def _depends_on(self, layer: FeedbackLayer) -> bool:
        """Whether the output depends on the layer; raises unless its parameters act through its own output alone."""
        output = self._calls[layer.name].output
        error = torch.linspace(-1, 1, self._root.numel()).view(self._root.shape).to(self._root)
        first = error.clone()
        first[1:] = 0
        if (delta := torch.autograd.grad(self._root, output, error, retain_graph=True, allow_unused=True)[0]) is None:
            return False
        if torch.autograd.grad(self._root, output, first, retain_graph=True)[0][1:].any():
            raise UnsupportedLayerError(f"layer {_named(layer)}: the samples of a batch meet after it")
        prefix = f"{layer.name}." if layer.name else ""
        own = [self._weights[prefix + part] for part, _ in layer.module.named_parameters()]
        mine = torch.autograd.grad(output, own, delta, retain_graph=True)
        whole = torch.autograd.grad(self._root, own, error, retain_graph=True)
        for gradient, expected in zip(mine, whole, strict=True):
            if float((gradient - expected).norm()) > 1e-3 * float(expected.norm()):
                raise UnsupportedLayerError(f"layer {_named(layer)}: its parameters are also used outside it")
        return True

    def transforms(self, layer: FeedbackLayer) -> Tensor:
        """T of the layer for each sample: float64 [batch, A, n]."""
        units = torch.eye(self._root.shape[1]).to(self._root)[:, None]
        cotangents = units.expand(-1, self._batch, -1)
        output = self._calls[layer.name].output
        (rows,) = torch.autograd.grad(self._root, output, cotangents, retain_graph=True, is_grads_batched=True)
        return rows.movedim(0, 1).flatten(2).double().nan_to_num()


def _range(trials: Sequence[_Trial], layer: FeedbackLayer) -> Subspace | None:
    """The range of the layer's T; None if T has full rank for some weights."""
    ts = torch.cat([trial.transforms(layer) for trial in trials])
    grams = ts @ ts.mT
    grams /= grams.amax((1, 2), keepdim=True).clamp_min(1e-300)
    values, vectors = torch.linalg.eigh(grams.mean(0))
    basis = vectors[:, values > _ROUNDING**2 * values[-1]]
    ranks = (torch.linalg.eigvalsh(grams) > _ROUNDING**2 * values[-1]).sum(1)
    rank, (actions, width) = int(ranks.max()), ts.shape[1:]
    if basis.shape[1] == actions and rank == min(actions, width):
        return None
    return Subspace(basis.to(layer.module.weight.device), rank)


def _named(layer: FeedbackLayer) -> str:
    return f"{layer.name!r} ({type(layer.module).__name__})"
