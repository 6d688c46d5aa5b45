"""The tables of a run in its directory: episodes.csv, metrics.jsonl and evaluations.csv."""

from __future__ import annotations

import csv
import io
import shutil
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from coop.common.messaging.messages.evaluate import EvaluationRow
from coop.common.numbers import exact, strict_json
from coop.common.process.console import say
from coop.common.process.files import FileDigest, LineFile, aside_folder, write_atomic
from coop.common.process.untrusted import read_bytes
from coop.common.types import EpisodeRow
from coop.records.checkpoints import EVALUATIONS, RECORDS
from coop.records.sinks import Kept, RecordedRun, Sink

EPISODE_FIELDS = (
    "episode", "env_step", "update", "actor", "stream", "return", "length",
    "epsilon", "s", "q1_mean", "q2_mean", "param_version",
)  # fmt: skip
FIELDS = EvaluationRow.__struct_fields__


class RecordFiles(Sink):
    """Writes the tables; when a call returns, its lines are complete if the disk has space."""

    def __init__(self, run: RecordedRun) -> None:
        self._path = run.path
        self._files: tuple[LineFile, ...] = ()

    def begin(self, settings: Mapping[str, Any], kept: Kept | None) -> None:
        """Create the files, or continue those that a checkpoint seals, which are as long as it says; raises OSError."""
        goes_on = kept is not None
        self._episodes, self._metrics = (LineFile(self._path / name, go_on=goes_on) for name in RECORDS)
        self._evaluations = EvaluationsFile(self._path, None if kept is None else kept.env_step)
        self._files = (self._episodes, self._metrics, self._evaluations)
        self._csv = csv.writer(self._episodes, lineterminator="\n")
        if not goes_on:
            self._csv.writerow(EPISODE_FIELDS)

    @property
    def problem(self) -> str:
        """Why lines are being kept; empty if none are."""
        return next((file.problem for file in self._files if file.problem), "")

    @property
    def measured(self) -> dict[str, FileDigest]:
        """What each file holds now, lines that are kept included, by name."""
        return {name: file.measured for name, file in zip((*RECORDS, EVALUATIONS), self._files, strict=True)}

    @property
    def evaluated(self) -> int:
        """Environment steps at the last evaluation; 0 before it."""
        return self._evaluations.newest

    def episode(self, row: EpisodeRow) -> None:
        """See `Sink`."""
        record, end = row.record, row.record.end
        place = (row.number, record.env_step, row.update, f"{record.actor:x}", record.stream)
        values = (f"{value:.6g}" for value in (end.epsilon, row.s, end.q1_mean, end.q2_mean))
        self._csv.writerow((*place, exact(end.episode_return), end.length, *values, end.param_version))

    def metrics(self, row: Mapping[str, Any]) -> None:
        """See `Sink`."""
        self._metrics.write(strict_json({"time": time.time(), **row}) + "\n")

    def evaluation(self, row: EvaluationRow) -> None:
        """See `Sink`."""
        self._evaluations.add(row)

    def sync(self) -> None:
        """Write the kept lines, and flush the files to the disk; raises OSError."""
        for file in self._files:
            file.sync()

    def close(self) -> None:
        """Try once more to write kept lines, and close the files."""
        for file in self._files:
            file.close()


class EvaluationsFile(LineFile):
    """Writes evaluations.csv.

    newest: environment steps at the last evaluation; 0 before it.
    """

    def __init__(self, folder: Path, env_step: int | None) -> None:
        """Create the file, or continue it with the lines of a run that is resumed after `env_step` steps.

        Lines stay by their step, and not up to a size as in other files: results arrive after the checkpoint of the
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
        content = io.StringIO()
        csv.writer(content, lineterminator="\n").writerows([FIELDS, *kept])
        write_atomic(path, content.getvalue().encode())  # who follows the file, or a kill, finds no half of it
        super().__init__(path, go_on=True)
        self.newest = max((int(row[0]) for row in kept), default=0)
        self._csv = csv.writer(self, lineterminator="\n")

    def add(self, row: EvaluationRow) -> None:
        """Add a line."""
        values = [getattr(row, name) for name in FIELDS]
        self._csv.writerow([exact(value) if isinstance(value, float) else str(value) for value in values])
        self.newest = max(self.newest, row.env_step)


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
