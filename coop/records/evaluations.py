"""evaluations.csv: how the networks of a run play without exploration, a line for each evaluation."""

from __future__ import annotations

import csv
import shutil
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from coop.common.messaging.messages.evaluate import EvaluationRow
from coop.common.numbers import exact
from coop.common.process.console import say
from coop.common.process.files import LineFile, aside_folder
from coop.common.process.untrusted import read_bytes

EVALUATIONS = "evaluations.csv"
Floats = NDArray[np.float64]
FIELDS = EvaluationRow.__struct_fields__


class EvaluationsFile(LineFile):
    """Writes evaluations.csv.

    newest: environment steps at the last evaluation; 0 before it.
    """

    def __init__(self, folder: Path, env_step: int | None) -> None:
        """Create the file, or continue it with the lines of a run that is resumed after `env_step` steps.

        Lines stay by their step, and not up to a size as in other files: results arrive later than the epoch of the
        networks that they are of.

        Raises:
            OSError: it can't be written.
        """
        path = folder / EVALUATIONS
        kept, bad = ([], []) if env_step is None else _rows(path, env_step)
        if bad:
            to = aside_folder(folder)
            shutil.copy2(path, to / EVALUATIONS)
            say(f"{path}: line {bad[0]} can't be read, and is left out; the file as it was is in {to}")
        super().__init__(path, go_on=False)
        self.newest = 0
        self._csv = csv.writer(self, lineterminator="\n")
        self._csv.writerow(FIELDS)
        for row in kept:
            self._write(row)

    def add(self, row: EvaluationRow) -> None:
        """Add a line."""
        values = [getattr(row, name) for name in FIELDS]
        self._write([exact(value) if isinstance(value, float) else str(value) for value in values])

    def _write(self, row: list[str]) -> None:
        self._csv.writerow(row)
        self.newest = max(self.newest, int(row[0]))


def returns_by_step(text: str) -> Floats:
    """Environment steps, in order, and mean returns, of the lines with the least epsilon: float64 [2, lines]."""
    rows = list(csv.DictReader(text.splitlines()))
    least = min((float(row["epsilon"]) for row in rows), default=0.0)
    found = [(float(row["env_step"]), float(row["return_mean"])) for row in rows if float(row["epsilon"]) == least]
    return np.array(sorted(found), np.float64).reshape(-1, 2).T


def _rows(path: Path, env_step: int) -> tuple[list[list[str]], list[int]]:
    """The lines up to `env_step` steps of a file whose last one a kill may have torn, and the numbers of bad lines."""
    if not path.exists():
        return [], []
    kept, bad = [], []
    lines = read_bytes(path).decode(errors="replace").rpartition("\n")[0].splitlines()
    for number, row in enumerate(list(csv.reader(lines))[1:], 2):
        if len(row) == len(FIELDS) and row[0].isdecimal():
            kept += [row] if int(row[0]) <= env_step else []
        else:
            bad.append(number)
    return kept, bad
