"""Weights & Biases (extra `wandb`): a run's scalars and settings."""

from __future__ import annotations

import importlib
import os
from collections.abc import Mapping
from typing import Any

from coop.common.errors import UsageError
from coop.records.sinks import WELL, Kept, RecordedRun, ScalarSink

STEP = "env_step"
MAX_TAG = 64  # characters, the service's bound


class WandbSink(ScalarSink):
    """One run of Weights & Biases; with its own variables, such as WANDB_MODE and WANDB_PROJECT, users direct it.

    Scalars are plotted over environment steps, as in TensorBoard. The runs of a sweep are a group, in which tags tell
    its cells apart, beside those of WANDB_TAGS. A resumed run continues the same run there; what was sent of steps
    after its checkpoint stays.
    """

    name, extra, library = "wandb", "wandb", "wandb"

    def __init__(self, run: RecordedRun) -> None:
        """Begin the run, or continue it where the id is known; its files are in wandb/ of the run directory.

        Raises:
            UsageError: it refuses, for instance because nobody has logged in.
        """
        wandb = importlib.import_module("wandb")  # an extra, and it takes seconds
        settings = wandb.Settings(console="off", silent=True, disable_git=True, save_code=False)
        named: dict[str, Any] = {"name": run.path.name, "id": f"{run.run_id:x}", "group": run.sweep or None}
        if run.cell:
            own = [f"{name}={value}"[:MAX_TAG] for name, value in run.cell.items()]
            named["tags"] = [*filter(None, os.environ.get("WANDB_TAGS", "").split(",")), *own]
        try:
            self._run = wandb.init(dir=run.path, resume="allow", settings=settings, **named)
        except wandb.Error as error:
            raise UsageError(f"--log wandb: {str(error).splitlines()[0]}") from error
        self._status = 1  # until it is told how the run has ended
        # Episodes are told a little later than updates; wandb's own step must not go back.
        self._run.define_metric(STEP, hidden=True)
        self._run.define_metric("*", step_metric=STEP)

    def begin(self, settings: Mapping[str, Any], kept: Kept | None) -> None:
        """See `Sink`."""
        self._run.config.update(dict(settings), allow_val_change=True)

    def scalars(self, values: Mapping[str, float], env_step: int) -> None:
        """See `ScalarSink`."""
        self._run.log({**values, STEP: env_step})

    def conclude(self, summary: Mapping[str, Any]) -> None:
        """See `Sink`."""
        super().conclude(summary)
        self._status = int(not str(summary["exit"]).startswith(WELL))

    def close(self) -> None:
        """See `Sink`."""
        self._run.finish(exit_code=self._status)
