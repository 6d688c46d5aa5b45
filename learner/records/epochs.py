"""Epochs: consistent checkpoints of learner and replay service, in checkpoints/NUMBER/ of the run directory."""

from __future__ import annotations

import io
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

from common.process.files import measure, write_atomic
from common.process.untrusted import check_torch_file

DONE = "DONE"
LEARNER = "learner.pt"
KEPT = 2


def save_epoch(run_dir: Path, number: int, learner_state: dict[str, Any], snapshot: Callable[[str], None]) -> Path:
    """Save one epoch, and delete epochs that are too old or torn.

    `DONE`, with size and checksum of learner.pt, is written last: an epoch without it is torn.

    snapshot: makes the replay service save its state under the given folder, relative to the run directory.

    Raises:
        OSError: the run directory cannot be written; nothing is left of this epoch.
    """
    folder = f"checkpoints/{number}"
    path = run_dir / folder
    try:
        path.mkdir(parents=True, exist_ok=True)
        (path / DONE).unlink(missing_ok=True)
        content = io.BytesIO()
        torch.save(learner_state, content)
        data = content.getvalue()
        checksum = write_atomic(path / LEARNER, data)
        snapshot(folder)
        write_atomic(path / DONE, json.dumps({LEARNER: [len(data), checksum]}).encode())
    except BaseException:
        shutil.rmtree(path, ignore_errors=True)
        raise
    keep = complete_epochs(run_dir)[-KEPT:]
    for old in (run_dir / "checkpoints").iterdir():
        if old.name not in map(str, keep):
            shutil.rmtree(old, ignore_errors=True)
    return path


def complete_epochs(run_dir: Path) -> list[int]:
    """Numbers of the finished epochs, in ascending order."""
    return sorted(int(path.parent.name) for path in (run_dir / "checkpoints").glob(f"*/{DONE}"))


def intact_epochs(run_dir: Path) -> list[int]:
    """Numbers of the finished epochs whose learner.pt is intact, in ascending order."""
    return [number for number in complete_epochs(run_dir) if _is_intact(run_dir / "checkpoints" / str(number))]


def newest_epoch(run_dir: Path) -> Path | None:
    """The newest whole epoch; None if there is none."""
    whole = intact_epochs(run_dir)
    return run_dir / "checkpoints" / str(whole[-1]) if whole else None


def rewind(run_dir: Path, number: int) -> dict[str, Any] | None:
    """Load the learner's state of epoch `number` (0: the beginning, None) and delete newer epochs."""
    for newer in complete_epochs(run_dir):
        if newer > number:
            shutil.rmtree(run_dir / "checkpoints" / str(newer), ignore_errors=True)
    return load_learner(run_dir / "checkpoints" / str(number)) if number else None


def load_learner(path: Path) -> dict[str, Any]:
    """Read learner.pt from an epoch's folder, without executing any code in it.

    Raises:
        OSError: it cannot be read.
        RunError: it is no whole checkpoint, or declares more than it holds.
    """
    check_torch_file(path / LEARNER)
    state: dict[str, Any] = torch.load(path / LEARNER, weights_only=True)
    return state


def _is_intact(path: Path) -> bool:
    try:
        recorded = json.loads((path / DONE).read_text(encoding="utf-8"))
        return bool(recorded == {LEARNER: list(measure(path / LEARNER))})
    except (OSError, ValueError):
        return False
