"""Eligibility traces of a network's gradient, and the bounded steps along them (ObGD)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from coop.common.networks.network import FlatNetwork
from coop.common.networks.normalised import Floats, LayerPass, NormalisedNetwork


class Traces:
    """z <- decay * z + grad Q(s, a).

    z: float32 [P], in the order of the network's parameters.
    """

    def __init__(self, network: FlatNetwork, form: NormalisedNetwork) -> None:
        self.z = torch.zeros_like(network.flat)
        self._form = form
        views = network.views(self.z)
        names = [name.removesuffix(".weight") for name in views if name.endswith(".weight")]
        self._weights = [views[f"{name}.weight"].flatten(1) for name in names]
        self._biases: list[Floats] = [views[f"{name}.bias"].numpy() for name in names]

    def reset(self) -> None:
        """Set z to 0."""
        self.z.zero_()

    def add(self, records: Sequence[LayerPass], action: int, decay: float) -> None:
        """Let z decay, and add the gradient of Q(s, action).

        records: of the forward pass with the one observation s.
        """
        self.z.mul_(decay)
        slope = np.zeros_like(records[-1].normalised[0])
        slope[action] = 1
        for number in reversed(range(len(records))):
            layer, record = self._form.layers[number], records[number]
            if number < len(records) - 1:
                slope = self._before_normalisation(slope, record, layer.average[:, 0])
            if layer.windows is None:
                self._weights[number].addr_(torch.from_numpy(slope), torch.from_numpy(record.inputs[0]))
                self._biases[number] += slope
                slope = slope.dot(layer.weight) if number else slope
            else:
                # A convolution is the first layer, so nothing is before it.
                at_places = slope.reshape(len(layer.bias), -1)
                self._weights[number] += torch.from_numpy(at_places.dot(record.inputs[0].T))
                self._biases[number] += at_places.sum(1)

    def _before_normalisation(self, slope: Floats, record: LayerPass, average: Floats) -> Floats:
        """The slope float32 [n] at a layer's pre-activations, from that at the outputs of its leaky ReLUs."""
        y = record.normalised[0]
        slope = np.where(y > 0, slope, self._form.slope * slope)
        slope -= slope.dot(average) + y * (y * slope).dot(average)
        slope *= record.scale[0]
        return slope


def bounded_step(step_size: float, bound: float, delta: float, norm: float) -> float:
    """ObGD's step size: alpha / max(1, alpha kappa max(|delta|, 1) ||z||_1).

    A step of this size along z changes the TD error delta by less than its size, as far as the network is linear.

    Args:
        step_size: alpha. bound: kappa. norm: ||z||_1.
    """
    return step_size / max(1.0, step_size * bound * max(abs(delta), 1.0) * norm)
