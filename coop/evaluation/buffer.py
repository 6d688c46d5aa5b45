"""The transitions of a saved replay table, as arrays and as a table of pandas."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from coop.common.errors import RunError, UsageError
from coop.common.settings.config import RunConfig
from coop.common.settings.resuming import settings_digest
from coop.common.types import Array, EnvSpec
from coop.records.checkpoints import REPLAY, Damaged
from coop.records.learner_checkpoints import newest_checkpoint
from coop.replay.persistence.storage import read_transitions


@dataclass(frozen=True)
class Buffer:
    """The n transitions that a run's replay table held at a checkpoint, in order of insertion.

    A table does not know which transitions were truncated, so there is no such column.

    Attributes:
        checkpoint: its number, in updates.
        spec: what tables know of the environment.
        observations, next_observations: <frame_dtype>[n, *obs_shape], stacked as the networks see them.
        actions: int32 [n].
        rewards: float32 [n]; n-step returns if `span` is above 1.
        terminated: bool [n], whether the next state is terminal.
        span: uint8 [n], environment steps from an observation to the next one.
        ids: int64 [n], numbers of the transitions in order of insertion, from 0.
        age: int64 [n], transitions inserted since this one.
        reuse: int32 [n], how often each had been drawn.
        param_version: int64 [n], updates behind the parameters that chose each action.
        priority: float64 [n]; None if neither eviction nor sampling goes by priorities.
        mask, next_mask: bool [n, actions], the actions allowed at each observation and at the next one; None for an
            environment without action masks.
        episode: int64 [n], numbers of episodes in order of their first transition; None unless a policy uses them.
    """

    checkpoint: int
    spec: EnvSpec
    observations: Array
    actions: NDArray[np.int32]
    rewards: NDArray[np.float32]
    next_observations: Array
    terminated: NDArray[np.bool_]
    span: NDArray[np.uint8]
    ids: NDArray[np.int64]
    age: NDArray[np.int64]
    reuse: NDArray[np.int32]
    param_version: NDArray[np.int64]
    priority: NDArray[np.float64] | None = None
    episode: NDArray[np.int64] | None = None
    mask: NDArray[np.bool_] | None = None
    next_mask: NDArray[np.bool_] | None = None

    def __len__(self) -> int:
        return len(self.actions)

    def __repr__(self) -> str:
        return f"<buffer of {len(self):,} transitions of {self.spec.env_id}, checkpoint {self.checkpoint}>"

    def columns(self) -> dict[str, Array]:
        """The arrays that there are, by name."""
        return {name: value for name, value in vars(self).items() if isinstance(value, np.ndarray)}

    def frame(self) -> pd.DataFrame:
        """A row for each transition; an observation is an array, <frame_dtype>[*obs_shape], not copied."""
        return pd.DataFrame({k: list(v) if v.ndim > 1 else v for k, v in self.columns().items()})


def read_buffer(run_dir: Path, config: RunConfig) -> Buffer:
    """Read the table of a run's newest whole checkpoint.

    Raises:
        UsageError: the run keeps no table, or has no checkpoint here that holds one.
        RunError: the checkpoint can't be read any more.
    """
    if config.streaming:
        raise UsageError(f"{run_dir}: has no buffer: method {config.method!r} learns from each transition once")
    newest = newest_checkpoint(run_dir, settings_digest(config), replay=True)
    if newest is None:
        raise UsageError(f"{run_dir}: has no complete checkpoint")
    try:
        spec, found = read_transitions(newest.path / REPLAY, newest.number)
    except Damaged as damaged:  # since it was looked at
        raise RunError(f"{newest.path / REPLAY}: {damaged}") from damaged
    names = {"obs": "observations", "next_obs": "next_observations", "priorities": "priority", "episodes": "episode"}
    return Buffer(newest.number, spec, **{names.get(name, name): array for name, array in found.items()})
