"""The random id of the run that a directory belongs to; it distinguishes runs of the same name."""

from __future__ import annotations

from pathlib import Path

from coop.common.errors import RunError
from coop.common.process.files import make_folder, write_atomic
from coop.common.process.untrusted import MAX_SETTINGS, read_text

RUN_ID = "run-id"


def has_run_id(folder: Path) -> bool:
    """True if a run has begun in a directory."""
    return (folder / RUN_ID).exists()


def read_run_id(folder: Path) -> int:
    """Read the id of the run in a directory; raises RunError."""
    path = folder / RUN_ID
    try:
        return int(read_text(path, MAX_SETTINGS))
    except (OSError, ValueError) as error:
        raise RunError(f"{path}: {error}") from error


def claim(folder: Path, run_id: int) -> None:
    """Assign a directory to a run, permanently.

    Raises:
        RunError: it belongs to another run, or it cannot be written; then nothing was written.
    """
    if has_run_id(folder):
        check_owner(folder, read_run_id(folder), run_id)
        return
    try:
        make_folder(folder)
        write_atomic(folder / RUN_ID, f"{run_id}\n".encode())
    except OSError as error:
        raise RunError(f"{folder / RUN_ID}: {error.strerror or error}") from error


def check_owner(place: Path, found: int, run_id: int) -> None:
    """Raise RunError if the run id found in `place` differs from the learner's, `run_id`."""
    if found != run_id:
        raise RunError(f"{place}: belongs to another run than the learner's")
