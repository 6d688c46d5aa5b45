"""A Q-network that a user's own function makes, checked before anything else runs it."""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor, nn

from coop.common.bounds import MAX_PAYLOAD
from coop.common.errors import UsageError
from coop.common.imports import import_object
from coop.common.own_code import described
from coop.common.types import EnvSpec


def custom_network(kind: str, spec: EnvSpec, inputs: Tensor) -> nn.Module:
    """The module that `kind`, "module:name", gives when it is called with `spec`.

    inputs: float32 [n, *input], n > 1, on which the module is tried.

    Raises:
        UsageError: it cannot be imported or called, or is no Q-network float32 [n, *input] -> [n, num_actions] whose
            values depend on nothing but one observation and its trained parameters.
    """
    make = import_object(kind, "network.kind")
    try:
        module = make(spec)
        with torch.no_grad():
            problem = next(_problems(module, spec, inputs), None)
    except KeyboardInterrupt:
        raise
    except BaseException as error:  # a user's code may raise anything, such as SystemExit
        problem = described(error)
    if problem is not None:
        raise UsageError(f"network.kind = {kind!r}: {problem}")
    return module  # type: ignore[no-any-return]


def _problems(module: object, spec: EnvSpec, inputs: Tensor) -> Iterator[str]:
    if not isinstance(module, nn.Module):
        yield f"gives {type(module).__name__}; it must give a torch.nn.Module"
        return
    values = module(inputs)  # also makes the parameters of lazy layers
    expected = [len(inputs), spec.num_actions]
    if not isinstance(values, Tensor) or list(values.shape) != expected or values.dtype != torch.float32:
        tensor = isinstance(values, Tensor)
        given = f"{values.dtype} {list(values.shape)}".removeprefix("torch.") if tensor else type(values).__name__
        yield f"its output is {given} for inputs {list(inputs.shape)}; it must be float32 {expected}"
        return
    yield from state_problems(module)
    for name, layer in module.named_modules():
        if isinstance(layer, nn.modules.dropout._DropoutNd) and layer.training and layer.p > 0:
            yield f"layer {name!r} is a {type(layer).__name__}; random layers are not supported"
    for name, parameter in module.named_parameters():
        if parameter.dtype != torch.float32:
            yield f"parameter {name!r} is {parameter.dtype}; it must be torch.float32"
    count, most = sum(parameter.numel() for parameter in module.parameters()), MAX_PAYLOAD // 4 - 2**18
    if not 0 < count <= most:
        yield f"it has {count:,} parameters; allowed: 1 to {most:,}, what a message carries"
    if not torch.equal(module(inputs), values):
        yield "its values differ between two calls; random layers are not supported"
    if not torch.allclose(module(inputs[:1]), values[:1], rtol=1e-3, atol=1e-5, equal_nan=True):
        yield "its values of one observation depend on the others in the batch"


def state_problems(module: nn.Module) -> Iterator[str]:
    """What makes a sample's values depend on more than the sample and the parameters that are trained and saved."""
    for name, layer in module.named_modules():
        kind = type(layer).__name__
        if isinstance(layer, nn.modules.batchnorm._BatchNorm):
            yield f"layer {name!r} is a {kind}, in which the samples of a batch meet"
        for buffer, _ in layer.named_buffers(recurse=False):
            yield f"layer {name!r} ({kind}) has a buffer, {buffer!r}; only parameters are trained and saved"
    for name, parameter in module.named_parameters():
        if not parameter.requires_grad:
            yield f"parameter {name!r} does not require a gradient"
