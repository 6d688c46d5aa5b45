"""Writes the networks of a run's newest checkpoint to files that need nothing of this package, ONNX among them."""

from __future__ import annotations

import hashlib
import importlib.util
import io
import warnings
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

import msgspec
import numpy as np
import torch
from safetensors.numpy import save
from torch import Tensor, nn

from coop.common.errors import CoopError, RunError, UsageError
from coop.common.imports import describe
from coop.common.networks.forward import preprocess
from coop.common.networks.network import FlatNetwork, sample_observations
from coop.common.numbers import strict_json
from coop.common.process.files import SyncedFile, make_folder, sync_folder
from coop.common.settings.config import RunConfig
from coop.common.types import EnvSpec
from coop.evaluation.saved import Checkpoint, SavedRun


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


CARD = "card.json"
# The arguments that make a layer again, besides its bias.
_ARGUMENTS: dict[type[nn.Module], tuple[str, ...]] = {
    nn.Linear: ("in_features", "out_features"),
    nn.Conv2d: (
        "in_channels", "out_channels", "kernel_size", "stride", "padding", "dilation", "groups", "padding_mode",
    ),
    nn.ReLU: (),
    nn.Flatten: ("start_dim", "end_dim"),
}  # fmt: skip


@dataclass(frozen=True)
class Exported:
    """What has been written: names of files, in order; checkpoint and acting network (1 or 2); why there is no ONNX."""

    names: list[str]
    checkpoint: int
    acting: int
    without_onnx: str


def export(
    run_dir: Path, out: Path, flag: str = "--out", also: Mapping[str, bytes | None] = MappingProxyType({})
) -> Exported:
    """Write both networks as safetensors and ONNX, and card.json, which says what they are, to the folder `out`.

    A folder with card.json is complete. An earlier export there is replaced.

    flag: what has named the folder. also: other files, by name; None for one that an earlier export may have left.

    Raises:
        UsageError: the run has no checkpoint, or `out` is no folder, or has other files.
        RunError: `out` cannot be written; an earlier export stays as it was, or loses its card.
    """
    run = SavedRun(run_dir)
    check_folder(out, flag, also)
    checkpoint = run.checkpoint()
    contents, without_onnx = {name: data for name, data in also.items() if data is not None}, ""
    for number, network in enumerate(checkpoint.networks, 1):
        contents[f"network-{number}.safetensors"] = save(network.views(network.snapshot()))
        try:
            contents[f"network-{number}.onnx"] = onnx_model(network, checkpoint.spec)
        except NotExportedError as error:
            without_onnx = str(error)
    sums = {name: hashlib.sha256(data).hexdigest() for name, data in contents.items()}
    contents[CARD] = f"{strict_json({**_card(run.config, checkpoint), 'sha256': sums}, indent=2)}\n".encode()
    try:
        _write(out, contents, also)
    except OSError as error:
        raise RunError(f"{error.filename or out}: {error.strerror or error}") from error
    return Exported(list(contents), checkpoint.number, checkpoint.acting + 1, without_onnx)


def _card(config: RunConfig, checkpoint: Checkpoint) -> dict[str, Any]:
    """What a reader needs to use the networks and to make them again, with the names of a run's own files."""
    environment, spec, returns = asdict(config.env), checkpoint.spec, checkpoint.returns
    pictures = {name: environment.pop(name) for name in ("stack", "resize", "grayscale")}
    return {
        "environment": environment,
        "preprocessing": pictures | preparation(spec),
        "network": {"kind": config.network.kind, "layers": _layers(checkpoint.networks[0].module)},
        "spec": {**msgspec.structs.asdict(spec), "obs_shape": spec.obs_shape, "input_shape": spec.input_shape},
        "method": config.method,
        "seed": config.seed,
        "env_steps": checkpoint.env_steps,
        "updates": checkpoint.number,
        "acting_network": checkpoint.acting + 1,
        "return_mean_100": float(np.mean(returns)) if returns else None,
    }


def _layers(module: nn.Module) -> list[tuple[str, str, dict[str, Any]]] | None:
    """(name, class in torch.nn, arguments) of each layer of a plain stack; None for any other module."""
    if type(module) is not nn.Sequential or not all(type(layer) in _ARGUMENTS for layer in module):
        return None
    return [(name, type(layer).__name__, _arguments(layer)) for name, layer in module.named_children()]


def _arguments(layer: nn.Module) -> dict[str, Any]:
    arguments = {name: getattr(layer, name) for name in _ARGUMENTS[type(layer)]}
    return {**arguments, "bias": layer.bias is not None} if hasattr(layer, "bias") else arguments


def check_folder(out: Path, flag: str, also: Iterable[str] = ()) -> None:
    """Raise UsageError for a folder with other files than those of an export, and those that come along with it."""
    if not out.exists():
        return
    if not out.is_dir():
        raise UsageError(f"{flag} {out}: is no folder")
    own = {CARD, *also, *(f"network-{number}.{kind}" for number in (1, 2) for kind in ("safetensors", "onnx"))}
    other = sorted(path.name for path in out.iterdir() if path.name.removesuffix(".part") not in own)
    if other:
        raise UsageError(f"{flag} {out}: has other files, such as {other[0]}; name an empty or a new folder")


def _write(out: Path, contents: Mapping[str, bytes], also: Iterable[str]) -> None:
    """Write all files, the last one only when all others have their place."""
    make_folder(out)
    parts = {name: out / f"{name}.part" for name in contents}
    try:
        for name, data in contents.items():
            with SyncedFile(parts[name]) as file:
                file.write(data)
        for stale in (CARD, "network-1.onnx", "network-2.onnx", *also):
            (out / stale).unlink(missing_ok=True)
        for name, part in parts.items():
            part.replace(out / name)
        sync_folder(out)
    finally:
        for part in parts.values():
            part.unlink(missing_ok=True)
