"""Sources of a report's runs: a folder of run directories, or a packed study."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Protocol

from common.process.untrusted import MAX_SETTINGS, check_links, read_text
from experiments.report.packed import EPISODES, SWEEP, PackedStudy, run_names


class Source(Protocol):
    """The files of runs.

    names: of the runs. sweep: the text of sweep.toml; None if there is none.
    """

    names: list[str]
    sweep: str | None

    def text(self, run: str, file: str) -> str | None:
        """The content of a run's file; None if there is none."""
        ...

    def columns(self, run: str, file: str, wanted: Sequence[str], optional: Sequence[str] = ()) -> dict[str, list[Any]]:
        """Some columns of a run's episodes or metrics; an optional one has None if a line lacks it.

        Raises KeyError or ValueError if a wanted one is missing.
        """
        ...


class FolderSource:
    """A folder of run directories."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self.names = run_names(folder)
        check_links(folder)
        for run in self.names:
            check_links(folder / run)
        self.sweep = read_text(folder / SWEEP, MAX_SETTINGS) if (folder / SWEEP).exists() else None

    def text(self, run: str, file: str) -> str | None:
        """See `Source`."""
        try:
            return read_text(self._folder / run / file)
        except FileNotFoundError:
            return None

    def columns(self, run: str, file: str, wanted: Sequence[str], optional: Sequence[str] = ()) -> dict[str, list[Any]]:
        """See `Source`."""
        lines = io.StringIO(read_text(self._folder / run / file))
        rows = list(csv.DictReader(lines) if file == EPISODES else map(json.loads, lines))
        found = {name: [row[name] for row in rows] for name in wanted}
        return found | {name: [row.get(name) for row in rows] for name in optional}


def open_source(path: Path) -> Source:
    """Open a folder of runs or a packed study.

    Raises:
        UsageError: the file is none, or a run has a name that is none.
        RunError: a link leads out of a run.
    """
    return FolderSource(path) if path.is_dir() else PackedStudy(path)
