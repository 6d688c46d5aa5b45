"""Forward and backward passes of any module through autograd, the counterpart of the chains for plain stacks."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from coop.learner.edl.backprop import Backprop, Subspace, Tape, UnsupportedLayerError


@dataclass(frozen=True, slots=True)
class FeedbackLayer:
    """A layer that takes feedback: its name in the module, and the range of its T, None if that has full rank."""

    name: str
    module: nn.Module
    range: Subspace | None = None


@dataclass(frozen=True, slots=True)
class Call:
    """One call of layer `index`: its input, its output, and the copy of the output that the network goes on with."""

    index: int
    input: Tensor
    output: Tensor
    passed: Tensor


def record(run: Callable[[Tensor], Tensor], layers: Sequence[FeedbackLayer], x: Tensor) -> tuple[Tensor, list[Call]]:
    """The output of `run`, which calls the layers' modules, on x [batch, *input], with their calls in order."""
    calls: list[Call] = []

    def hook(index: int) -> Callable[..., Tensor]:
        def watch(_: nn.Module, args: tuple[Tensor, ...], kwargs: dict[str, Any], output: Tensor) -> Tensor:
            passed = output.clone()  # a ReLU in place would overwrite the recorded pre-activation
            calls.append(Call(index, args[0] if args else kwargs["input"], output, passed))
            return passed

        return watch

    handles = [layer.module.register_forward_hook(hook(i), with_kwargs=True) for i, layer in enumerate(layers)]
    try:
        return run(x), calls
    finally:
        for handle in handles:
            handle.remove()


@dataclass(slots=True)
class GraphTape(Tape[Tensor]):
    """A forward pass as autograd recorded it.

    root: the network's output, and outputs: that of each layer, all with their graph. x: the network's input.
    """

    root: Tensor
    outputs: list[Tensor]
    x: Tensor
    graph: AutogradBackprop

    def head(self, batch: int) -> GraphTape:
        """The tape of the first `batch` samples, recorded again: backward passes go through whole graphs only."""
        return self if batch == len(self.root) else self.graph.forward(self.x[:batch])

    def output_of(self, index: int) -> Tensor:
        """The output of layer `index`: [batch, *shape]."""
        return self.outputs[index]


class AutogradBackprop(Backprop[Tensor]):
    """The passes of a module; its steps are layers that take feedback, all other parameters are the rest."""

    def __init__(self, module: nn.Module, layers: Sequence[FeedbackLayer] = (), *, ends: bool = False) -> None:
        """ends: the output of the last layer, a Linear, is the module's."""
        self.names = [f"{layer.name}." if layer.name else "" for layer in layers]
        self.parametrised = list(range(len(layers)))
        self._module, self._layers, self._ends = module, layers, ends
        own = {id(p) for layer in layers for p in layer.module.parameters()}
        self._rest = {name: p for name, p in module.named_parameters() if id(p) not in own}

    @property
    def output_weight(self) -> Tensor | None:
        """The weight [actions, n] of the last layer if its output is the module's."""
        return self._layers[-1].module.get_parameter("weight") if self._ends else None

    def forward(self, x: Tensor) -> GraphTape:
        """Run the network on x, float [batch, *input]."""
        with torch.inference_mode(mode=False), torch.enable_grad():
            x = x.clone() if x.is_inference() else x
            root, calls = record(self._module, self._layers, x)
        by_index = {call.index: call for call in calls}
        if len(calls) != len(self._layers) or len(by_index) != len(calls):
            raise UnsupportedLayerError("its layers do not run once in every forward pass")
        steps = [by_index[index] for index in self.parametrised]
        return GraphTape(
            root.detach(), [step.input.detach() for step in steps], root, [step.output for step in steps], x, self
        )

    def cotangents(self, tape: Tape[Tensor], cotangent: Tensor) -> Iterator[tuple[int, Tensor]]:
        """As `Backprop.cotangents`, with outputs flattened: [b, k, n]."""
        tape = _recorded(tape)
        inner = self.parametrised
        if self._ends:
            *inner, last = inner
            yield last, cotangent
        if not inner:
            return
        rows = cotangent.expand(len(tape.root), -1, -1).movedim(1, 0)
        outputs = [tape.outputs[index] for index in inner]
        if len(rows) == 1:
            found = [g.unsqueeze(0) for g in _gradients(tape.root, outputs, rows[0])]
        else:
            found = _gradients(tape.root, outputs, rows, batched=True)
        for index, gradient in zip(reversed(inner), reversed(found), strict=True):
            yield index, gradient.movedim(0, 1).flatten(2)

    def write_gradients(self, tape: Tape[Tensor], index: int, delta: Tensor, out: Mapping[str, Tensor]) -> None:
        """Write the gradients of layer `index`'s parameters, given delta [batch, n] at its output."""
        layer, output, name = self._layers[index].module, tape.output_of(index), self.names[index]
        if isinstance(layer, nn.Linear):  # its products cost less than autograd's calls
            rows = delta.reshape(-1, layer.out_features)
            torch.mm(rows.t(), tape.inputs[index].reshape(-1, layer.in_features), out=out[name + "weight"])
            if layer.bias is not None:
                torch.sum(rows, 0, out=out[name + "bias"])
            return
        own = {name + part: parameter for part, parameter in layer.named_parameters()}
        _write_gradients(output, own, delta.reshape(output.shape), out)

    def write_rest(self, tape: Tape[Tensor], error: Tensor, out: Mapping[str, Tensor]) -> None:
        """Write the ordinary gradients of all parameters outside the layers, given error [batch, actions]."""
        if self._rest:
            _write_gradients(_recorded(tape).root, self._rest, error, out)

    def range_of(self, index: int) -> Subspace | None:
        """The range of T of layer `index`."""
        return self._layers[index].range


def _recorded(tape: Tape[Tensor]) -> GraphTape:
    if not isinstance(tape, GraphTape):
        raise TypeError(f"a {type(tape).__name__} holds no graph")
    return tape


def _write_gradients(
    root: Tensor, parameters: Mapping[str, Tensor], cotangent: Tensor, out: Mapping[str, Tensor]
) -> None:
    """Overwrite out[name] with the gradient of each named parameter, given root's cotangent [*root]."""
    for name, gradient in zip(parameters, _gradients(root, list(parameters.values()), cotangent), strict=True):
        out[name].copy_(gradient)


def _gradients(root: Tensor, inputs: list[Tensor], cotangent: Tensor, batched: bool = False) -> list[Tensor]:
    """Cotangents of `inputs` from those of root: [*root] or, with `batched`, [k, *root] -> [k, *input] each.

    An input that root does not depend on gets 0. The graph stays for further passes.
    """
    found = torch.autograd.grad(
        root, inputs, cotangent, retain_graph=True, is_grads_batched=batched, materialize_grads=True
    )
    return list(found)
