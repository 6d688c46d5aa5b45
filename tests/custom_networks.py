"""Networks that a user could bring, made from an environment's specification; good and bad ones."""

import sys
from math import prod

import torch
from torch import Tensor, nn

from coop.common.types import EnvSpec


class Duel(nn.Module):
    """A dueling network; the head of the advantages has their mean subtracted."""

    def __init__(self, inputs: int, actions: int, width: int = 64) -> None:
        super().__init__()
        self.trunk = nn.Linear(inputs, width)
        self.value = nn.Sequential(nn.Linear(width, width), nn.ReLU(inplace=True), nn.Linear(width, 1))
        self.advantage = nn.Sequential(nn.Linear(width, width), nn.ReLU(inplace=True), nn.Linear(width, actions))

    def forward(self, x: Tensor) -> Tensor:
        h = torch.relu_(self.trunk(x.flatten(1)))
        advantage = self.advantage(h)
        return self.value(h) + advantage - advantage.mean(1, keepdim=True)


class Residual(nn.Module):
    """A LayerNorm, a residual and a smooth activation."""

    def __init__(self, inputs: int, actions: int, width: int = 64) -> None:
        super().__init__()
        self.scale = nn.Parameter(torch.ones(inputs))
        self.first = nn.Linear(inputs, width)
        self.norm = nn.LayerNorm(width)
        self.block = nn.Linear(width, width, bias=False)
        self.out = nn.Linear(width, actions)

    def forward(self, x: Tensor) -> Tensor:
        h = torch.tanh(self.first(x.flatten(1) * self.scale))
        return self.out(h + nn.functional.gelu(self.block(self.norm(h))))


class Pictures(nn.Module):
    """A residual of convolutions with circular padding, and one Linear for every place of the picture."""

    def __init__(self, channels: int, places: int, actions: int) -> None:
        super().__init__()
        self.first = nn.Conv2d(channels, 6, 3, padding=1)
        self.second = nn.Conv2d(6, 6, 3, padding="same", padding_mode="circular", groups=2)
        self.norm = nn.GroupNorm(2, 6)
        self.place = nn.Linear(6, 4)
        self.out = nn.Linear(4 * places, actions)

    def forward(self, x: Tensor) -> Tensor:
        h = nn.functional.leaky_relu(self.first(x))
        h = h + torch.sigmoid(self.second(self.norm(h)))
        return self.out(nn.functional.elu(self.place(h.flatten(2).mT)).flatten(1))


class Twice(nn.Module):
    """A layer used twice."""

    def __init__(self, inputs: int, actions: int) -> None:
        super().__init__()
        self.inner = nn.Linear(inputs, inputs)
        self.out = nn.Linear(inputs, actions)

    def forward(self, x: Tensor) -> Tensor:
        return self.out(torch.relu(self.inner(torch.relu(self.inner(x)))))


class Borrowed(nn.Module):
    """A layer whose weight is also used outside the layer."""

    def __init__(self, inputs: int, actions: int) -> None:
        super().__init__()
        self.inner = nn.Linear(inputs, inputs)
        self.out = nn.Linear(inputs, actions)

    def forward(self, x: Tensor) -> Tensor:
        return self.out(torch.tanh(self.inner(x)) @ self.inner.weight)


class Tied(Twice):
    """Two layers that share their weight."""

    def __init__(self, inputs: int, actions: int) -> None:
        super().__init__(inputs, actions)
        self.other = nn.Linear(inputs, inputs)
        self.other.weight = self.inner.weight

    def forward(self, x: Tensor) -> Tensor:
        return self.out(torch.relu(self.other(torch.relu(self.inner(x)))))


class Centred(nn.Module):
    """Subtracts the batch's mean, so that its samples meet."""

    def __init__(self, inputs: int, actions: int) -> None:
        super().__init__()
        self.inner = nn.Linear(inputs, 8)
        self.out = nn.Linear(8, actions)

    def forward(self, x: Tensor) -> Tensor:
        h = self.inner(x)
        return self.out(torch.relu(h - h.mean(0)))


class Recurrent(nn.Module):
    """Reads the input as a sequence."""

    def __init__(self, actions: int) -> None:
        super().__init__()
        self.cell = nn.GRU(1, 12, batch_first=True)
        self.out = nn.Linear(12, actions)

    def forward(self, x: Tensor) -> Tensor:
        return self.out(self.cell(x.flatten(1)[..., None])[0][:, -1])


class Doubled(nn.Sequential):
    """A stack with a forward of its own, which no chain of its layers computes."""

    def forward(self, x: Tensor) -> Tensor:
        return 2 * super().forward(x)


class Negative(nn.Linear):
    """A layer of a subclass, with a forward of its own."""

    def forward(self, x: Tensor) -> Tensor:
        return -super().forward(x)


def negative(spec: EnvSpec) -> nn.Module:
    return Negative(4, spec.num_actions)


def negatives(spec: EnvSpec) -> nn.Module:
    return nn.Sequential(
        Negative(4, 8), nn.ReLU(), nn.utils.parametrizations.weight_norm(nn.Linear(8, spec.num_actions))
    )


def doubled(spec: EnvSpec) -> nn.Module:
    return Doubled(nn.Linear(4, 8), nn.ReLU(), nn.Linear(8, spec.num_actions))


def duel(spec: EnvSpec) -> nn.Module:
    return Duel(prod(spec.obs_shape), spec.num_actions)


def residual(spec: EnvSpec) -> nn.Module:
    return Residual(prod(spec.obs_shape), spec.num_actions)


def recurrent(spec: EnvSpec) -> nn.Module:
    return Recurrent(spec.num_actions)


def twice(spec: EnvSpec) -> nn.Module:
    return Twice(prod(spec.obs_shape), spec.num_actions)


def lazy(spec: EnvSpec) -> nn.Module:
    return nn.Sequential(nn.LazyLinear(8), nn.ReLU(), nn.LazyLinear(spec.num_actions))


def normalised(spec: EnvSpec) -> nn.Module:
    return nn.Sequential(nn.Linear(4, 8), nn.BatchNorm1d(8), nn.ReLU(), nn.Linear(8, spec.num_actions))


def dropped(spec: EnvSpec) -> nn.Module:
    return nn.Sequential(nn.Linear(4, 8), nn.Dropout(0.1), nn.Linear(8, spec.num_actions))


def centred(spec: EnvSpec) -> nn.Module:
    return Centred(4, spec.num_actions)


def frozen(spec: EnvSpec) -> nn.Module:
    network = nn.Sequential(nn.Linear(4, 8), nn.Tanh(), nn.Linear(8, spec.num_actions))
    network[0].weight.requires_grad_(False)
    return network


def buffered(spec: EnvSpec) -> nn.Module:
    network = duel(spec)
    network.register_buffer("mean", torch.zeros(4))
    return network


def scalar(_: EnvSpec) -> nn.Module:
    return nn.Linear(4, 1)


def number(_: EnvSpec) -> int:
    return 3


def failing(_: EnvSpec) -> nn.Module:
    raise RuntimeError("no such\ngame")


def leaving(_: EnvSpec) -> nn.Module:
    sys.exit("no such game")


class Noisy(nn.Linear):
    """Adds noise to its output."""

    def forward(self, x: Tensor) -> Tensor:
        return super().forward(x) + torch.rand(1)


def noisy(spec: EnvSpec) -> nn.Module:
    return Noisy(4, spec.num_actions)


def huge(spec: EnvSpec) -> nn.Module:
    with torch.device("meta"):
        body = nn.Linear(4, 4)
        wide = nn.Linear(2**14, 2**14)
    body = nn.Linear(4, spec.num_actions)
    body.wide = wide
    return body


def repeated(spec: EnvSpec) -> nn.Module:
    """A stack in which a Linear and a ReLU stand twice."""
    layer, relu = nn.Linear(4, 4), nn.ReLU()
    return nn.Sequential(layer, relu, layer, relu, nn.Linear(4, spec.num_actions))


class Scaled(nn.Linear):
    """Has a parameter of another dtype."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__(inputs, outputs)
        self.scale = nn.Parameter(torch.ones(1, dtype=torch.float64))

    def forward(self, x: Tensor) -> Tensor:
        return super().forward(x) * self.scale.float()


def mixed(spec: EnvSpec) -> nn.Module:
    return Scaled(4, spec.num_actions)
