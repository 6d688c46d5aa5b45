"""A saved network as an ONNX model, which takes observations as the environment gives them."""

from __future__ import annotations

import importlib.util
import io
import warnings
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from coop.common.errors import CoopError
from coop.common.imports import describe
from coop.common.networks.inputs import preprocess
from coop.common.networks.network import FlatNetwork, sample_observations
from coop.common.types import EnvSpec


class NotExportedError(CoopError):
    """There is no ONNX model of the network; the text says why."""


def preparation(spec: EnvSpec) -> dict[str, Any]:
    """How stacked observations [batch, *obs_shape] become inputs: permute to `axes`, reshape, multiply by `scale`."""
    axes = list(range(len(spec.obs_shape) + 1))
    if len(spec.frame_shape) == 3:  # channels before height and width
        axes.insert(-2, axes.pop())
    return {"axes": axes, "input_shape": spec.input_shape, "scale": 1 / 255 if spec.frame_dtype == "uint8" else 1.0}


class QValues(nn.Module):
    """A network behind the preparation of its inputs."""

    def __init__(self, module: nn.Module, spec: EnvSpec) -> None:
        super().__init__()
        self.module = module
        self._steps = preparation(spec)

    def forward(self, obs: Tensor) -> Tensor:
        """Q-values, float32 [batch, actions], of stacked observations <frame_dtype>[batch, *obs_shape]."""
        inputs = obs.float().permute(self._steps["axes"]).reshape(-1, *self._steps["input_shape"])
        q_values: Tensor = self.module(inputs * self._steps["scale"])
        return q_values


def onnx_model(network: FlatNetwork, spec: EnvSpec) -> bytes:
    """The model, from "obs" to "q_values", for batches of any size.

    Raises:
        NotExportedError: onnx is not installed, the network has layers that ONNX lacks, or the model computes other
            values than the network, because the module decides by values or by the batch's size.
    """
    if importlib.util.find_spec("onnx") is None:
        raise NotExportedError("onnx is not installed")
    from onnx.reference import ReferenceEvaluator  # noqa: PLC0415 (an extra, which may be missing)

    observations = sample_observations(spec, 5)
    file = io.BytesIO()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of traces, which are checked below
            # The older of PyTorch's exporters: a hundredth of the time, and it needs no package but onnx.
            torch.onnx.export(
                QValues(network.module, spec),
                (observations[:2],),
                file,  # type: ignore[arg-type]  # what its annotation omits
                dynamo=False,
                training=torch.onnx.TrainingMode.PRESERVE,
                input_names=["obs"],
                output_names=["q_values"],
                dynamic_axes={"obs": {0: "batch"}, "q_values": {0: "batch"}},
            )
            outputs: Any = ReferenceEvaluator(file.getvalue()).run(None, {"obs": observations.numpy()})
    except Exception as error:  # layers of users may fail in any way
        raise NotExportedError(describe(error)) from error
    with torch.inference_mode():
        expected = network(preprocess(observations, spec)).numpy()
    if not np.allclose(outputs[0], expected, rtol=1e-3, atol=1e-4 * np.abs(expected).max(), equal_nan=True):
        raise NotExportedError("its ONNX model gives other Q-values for other observations than those that were traced")
    return file.getvalue()
