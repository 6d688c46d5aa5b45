"""Writes the networks of a run's newest checkpoint to files that need nothing of this package."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from safetensors.numpy import save
from torch import nn

from coop.common.errors import RunError, UsageError
from coop.common.numbers import strict_json
from coop.common.process.files import SyncedFile, make_folder, sync_folder
from coop.common.settings.config import RunConfig
from coop.evaluation.export_onnx import NotExportedError, onnx_model, preparation
from coop.evaluation.saved import Checkpoint, SavedRun

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


def export(run_dir: Path, out: Path) -> Exported:
    """Write both networks as safetensors and ONNX, and card.json, which says what they are, to the folder `out`.

    A folder with card.json is complete. An earlier export there is replaced.

    Raises:
        UsageError: the run has no checkpoint, or `out` is no folder, or has other files.
        RunError: `out` cannot be written; an earlier export stays as it was, or loses its card.
    """
    run = SavedRun(run_dir)
    _check_folder(out)
    checkpoint = run.checkpoint()
    contents, without_onnx = {}, ""
    for number, network in enumerate(checkpoint.networks, 1):
        contents[f"network-{number}.safetensors"] = save(network.views(network.snapshot()))
        try:
            contents[f"network-{number}.onnx"] = onnx_model(network, checkpoint.spec)
        except NotExportedError as error:
            without_onnx = str(error)
    sums = {name: hashlib.sha256(data).hexdigest() for name, data in contents.items()}
    contents[CARD] = f"{strict_json({**_card(run.config, checkpoint), 'sha256': sums}, indent=2)}\n".encode()
    try:
        _write(out, contents)
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


def _check_folder(out: Path) -> None:
    if not out.exists():
        return
    if not out.is_dir():
        raise UsageError(f"--out {out}: is no folder")
    own = {CARD, *(f"network-{number}.{kind}" for number in (1, 2) for kind in ("safetensors", "onnx"))}
    other = sorted(path.name for path in out.iterdir() if path.name.removesuffix(".part") not in own)
    if other:
        raise UsageError(f"--out {out}: has other files, such as {other[0]}; name an empty or a new folder")


def _write(out: Path, contents: Mapping[str, bytes]) -> None:
    """Write all files, the last one only when all others have their place."""
    make_folder(out)
    parts = {name: out / f"{name}.part" for name in contents}
    try:
        for name, data in contents.items():
            with SyncedFile(parts[name]) as file:
                file.write(data)
        for stale in (CARD, "network-1.onnx", "network-2.onnx"):
            (out / stale).unlink(missing_ok=True)
        for name, part in parts.items():
            part.replace(out / name)
        sync_folder(out)
    finally:
        for part in parts.values():
            part.unlink(missing_ok=True)
