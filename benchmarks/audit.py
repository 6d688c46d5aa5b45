"""Counts missing and duplicate transitions in a CartPole run's table by its contents, not by its counters.

The table of the closing checkpoint must hold the whole run (a capacity that was never reached).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from coop.common.errors import RunError
from coop.common.types import Array
from coop.records.checkpoints import REPLAY
from coop.records.learner_checkpoints import newest_checkpoint

RESET = 0.05  # CartPole begins an episode with all four numbers within this


def audit(run_dir: Path) -> tuple[int, int]:
    """(gaps, transitions held more than once).

    A gap is an observation without a predecessor that begins no episode: the transition before it is missing.
    """
    closing = newest_checkpoint(run_dir)
    if closing is None:
        raise RunError(f"{run_dir}: has no checkpoint")
    table = closing.path / REPLAY
    slots, frames = np.load(table / "slots.npy"), np.load(table / "frames.npy")
    obs, next_obs = frames[slots[:, 0]], frames[slots[:, 1]]
    begins = (np.abs(obs) <= RESET).all(1)
    led_to = np.isin(_rows(obs), _rows(next_obs))
    distinct = np.unique(_rows(np.hstack((obs, next_obs))))
    return int((~begins & ~led_to).sum()), len(slots) - len(distinct)


def _rows(values: Array) -> Array:
    """Each row as one comparable item of its bytes."""
    rows = np.ascontiguousarray(values)
    return rows.view(np.dtype((np.void, rows.itemsize * rows.shape[1]))).ravel()
