"""The transitions of a saved replay table, as arrays and as a table of pandas."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from coop.common.errors import RunError, UsageError
from coop.common.settings.config import RunConfig
from coop.common.settings.resuming import settings_digest
from coop.common.types import Array, EnvSpec
from coop.evaluation.notebook import table_html
from coop.records.checkpoints import RECORDS, REPLAY, Damaged, ask, finished, take_request
from coop.records.learner_checkpoints import newest_checkpoint
from coop.records.reading import check_records, read_frame
from coop.replay.persistence.storage import SavedTable, read_table

ASK_EVERY = 0.05  # seconds


@dataclass(frozen=True)
class Buffer:
    """The n transitions that a run's replay table held at a checkpoint, in order of insertion.

    Attributes:
        checkpoint: its number, in updates.
        spec: what tables know of the environment.
        observations, next_observations: <frame_dtype>[n, *obs_shape], stacked as the networks see them.
        actions: int32 [n].
        rewards: float32 [n]; n-step returns if `span` is above 1.
        terminated: bool [n], whether the next state is terminal.
        truncated: bool [n], whether an episode was cut at the next state, which is not terminal; None where that is not
            known: with several streams of n-step returns, or with transitions that `replay.preload` has brought.
        span: uint8 [n], environment steps from an observation to the next one.
        ids: int64 [n], numbers of the transitions in order of insertion, from 0.
        age: int64 [n], transitions inserted since this one.
        reuse: int32 [n], how often each had been drawn.
        param_version: int64 [n], updates behind the parameters that chose each action.
        priority: float64 [n]; None if neither eviction nor sampling goes by priorities.
        mask, next_mask: bool [n, actions], the actions allowed at each observation and at the next one; None for an
            environment without action masks.
        episode: int64 [n], numbers of episodes in order of their first transition; -1 of what `replay.preload` has
            brought. None if the transitions are of several emulators and no policy of the table numbers episodes.
        length: int64 [n], transitions of that episode, 0 while it goes on; None if `episode` is not from the records.
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
    truncated: NDArray[np.bool_] | None = None
    length: NDArray[np.int64] | None = None
    mask: NDArray[np.bool_] | None = None
    next_mask: NDArray[np.bool_] | None = None

    def __len__(self) -> int:
        return len(self.actions)

    def __repr__(self) -> str:
        return f"<buffer of {len(self):,} transitions of {self.spec.env_id}, checkpoint {self.checkpoint}>"

    def _repr_html_(self) -> str:
        names = (f"{name}: {array.dtype} {list(array.shape)}" for name, array in self.columns().items())
        return table_html({"buffer": repr(self).strip("<>"), "columns": ", ".join(names)})

    def columns(self) -> dict[str, Array]:
        """The arrays of transitions that there are, by name."""
        arrays = {name: value for name, value in vars(self).items() if isinstance(value, np.ndarray)}
        return {name: value for name, value in arrays.items() if name != "length"}

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
        table = read_table(newest.path / REPLAY, newest.number)
    except Damaged as damaged:  # since it was looked at
        raise RunError(f"{newest.path / REPLAY}: {damaged}") from damaged
    names = {"obs": "observations", "next_obs": "next_observations", "priorities": "priority", "episodes": "episode"}
    columns = {names.get(name, name): array for name, array in table.columns.items()}
    check_records(run_dir)
    ends = np.array(read_frame(run_dir / RECORDS[0])["env_step"].tolist() + table.ends, np.int64)
    return Buffer(newest.number, table.spec, **{**_of_episodes(table, np.unique(ends)), **columns})


def ask_and_wait(run_dir: Path, timeout: float, works: Callable[[], bool]) -> None:
    """Have the run that works in a folder save a checkpoint, and wait for it; return once none works there.

    Raises:
        RunError: it saved none within `timeout` seconds.
    """
    before, deadline = finished(run_dir)[-1:], time.monotonic() + timeout
    if not works():
        return
    try:
        ask(run_dir)
        while finished(run_dir)[-1:] == before and works():
            if time.monotonic() >= deadline:
                raise RunError(f"{run_dir}: the run has saved no checkpoint for {timeout:g} s; does it learn?")
            time.sleep(ASK_EVERY)
    except OSError as error:
        raise RunError(f"{run_dir}: {error.strerror or error}") from error
    finally:
        take_request(run_dir)  # which a run that has ended leaves


def _of_episodes(table: SavedTable, ends: NDArray[np.int64]) -> dict[str, Array]:
    """What the records tell of transitions; ends: the steps after which episodes of the run ended, ascending."""
    steps, span = table.columns["ids"] - table.preloaded, table.columns["span"].astype(np.int64)
    own, running = steps >= 0, ~table.columns["terminated"]
    if table.streams > 1:
        known = own.all() and (span == 1).all()
        return {"truncated": running & np.isin(steps + 1, ends)} if known else {}
    place = np.searchsorted(ends, steps, side="right")
    over = own & (place < len(ends))
    padded = np.concatenate(([0], ends, [0]))
    end, before = padded[place + 1], padded[place]
    truncated = {"truncated": over & running & (steps + span == end)} if own.all() else {}
    return {"episode": np.where(own, place, -1), "length": np.where(over, end - before, 0), **truncated}
