"""The Python API: train, load, evaluate and sweep from a script or a notebook.

    run = coop.train(preset="cartpole", method="coop", seed=0, total_steps=20_000, run_dir="runs/a")
    for row in run.metrics():
        print(row["env_step"], row["loss"])
    policy = coop.load("runs/a").policy()
    print(coop.evaluate(policy, episodes=20).mean)

docs/python.md has more examples. `import coop` imports nothing else: each name is imported when it is first used.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from coop.common.errors import CoopError as CoopError
    from coop.common.errors import RunError as RunError
    from coop.common.errors import UsageError as UsageError
    from coop.common.settings.config import RunConfig as RunConfig
    from coop.common.settings.methods import Method as Method
    from coop.common.settings.methods import register_method as register_method
    from coop.evaluation.buffer import Buffer as Buffer
    from coop.evaluation.evaluate import Evaluation as Evaluation
    from coop.evaluation.evaluate import evaluate as evaluate
    from coop.evaluation.saved import SavedPolicy as SavedPolicy
    from coop.evaluation.saved import SavedRun as SavedRun
    from coop.evaluation.saved import load as load
    from coop.studies.frames import SweepFrames as SweepFrames
    from coop.studies.frames import load_sweep as load_sweep
    from coop.studies.sweep.run import SweepResult as SweepResult
    from coop.studies.sweep.run import sweep as sweep
    from coop.studies.tuning import tune as tune
    from coop.training import TrainingRun as TrainingRun
    from coop.training import train as train

_MODULES = {
    "Buffer": "coop.evaluation.buffer",
    "CoopError": "coop.common.errors",
    "Evaluation": "coop.evaluation.evaluate",
    "Method": "coop.common.settings.methods",
    "RunConfig": "coop.common.settings.config",
    "RunError": "coop.common.errors",
    "SavedPolicy": "coop.evaluation.saved",
    "SavedRun": "coop.evaluation.saved",
    "SweepFrames": "coop.studies.frames",
    "SweepResult": "coop.studies.sweep.run",
    "TrainingRun": "coop.training",
    "UsageError": "coop.common.errors",
    "evaluate": "coop.evaluation.evaluate",
    "load": "coop.evaluation.saved",
    "load_sweep": "coop.studies.frames",
    "register_method": "coop.common.settings.methods",
    "sweep": "coop.studies.sweep.run",
    "train": "coop.training",
    "tune": "coop.studies.tuning",
}

__all__ = sorted(_MODULES)  # noqa: PLE0605


def __getattr__(name: str) -> Any:  # noqa: ANN401 (whatever has that name)
    if name not in _MODULES:
        raise AttributeError(f"module 'coop' has no attribute {name!r}")
    value = getattr(importlib.import_module(_MODULES[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return [*globals(), *_MODULES]
