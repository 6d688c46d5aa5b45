"""The Python API: train, load, evaluate and sweep from a script or a notebook.

    run = coop.train(preset="cartpole", method="coop", seed=0, total_steps=20_000, run_dir="runs/a")
    for row in run.metrics():
        print(row["env_step"], row["loss"])
    policy = coop.load("runs/a").policy()
    print(coop.evaluate(policy, episodes=20).mean)

docs/python.md has more examples.
"""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path

from coop.common.errors import CoopError, RunError, UsageError
from coop.common.places import absolute
from coop.common.settings.config import RunConfig
from coop.common.settings.methods import METHODS, Method
from coop.evaluation.evaluate import Evaluation, evaluate
from coop.evaluation.saved import SavedPolicy, SavedRun
from coop.studies.sweep.run import SweepResult, sweep
from coop.training import TrainingRun, train

__all__ = [
    "CoopError",
    "Evaluation",
    "Method",
    "RunConfig",
    "RunError",
    "SavedPolicy",
    "SavedRun",
    "SweepResult",
    "TrainingRun",
    "UsageError",
    "evaluate",
    "load",
    "register_method",
    "sweep",
    "train",
]


def load(run_dir: str | Path, *, allow_import: Collection[str] = ()) -> SavedRun:
    """The run in a folder, whether it has ended or not.

    allow_import: modules of its environment or network that may be imported even if they lie in the run's folder or
    beside it. Others come from the installed packages, `sys.path` or the working directory.

    Raises:
        UsageError: there is no run.
        RunError: a link leads out of the folder.
    """
    return SavedRun(absolute(run_dir, "run_dir"), allow_import)


def register_method(method: Method) -> None:
    """Add a training method in this process; raises UsageError for a name in use.

    The processes of distributed runs and of sweeps know only the methods of installed packages, which add them by an
    entry point of the group `coop.methods`.
    """
    METHODS.register(method)
