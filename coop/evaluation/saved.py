"""A run that has been saved: its files, and the policy of its newest checkpoint."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pandas as pd
import torch
from numpy.typing import ArrayLike, NDArray

from coop.common.arguments import as_array, check_flag, check_seconds, check_whole, texts
from coop.common.bounds import MAX_INTEGER
from coop.common.envs.make import env_spec
from coop.common.errors import UsageError
from coop.common.imports import hand_over, permit
from coop.common.networks.masks import allowed
from coop.common.networks.network import FlatNetwork
from coop.common.places import absolute
from coop.common.process.untrusted import check_links
from coop.common.settings.config import RunConfig
from coop.common.settings.environment import EnvSettings
from coop.common.settings.resuming import settings_digest
from coop.common.types import Array, EnvSpec
from coop.evaluation.buffer import Buffer, ask_and_wait, read_buffer
from coop.evaluation.film import Clip, Film
from coop.evaluation.notebook import run_html
from coop.learner.qnetwork import make_network
from coop.records.checkpoints import EVALUATIONS, RECORDS
from coop.records.learner_checkpoints import check_spec, fitting, newest_checkpoint
from coop.records.locks import holder
from coop.records.reading import check_records, read_frame, read_jsonl, read_run_config
from coop.records.summaries import read_summary

CPU = torch.device("cpu")
NetworkChoice = Literal["mean", 1, 2]


@dataclass(frozen=True)
class Checkpoint:
    """Both networks of a checkpoint.

    number: in updates. spec: what the networks know of the environment. acting: 0 or 1, index of the network
    that acted and was trained last. env_steps: how many the run had done. returns: of its last episodes, at most 100.
    """

    number: int
    spec: EnvSpec
    networks: tuple[FlatNetwork, FlatNetwork]
    acting: int
    env_steps: int
    returns: list[float]


@dataclass(frozen=True)
class SavedPolicy:
    """A greedy policy: the mean of the Q-values of one or two networks, and the action at which it is largest.

    Attributes:
        env: settings of the environment that the networks were trained in.
        spec: what the networks need to know of it.
        networks: one or two.
    """

    env: EnvSettings
    spec: EnvSpec
    networks: tuple[FlatNetwork, ...]

    def __call__(self, obs: ArrayLike, mask: ArrayLike | None = None) -> Any:  # noqa: ANN401 (depends on obs)
        """The best action, int, for one observation; int64 [batch] for a batch. Takes what `q_values` takes.

        mask: bool or 0 and 1, [actions] or [batch, actions], the actions that are allowed; None: all.

        Raises:
            UsageError: as `q_values`; or the mask has another shape or other values, or allows no action.
        """
        values = self.q_values(obs)
        best = allowed(values, None if mask is None else self._as_mask(mask, values.shape)).argmax(-1)
        return int(best) if best.ndim == 0 else best

    def q_values(self, obs: ArrayLike) -> NDArray[np.float32]:
        """Q-values, float32 [actions], of one stacked observation, [*obs_shape]; [batch, actions] of a batch.

        Raises:
            UsageError: the observation has another shape or dtype than those of the environment, or values that are not
                finite.
        """
        given = self._as_stored(obs)
        batch = given if given.ndim > len(self.spec.obs_shape) else given[None]
        if batch.shape[1:] != self.spec.obs_shape:
            shape = "x".join(map(str, self.spec.obs_shape))
            raise UsageError(f"observation of shape {given.shape}: {self.spec.env_id} has {shape}, or a batch of these")
        each = [network.q_values(batch, self.spec) for network in self.networks]
        values: NDArray[np.float32] = np.mean(each, axis=0)
        return values if batch is given else values[0]

    def _as_mask(self, mask: ArrayLike, shape: tuple[int, ...]) -> NDArray[np.bool_]:
        given = as_array("mask", mask)
        if given.shape != shape or given.dtype.kind not in "biu" or not np.isin(given, (0, 1)).all():
            wanted = f"bool or 0 and 1, {list(shape)}"
            raise UsageError(f"mask {given.dtype}{list(given.shape)}: {self.spec.env_id} has {wanted}")
        if not given.any(-1).all():
            raise UsageError("mask: allows no action")
        return given.astype(np.bool_)

    def _as_stored(self, obs: ArrayLike) -> Array:
        """An observation in the dtype of the environment's; numbers in lists may stand for it if they fit exactly."""
        dtype = np.dtype(self.spec.frame_dtype)
        given = as_array("observation", obs)
        if given.dtype.kind not in "biuf" or not (
            np.can_cast(given.dtype, dtype, "same_kind")
            or (given.dtype.kind != "f" and np.array_equal(given.astype(dtype), given))
        ):
            raise UsageError(f"observation of dtype {given.dtype}: {self.spec.env_id} has {dtype}, or ints that fit it")
        with np.errstate(over="ignore"):
            stored = given.astype(dtype, copy=False)
        if stored.dtype.kind == "f" and not np.isfinite(stored).all():
            raise UsageError(f"observation with values that are not finite: {self.spec.env_id} has finite ones")
        return stored


class SavedRun:
    """The files of one run. Raises UsageError if the folder holds none, RunError if a link leads out of it."""

    def __init__(self, path: Path, allow_import: Collection[str] = ()) -> None:
        """allow_import: modules that may be imported even if they lie in the run's folder or beside it."""
        self.path = path
        hand_over(path)
        permit(texts("allow_import", allow_import))
        if not (path / "config.toml").is_file():
            raise UsageError(f"{path}: holds no run")
        check_links(path)

    def __repr__(self) -> str:
        return f"<run {str(self.path)!r}: {self.config.env.id}, {self.config.method}, seed {self.config.seed}>"

    @cached_property
    def config(self) -> RunConfig:
        """The config of the run."""
        return read_run_config(self.path)

    @property
    def episodes(self) -> pd.DataFrame:
        """A row for each finished episode, with the columns of episodes.csv."""
        return self._table(RECORDS[0])

    @property
    def metrics(self) -> pd.DataFrame:
        """A row for each line of metrics.jsonl."""
        check_records(self.path)
        return pd.DataFrame(read_jsonl(self.path / "metrics.jsonl"))

    @property
    def evaluations(self) -> pd.DataFrame:
        """A row for each evaluation during the run, with the columns of evaluations.csv."""
        return self._table(EVALUATIONS)

    def _table(self, name: str) -> pd.DataFrame:
        """A CSV record, after its checks; raises RunError."""
        check_records(self.path)
        return read_frame(self.path / name)

    @property
    def summary(self) -> dict[str, Any] | None:
        """The contents of summary.json; None if the run has not ended."""
        return read_summary(self.path) or None

    def checkpoint(self) -> Checkpoint:
        """The networks of the newest whole checkpoint; a warning names younger ones that are not.

        Raises UsageError if there is none.
        """
        checkpoint = newest_checkpoint(self.path, settings_digest(self.config))
        if checkpoint is None:
            raise UsageError(f"{self.path}: has no complete checkpoint")
        state, spec = checkpoint.state, env_spec(self.config.env)
        with fitting(checkpoint.path):
            check_spec(checkpoint, spec)
            first, second = (make_network(self.config, spec, number, CPU) for number in (0, 1))
            for network, flat in zip((first, second), state["agent"]["networks"], strict=True):
                network.load(flat)
            steps, returns = state["drawn"]["inserted"], state["telemetry"]["returns"]
            return Checkpoint(checkpoint.number, spec, (first, second), state["agent"]["acting"], steps, returns)

    def buffer(self, *, live: bool = False, timeout: float = 60.0) -> Buffer:
        """The transitions that the replay table held at the newest whole checkpoint; env and network are not needed.

        live: have the run save a checkpoint first, if it goes on; it is waited for `timeout` seconds at most.

        Raises:
            UsageError: the run keeps no table, or has no checkpoint here that holds one.
            RunError: the run saved no checkpoint in that time.
        """
        check_flag("live", live)
        check_seconds("timeout", timeout)
        if live and not self.config.streaming:
            ask_and_wait(self.path, timeout, lambda: holder(self.path)[1])
        return read_buffer(self.path, self.config)

    def policy(self, network: NetworkChoice = "mean") -> SavedPolicy:
        """The greedy policy of the newest checkpoint.

        network: 1 or 2 plays by that network's Q-values, "mean" by the mean of both. The second network of a method
        with one network is an older copy of the first, so "mean" is the first one there.

        Raises:
            UsageError: the run has no checkpoint, or there is no such network.
        """
        if isinstance(network, bool | float) or network not in ("mean", 1, 2):
            raise UsageError(f"network = {network!r}: allowed: 'mean', 1, 2")
        checkpoint = self.checkpoint()
        first, second = checkpoint.networks
        both = (first, second) if self.config.two_networks else (first,)
        chosen = both if network == "mean" else ((first, second)[network - 1],)
        return SavedPolicy(self.config.env, checkpoint.spec, chosen)

    def film(self, network: NetworkChoice = "mean", *, seed: int = 0) -> Clip:
        """An episode that `policy(network)` plays, as an animated GIF that a notebook shows; a long one is cut.

        Raises:
            UsageError: as `policy`, or the environment can't be filmed.
        """
        check_whole("seed", seed, 0, MAX_INTEGER)
        policy = self.policy(network)
        return Clip.of(Film(policy, self.config.env, seed))

    def _repr_html_(self) -> str:
        return run_html(self)

    def q_values(self, obs: ArrayLike, network: NetworkChoice = "mean") -> NDArray[np.float32]:
        """Q-values of `policy(network)`, float32 [actions] or [batch, actions]; for many calls, keep the policy."""
        return self.policy(network).q_values(obs)


def load(run_dir: str | Path, *, allow_import: Collection[str] = ()) -> SavedRun:
    """The run in a folder, whether it has ended or not.

    allow_import: modules of its environment or network that may be imported even if they lie in the run's folder or
    beside it. Others come from the installed packages, `sys.path` or the working directory.

    Raises:
        UsageError: there is no run.
        RunError: a link leads out of the folder.
    """
    return SavedRun(absolute(run_dir, "run_dir"), allow_import)
