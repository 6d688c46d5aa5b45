"""Mirrors a run's scalars to Weights & Biases (extra `wandb`)."""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from coop.common.errors import UsageError

STEP = "env_step"


class WandbMirror:
    """One run of Weights & Biases; with its own variables, such as WANDB_MODE and WANDB_PROJECT, users direct it.

    Scalars are plotted over environment steps, as in TensorBoard.
    """

    def __init__(self, path: Path, run_id: int) -> None:
        """Begin the run, or continue it where the id is known; its files are in wandb/ of the run directory `path`.

        Raises:
            UsageError: it refuses, for instance because nobody has logged in.
        """
        wandb = importlib.import_module("wandb")  # an extra, and it takes seconds
        settings = wandb.Settings(console="off", silent=True, disable_git=True, save_code=False)
        try:
            self._run = wandb.init(dir=path, name=path.name, id=f"{run_id:x}", resume="allow", settings=settings)
        except wandb.Error as error:
            raise UsageError(f"--wandb: {str(error).splitlines()[0]}") from error
        # Episodes are told a little later than updates; wandb's own step must not go back.
        self._run.define_metric(STEP, hidden=True)
        self._run.define_metric("*", step_metric=STEP)

    def hyperparameters(self, values: Mapping[str, Any]) -> None:
        """Add the settings by name."""
        self._run.config.update(dict(values), allow_val_change=True)

    def scalars(self, values: Mapping[str, float], step: int) -> None:
        """Add scalars by tag; step: the run's environment steps."""
        self._run.log({**values, STEP: step})

    def close(self) -> None:
        """Send or write what is left."""
        self._run.finish()
