"""Epochs: one consistent checkpoint of learner and replay service, under checkpoints/NUMBER/ of the run directory."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

DONE = "DONE"


def save_epoch(run_dir: Path, number: int, learner_state: dict[str, Any], snapshot: Callable[[str], None]) -> Path:
    """Save one epoch; `DONE` is written last, so that a torn epoch is recognised by its absence.

    snapshot: has the replay service save itself under the folder it is given, relative to the run directory.

    Raises:
        OSError: the run directory can't be written.
    """
    folder = f"checkpoints/{number}"
    path = run_dir / folder
    path.mkdir(parents=True, exist_ok=True)
    (path / DONE).unlink(missing_ok=True)
    with (path / "learner.pt").open("wb") as file:
        torch.save(learner_state, file)
        file.flush()
        os.fsync(file.fileno())
    snapshot(folder)
    (path / DONE).write_text("", encoding="utf-8")
    return path


def load_learner(path: Path) -> dict[str, Any]:
    """Read learner.pt of an epoch's folder; executes nothing that it holds."""
    state: dict[str, Any] = torch.load(path / "learner.pt", weights_only=True)
    return state
