"""Diagnostics of small buffers on an archive of old transitions: forgetting, plasticity and policy churn."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import msgspec
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from coop.common.networks.forward import preprocess
from coop.common.networks.masks import allowed
from coop.common.transitions import Batch
from coop.learner.losses import columns, td_errors
from coop.learner.protocol import AnyAgent
from coop.learner.qnetwork import on_host

ARCHIVED = 64  # transitions
RANK_STATES = 32  # of the archive: no effective rank is larger; its time grows with their cube
DORMANT_BELOW = 0.025  # tau of Sokar et al. 2023: share of the layer's mean activation
RANK_LEFT_OUT = 0.01  # delta of Kumar et al. 2021: share of the sum of singular values

Layer = NDArray[np.float32] | Tensor
"""The activations of a hidden layer, float32 [batch, ..., units]; a tensor stays on its device, which reduces it."""


class Diagnostics:
    """Keeps the first 64 transitions drawn, and measures the networks on them; changes nothing and draws no number.

    archive: those transitions, which stay as they are; None before the first batch.
    """

    def __init__(self) -> None:
        self.archive: Batch | None = None
        self._before: NDArray[np.float32] | None = None  # at the last row, [trained networks, states, actions]

    def add(self, batch: Batch) -> None:
        """Archive transitions of a batch until the archive is full."""
        missing = ARCHIVED - (0 if self.archive is None else len(self.archive))
        if missing > 0:
            first = _first(batch, missing)
            self.archive = first if self.archive is None else _joined(self.archive, first)

    def row(self, agent: AnyAgent) -> dict[str, Any]:
        """The values for a row of metrics.jsonl; there must be an archive.

        Hidden layers, and the TD error as an update would find it, are those of the acting network. Drift and churn
        compare with the last row (the first has none), and are means over the trained networks.
        """
        archive, acting, settings = self.archive, agent.acting, agent.config.learner
        assert archive is not None
        size, index = len(archive), np.concatenate((archive.obs_index, archive.next_index))
        obs = archive.frames[index].reshape(-1, *agent.spec.obs_shape)  # and next_obs
        q = np.stack(agent.q_values(obs))
        next_values, preferred = q[1 - acting, size:], q[acting if settings.double else 1 - acting, size:]
        with torch.no_grad():
            # Contiguous, because what a picture with its channels last is flattened to would be no view of it.
            inputs = preprocess(torch.from_numpy(obs[:size]).to(agent.device), agent.spec).contiguous()
            hidden = hidden_layers(agent.networks[acting].module, inputs)
        generator = agent.rule.rng.bit_generator  # a method's own rule may draw numbers of the run from it
        before = generator.state
        errors = agent.own_td_errors(archive)
        if errors is None:
            mask = archive.next_mask
            bootstrap = agent.rule.bootstrap(allowed(next_values, mask), allowed(preferred, mask))
            held = columns(archive, settings.gamma)
            errors = td_errors(held, q[acting, :size], bootstrap, settings.value_bound)
        generator.state = before
        q, among = q[:, :size], True if archive.mask is None else archive.mask
        return {
            "q_gap": float(np.linalg.norm((q[0] - q[1]) * among, axis=1).mean()),
            "q1_mean": float(q[0].mean(where=among)),
            "q2_mean": float(q[1].mean(where=among)),
            "q_abs_mean": float(np.abs(q).mean(where=among)),
            "archive_td_error": float(np.abs(errors).mean()),
            **self._changes(q if agent.config.two_networks else q[:1], archive.mask),
            **_plasticity([layer.float() if layer.is_cuda else on_host(layer) for layer in hidden]),
        }

    def state(self) -> dict[str, Any]:
        """The state for `load_state`; torch.load reads it with weights_only."""
        arrays = {} if self.archive is None else {"frames": self.archive.frames, **self.archive.columns()}
        return {
            "archive": {name: torch.from_numpy(array) for name, array in arrays.items()},
            "before": None if self._before is None else torch.from_numpy(self._before),
        }

    def load_state(self, state: dict[str, Any]) -> None:
        """Restore a state from `state`."""
        arrays, before = state["archive"], state["before"]
        self.archive = Batch(**{name: tensor.numpy() for name, tensor in arrays.items()}) if arrays else None
        self._before = None if before is None else before.numpy()

    def _changes(self, q: NDArray[np.float32], mask: NDArray[np.bool_] | None) -> dict[str, float]:
        before, self._before = self._before, q
        if before is None:
            return {}
        now = q[:, : before.shape[1]]  # the archive may have been filled since
        mask = None if mask is None else mask[: before.shape[1]]
        among = True if mask is None else mask
        return {
            "archive_drift": float(np.abs(now - before).mean(where=among)),
            "policy_churn": float((_best(now, mask) != _best(before, mask)).mean()),
        }


def _best(q: NDArray[np.float32], mask: NDArray[np.bool_] | None) -> NDArray[np.intp]:
    """The best allowed actions, int [networks, states], of Q [networks, states, actions]."""
    return np.stack([allowed(values, mask).argmax(1) for values in q])


def hidden_layers(module: nn.Module, x: Tensor) -> list[Tensor]:
    """A network's hidden layers after their nonlinearity: what its Linear and Conv2d layers after the first read.

    A hidden layer is float [batch, ..., units], in the order of execution, and once if several layers read it. The
    units of a picture are its channels, also where a view of it is flattened. Call without gradients.
    """
    read: list[Tensor] = []
    layers = [layer for layer in module.modules() if isinstance(layer, nn.Linear | nn.Conv2d)]
    hooks = [layer.register_forward_pre_hook(lambda layer, args: read.append(_layer(layer, *args))) for layer in layers]
    try:
        module(x)
    finally:
        for hook in hooks:
            hook.remove()
    seen = {each.data_ptr() for each in (x, *read[:1])}
    hidden = [each for each in read if len(each) == len(x) and each.data_ptr() not in seen]
    return list({each.data_ptr(): each for each in hidden}.values())


def dormant(layer: Layer) -> NDArray[np.bool_]:
    """The tau-dormant units of a hidden layer, bool [units] (Sokar et al. 2023).

    A unit is dormant if its mean |activation| is at most tau times the mean over the layer's units.
    """
    units = layer.shape[-1]
    score = on_host(layer.abs().reshape(-1, units).mean(0) if isinstance(layer, Tensor) else _means(layer, units))
    return np.asarray(score <= DORMANT_BELOW * score.mean())


def effective_ranks(layers: Sequence[Layer]) -> list[float]:
    """The effective rank srank of hidden layers (Kumar et al. 2021); nan if one of them is not finite.

    It is the least number of the largest singular values of [batch, features] whose sum is at least 1 - delta of all.
    """
    # In float64 the roots of the Gram matrices' eigenvalues are exact enough, and take a fraction of an SVD's time.
    grams = np.stack([_gram(layer) for layer in layers])
    if not np.isfinite(grams).all():
        return [math.nan] * len(layers)
    sums = np.sqrt(np.linalg.eigvalsh(grams).clip(0))[:, ::-1].cumsum(1)
    short = sums < (1 - RANK_LEFT_OUT) * sums[:, -1:]
    return [float(count) for count in short.sum(1) + (sums[:, -1] > 0)]


def _means(layer: NDArray[np.float32], units: int) -> NDArray[np.float32]:
    means: NDArray[np.float32] = np.abs(layer).reshape(-1, units).mean(0)
    return means


def _gram(layer: Layer) -> NDArray[np.float64]:
    """Products of the states' features: float64 [batch, batch]."""
    if isinstance(layer, Tensor):
        wide = layer.reshape(len(layer), -1).double()
        product: NDArray[np.float64] = (wide @ wide.T).cpu().numpy()
        return product
    features = layer.reshape(len(layer), -1).astype(np.float64)
    return features @ features.T


def _plasticity(hidden: Sequence[Layer]) -> dict[str, Any]:
    """Dormant units and effective rank by layer, with the share of all hidden units and the last layer's rank."""
    if not hidden:
        return {}
    asleep = [dormant(layer) for layer in hidden]
    ranks = effective_ranks([layer[:RANK_STATES] for layer in hidden])
    return {
        "dormant_share": float(np.concatenate(asleep).mean()),
        "dormant_by_layer": [float(units.mean()) for units in asleep],
        "effective_rank": ranks[-1],
        "effective_rank_by_layer": ranks,
    }


def _layer(reader: nn.Module, x: Tensor) -> Tensor:
    """What a layer reads, with the units last."""
    if isinstance(reader, nn.Conv2d):
        return x.movedim(1, -1)
    picture = x._base
    flattened = picture is not None and picture.ndim == 4 and x.ndim == 2 and picture.numel() == x.numel()
    return picture.movedim(1, -1) if picture is not None and flattened else x


def _first(batch: Batch, count: int) -> Batch:
    """A copy of the first transitions of a batch, with their frames only: a view would keep a whole message alive."""
    columns = {name: column[:count].copy() for name, column in batch.columns().items()}
    shape = columns["obs_index"].shape
    places, index = np.unique(np.stack((columns["obs_index"], columns["next_index"])), return_inverse=True)
    columns["obs_index"], columns["next_index"] = index.reshape(2, *shape).astype(np.int32)
    frames: Any = batch.frames[places]
    return Batch(frames=frames.cpu().numpy() if isinstance(frames, Tensor) else frames, **columns)


def _joined(one: Batch, other: Batch) -> Batch:
    """The transitions of two batches, as one."""
    shift = len(one.frames)
    other = msgspec.structs.replace(other, obs_index=other.obs_index + shift, next_index=other.next_index + shift)
    columns = {name: np.concatenate((column, getattr(other, name))) for name, column in one.columns().items()}
    return Batch(frames=np.concatenate((one.frames, other.frames)), **columns)
