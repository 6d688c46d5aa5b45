"""Stored observations as networks take them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from coop.common.networks.layout import ArrayT
from coop.common.types import EnvSpec

if TYPE_CHECKING:
    import torch


def preprocess(obs: ArrayT, spec: EnvSpec, dtype: torch.dtype | None = None) -> ArrayT:
    """The network's input for stored observations: <frame_dtype>[batch, *obs_shape] -> <dtype>[batch, *input_shape].

    It stays with its library, PyTorch or numpy, and on its device. uint8 is scaled to [0, 1]; bool becomes 0 and 1.
    Planes are ordered by frame, oldest first, then by channel.

    dtype: for tensors; float32 if None, as in numpy.
    """
    if not isinstance(obs, np.ndarray):
        obs = obs.float() if dtype is None else obs.to(dtype)
    elif spec.frame_dtype != "float32":
        obs = obs.astype(np.float32)
    if spec.frame_dtype == "uint8":
        obs *= 1 / 255
    if len(spec.frame_shape) == 3:
        obs = obs.swapaxes(-1, -2).swapaxes(-2, -3)  # channels first; `moveaxis` takes longer than a small network
    return obs if obs.shape[1:] == spec.input_shape else obs.reshape(-1, *spec.input_shape)
