"""Q-networks by name, and the flat buffer that holds all parameters of a network."""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Callable, Iterable, Sequence
from functools import cache
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F  # noqa: N812 - the name that PyTorch itself uses
from numpy.typing import NDArray
from torch import Tensor, nn

from coop.common.bounds import MAX_PAYLOAD
from coop.common.errors import UsageError
from coop.common.networks.convolution import ConvolutionNetwork, Dense
from coop.common.networks.custom import custom_network
from coop.common.networks.folding import fold, folds
from coop.common.networks.forward import ArrayT, Layout, digest, mlp_layout, preprocess, views
from coop.common.networks.normalised import NormalisedNetwork
from coop.common.types import EnvSpec

# (out channels, kernel, stride) of each convolution, then the width of the hidden linear layer.
_CONV_NETWORKS: dict[str, tuple[tuple[tuple[int, int, int], ...], int]] = {
    "nature": (((32, 8, 4), (64, 4, 2), (64, 3, 1)), 512),  # Mnih et al. 2015
    "nips2013": (((16, 8, 4), (32, 4, 2)), 256),  # Mnih et al. 2013
    "minatar": (((16, 3, 1),), 128),  # Young and Tian 2019
}


def build_network(kind: str, spec: EnvSpec, hidden: Sequence[int], seed: int) -> nn.Module:
    """A Q-network float32 [batch, *input] -> [batch, num_actions] with PyTorch's default initialisation.

    kind: "mlp" (linear layers of the widths in `hidden`, ReLU between), a convolutional network (`hidden` unused), or
    "module:name", a function of `spec` that gives any module.
    The parameters depend only on `seed`; the global random state is unchanged.

    Raises UsageError for an unknown kind, for a convolutional kind if frames are not images or are too small, and for
    a module that is no Q-network of this environment.
    """
    with torch.random.fork_rng(devices=[]):
        torch.default_generator.manual_seed(seed)
        if kind == "mlp":
            return _mlp(spec, hidden)
        if kind in _CONV_NETWORKS:
            return _conv(kind, spec)
        if ":" in kind:
            return custom_network(kind, spec, sample_inputs(spec, 4))
    raise UsageError(f"network kind: {kind!r} is not one of {', '.join(('mlp', *_CONV_NETWORKS))}")


def _mlp(spec: EnvSpec, hidden: Sequence[int]) -> nn.Sequential:
    parameters = sum(math.prod(shape) for _, shape in mlp_layout(spec, hidden))
    if 4 * parameters > MAX_PAYLOAD:
        raise UsageError(
            f"network.hidden = {list(hidden)}: {parameters:,} parameters; allowed: at most {MAX_PAYLOAD // 4:,}, "
            "what a message carries"
        )
    layers: OrderedDict[str, nn.Module] = OrderedDict()
    if len(spec.input_shape) > 1:
        layers["flatten"] = nn.Flatten()
    for name, (outputs, inputs) in mlp_layout(spec, hidden)[::2]:  # weights; each is followed by its bias
        layer = name.removesuffix(".weight")
        layers[layer] = nn.Linear(inputs, outputs)
        if layer != "out":
            layers[layer.replace("fc", "relu")] = nn.ReLU()
    return nn.Sequential(layers)


def _conv(kind: str, spec: EnvSpec) -> nn.Sequential:
    if len(spec.input_shape) != 3:
        raise UsageError(f"network.kind = {kind!r}: needs pictures; {spec.env_id} has frames {list(spec.frame_shape)}")
    convs, width = _CONV_NETWORKS[kind]
    channels, height, breadth = spec.input_shape
    layers: OrderedDict[str, nn.Module] = OrderedDict()
    for i, (out, kernel, stride) in enumerate(convs, start=1):
        layers[f"conv{i}"] = nn.Conv2d(channels, out, kernel, stride)
        layers[f"relu{i}"] = nn.ReLU()
        channels, height, breadth = out, (height - kernel) // stride + 1, (breadth - kernel) // stride + 1
        if min(height, breadth) < 1:
            shape = list(spec.frame_shape)
            raise UsageError(f"network.kind = {kind!r}: needs larger frames than {shape} of {spec.env_id}")
    inputs = channels * height * breadth
    if 4 * inputs * width > MAX_PAYLOAD:
        raise UsageError(
            f"network.kind = {kind!r}: {inputs * width:,} parameters with frames {list(spec.frame_shape)} of "
            f"{spec.env_id}; allowed: at most {MAX_PAYLOAD // 4:,}, what a message carries (env.resize makes less)"
        )
    layers["flatten"] = nn.Flatten()
    layers["fc1"] = nn.Linear(inputs, width)
    layers[f"relu{len(convs) + 1}"] = nn.ReLU()
    layers["out"] = nn.Linear(width, spec.num_actions)
    return nn.Sequential(layers)


def sample_inputs(spec: EnvSpec, count: int) -> Tensor:
    """Made-up inputs of a network, always the same: float32 [count, *input]."""
    return preprocess(sample_observations(spec, count), spec)


def sample_observations(spec: EnvSpec, count: int) -> Tensor:
    """Made-up observations, always the same: <frame_dtype>[count, *obs_shape]."""
    rng, shape = np.random.default_rng(0), (count, *spec.obs_shape)
    top = {"uint8": 255, "bool": 1}.get(spec.frame_dtype)
    drawn: NDArray[Any] = rng.standard_normal(shape) if top is None else rng.integers(top + 1, size=shape)
    return torch.from_numpy(drawn.astype(spec.frame_dtype))


def layer_functions(layers: Iterable[nn.Module]) -> list[Callable[[Tensor], Tensor]]:
    """Each layer as a plain function, for forward passes without gradients; calling a module costs as much as a layer.

    A ReLU overwrites its input if that is the fresh output of a layer with parameters; on a GPU a convolution does the
    work of the ReLU behind it, which then does nothing. The functions refer to the parameters themselves, and so see
    later changes.
    """
    functions: list[Callable[[Tensor], Tensor]] = []
    before: nn.Module | None = None
    for layer in layers:
        if type(layer) is nn.ReLU and type(before) is nn.Conv2d and _fuses_relu(before):
            functions[-1:] = [_convolution_and_relu(before), _as_it_is]
        else:
            functions.append(_function(layer, type(before) in {nn.Linear, nn.Conv2d}))
        before = layer
    return functions


def _as_it_is(x: Tensor) -> Tensor:
    return x


def _convolution_and_relu(layer: nn.Conv2d) -> Callable[[Tensor], Tensor]:
    options: Any = layer.stride, layer.padding, layer.dilation, layer.groups
    down, across = layer.stride

    def run(x: Tensor) -> Tensor:
        weight, bias = layer.weight, layer.bias
        if folds(layer, x.shape[3]):
            x, weight = fold(x, across), fold(weight, across)
            return torch.cudnn_convolution_relu(x, weight, bias, (down, 1), *options[1:])
        return torch.cudnn_convolution_relu(x, weight, bias, *options)

    return run


def _fuses_relu(layer: nn.Conv2d) -> bool:
    weight = layer.weight
    plain = layer.padding_mode == "zeros" and not isinstance(layer.padding, str) and layer.bias is not None
    return plain and weight.is_cuda and _cudnn_fuses_relu(weight.device, weight.dtype)


@cache
def _cudnn_fuses_relu(device: torch.device, dtype: torch.dtype) -> bool:
    """Whether cuDNN takes a convolution and its ReLU as one, tried on a small one."""
    x = torch.linspace(-1, 1, 2 * 4 * 84 * 84, device=device).view(2, 4, 84, 84).to(dtype)
    x, weight = (part.contiguous(memory_format=torch.channels_last) for part in (x, x[:, :, :8, :8]))
    bias = torch.ones(2, device=device, dtype=dtype)
    try:
        with torch.inference_mode():
            fused = torch.cudnn_convolution_relu(x, weight, bias, (4, 4), (0, 0), (1, 1), 1)
            plain = torch.relu(F.conv2d(x, weight, bias, 4))
            return torch.allclose(fused.float(), plain.float(), rtol=2e-2, atol=0.5)
    except RuntimeError:
        return False


def _function(layer: nn.Module, fresh: bool) -> Callable[[Tensor], Tensor]:
    match layer:
        case nn.Module() if type(layer) not in {nn.Linear, nn.Conv2d, nn.ReLU}:
            return layer  # a subclass may have a forward of its own
        case nn.Linear(weight=weight, bias=bias):
            return lambda x: F.linear(x, weight, bias)
        case nn.Conv2d(weight=weight, bias=bias) if layer.padding_mode == "zeros":
            return lambda x: F.conv2d(x, weight, bias, layer.stride, layer.padding, layer.dilation, layer.groups)
        case nn.ReLU():
            return torch.relu_ if fresh else torch.relu
    return layer


def _in_numpy(module: nn.Module) -> Dense | NormalisedNetwork | None:
    return next((form(module) for form in (Dense, ConvolutionNetwork, NormalisedNetwork) if form.fits(module)), None)


class FlatNetwork:
    """A network whose parameters are views of one flat buffer.

    flat: float32 [P] (or the module's dtype), all parameters, which the learner trains, publishes and saves.
    module: the network; its named parameters view `flat`.
    in_numpy: the network in numpy, over the same parameters; None if it has no such form.
    layout: (name, shape) of each parameter in the order of the buffer.
    """

    def __init__(self, module: nn.Module) -> None:
        parameters = list(module.named_parameters())
        self.module = module
        self.layout: Layout = [(name, tuple(p.shape)) for name, p in parameters]
        self.flat = torch.cat([p.detach().reshape(-1) for _, p in parameters])
        for (_, p), view in zip(parameters, self.views(self.flat).values(), strict=True):
            p.data = view
        self._functions = layer_functions(module if type(module) is nn.Sequential else [module])
        self.in_numpy = _in_numpy(module)

    def __call__(self, x: Tensor) -> Tensor:
        """The module's output for a preprocessed batch: float32 [batch, *input] -> [batch, num_actions]."""
        for function in self._functions:
            x = function(x)
        return x

    def __reduce__(self) -> tuple[type[FlatNetwork], tuple[nn.Module]]:
        """Pickle the module alone; the functions over its parameters are made again."""
        return FlatNetwork, (self.module,)

    @property
    def size(self) -> int:
        """Number of parameters."""
        return self.flat.numel()

    def views(self, flat: ArrayT) -> dict[str, ArrayT]:
        """Each parameter's part of a flat array or tensor [P], by name and in the parameter's shape."""
        return views(flat, self.layout)

    def load(self, flat: Tensor | NDArray[np.float32]) -> None:
        """Overwrite all parameters in place from float32 [P]; raises ValueError for another size."""
        # A copy, because arrays from the wire are read-only and PyTorch warns about views of those.
        source = flat if isinstance(flat, Tensor) else torch.tensor(flat)
        if source.shape != self.flat.shape:
            raise ValueError(f"flat parameters: got shape {tuple(source.shape)}, the network has {self.size}")
        self.flat.copy_(source)

    def finite(self) -> bool:
        """True if all parameters are finite. Their sum tells 50 times sooner, but may overflow if they are large."""
        return math.isfinite(self.flat.sum().item()) or bool(torch.isfinite(self.flat).all())

    def snapshot(self) -> NDArray[np.float32]:
        """A copy of all parameters on the CPU: float32 [P]."""
        array: NDArray[np.float32] = self.flat.to("cpu", copy=True).numpy()
        return array

    def layout_digest(self) -> str:
        """See `coop.common.networks.forward.digest`."""
        return digest(self.layout)

    def q_values(self, obs: NDArray[Any], spec: EnvSpec) -> NDArray[Any]:
        """Q-values [batch, actions] of observations <frame_dtype>[batch, *obs_shape], without gradients."""
        if self.in_numpy is not None:
            return self.in_numpy(preprocess(obs, spec))
        with torch.inference_mode():
            there = torch.from_numpy(obs).to(self.flat.device)  # as bytes, of which there are fewer
            return self(preprocess(there, spec).to(self.flat)).float().cpu().numpy()
