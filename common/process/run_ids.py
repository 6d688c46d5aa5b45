"""The id of the run that a directory belongs to: drawn at random when the run begins, it tells namesakes apart."""

from __future__ import annotations

import secrets
from pathlib import Path

from common.errors import RunError
from common.process.files import write_whole

RUN_ID = "run-id"


def has_run_id(folder: Path) -> bool:
    """True where a run has begun in a directory."""
    return (folder / RUN_ID).exists()


def read_run_id(folder: Path) -> int:
    """The id of the run in a directory; raises RunError."""
    path = folder / RUN_ID
    try:
        return int(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise RunError(f"{path}: {error}") from error


def draw_run_id(folder: Path) -> int:
    """The id of the run in a directory, drawn now where no run has begun in it; raises RunError."""
    if not has_run_id(folder):
        claim(folder, secrets.randbits(63))
    return read_run_id(folder)


def claim(folder: Path, run_id: int) -> None:
    """Make a directory one of the run's, once and for all.

    Raises:
        RunError: it is another run's, or it can't be written; nothing was written then.
    """
    if has_run_id(folder):
        check_owner(folder, read_run_id(folder), run_id)
        return
    try:
        folder.mkdir(parents=True, exist_ok=True)
        write_whole(folder / RUN_ID, f"{run_id}\n".encode())
    except OSError as error:
        raise RunError(f"{folder / RUN_ID}: {error.strerror or error}") from error


def check_owner(place: Path, found: int, run_id: int) -> None:
    """Raises RunError where what was found in `place` is of another run than the learner's."""
    if found != run_id:
        raise RunError(f"{place}: belongs to the run with id {found}, the learner's has {run_id}")
