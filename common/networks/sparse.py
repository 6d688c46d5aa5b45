"""The network of Stream Q(lambda): normalised, with leaky ReLUs and sparse initial weights."""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from coop.common.errors import UsageError
from coop.common.networks.network import build_network, sample_inputs
from coop.common.networks.normalised import Standardize
from coop.common.types import EnvSpec

KINDS = ("mlp", "minatar")
SPARSITY = 0.9


def sparse_network(kind: str, spec: EnvSpec, hidden: Sequence[int], seed: int) -> nn.Module:
    """A network of `build_network` in the form that learns from single steps.

    Its inputs are standardized; before each activation, a leaky ReLU, stands a LayerNorm without parameters; its
    weights are those of `sparse_`, and its biases 0.

    Raises:
        UsageError: the kind is not known in this form, or as `build_network`.
    """
    if kind not in KINDS:
        raise UsageError(f"network.kind = {kind!r}: allowed: {', '.join(KINDS)} with a method that has no buffer")
    layers: OrderedDict[str, nn.Module] = OrderedDict(standardize=Standardize(spec.input_shape))
    generator = torch.Generator().manual_seed(seed)
    x = sample_inputs(spec, 1)
    with torch.no_grad():
        for name, layer in build_network(kind, spec, hidden, seed).named_children():
            x = layer(x)
            if isinstance(layer, nn.ReLU):
                number = name.removeprefix("relu")
                layers[f"norm{number}"] = nn.LayerNorm(x.shape[1:], elementwise_affine=False)
                layers[name] = nn.LeakyReLU()
                continue
            layers[name] = layer
            if isinstance(layer, nn.Linear | nn.Conv2d):
                sparse_(layer.weight, generator)
                nn.init.zeros_(layer.bias)  # type: ignore[arg-type]  # `build_network` makes no layer without
    return nn.Sequential(layers)


def sparse_(weight: Tensor, generator: torch.Generator) -> None:
    """Fill weights <float>[out, ...] from U(-1/sqrt(n), 1/sqrt(n)), n being the inputs of a unit, and clear 90 %.

    Of each unit's inputs, 0.9 n, rounded down, have weight 0: a unit has at least one other.
    """
    rows = weight.view(len(weight), -1)
    inputs = rows.shape[1]
    rows.uniform_(-1 / math.sqrt(inputs), 1 / math.sqrt(inputs), generator=generator)
    cleared = int(SPARSITY * inputs)
    order = torch.rand(rows.shape, generator=generator).argsort(1)
    rows.scatter_(1, order[:, :cleared], 0.0)
