"""Sources of a report's runs: a folder of run directories, or a packed study."""

from __future__ import annotations

import csv
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Protocol

from experiments.report.packed import CONFIG, EPISODES, SWEEP, PackedStudy


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
    """A folder of run directories, or a single one."""

    def __init__(self, folder: Path) -> None:
        single = (folder / CONFIG).is_file()
        self._folder = folder.resolve().parent if single else folder
        self.names = (
            [folder.resolve().name] if single else sorted(each.parent.name for each in folder.glob(f"*/{CONFIG}"))
        )
        self.sweep = (folder / SWEEP).read_text(encoding="utf-8") if (folder / SWEEP).exists() else None

    def text(self, run: str, file: str) -> str | None:
        """See `Source`."""
        try:
            return (self._folder / run / file).read_text(encoding="utf-8")
        except FileNotFoundError:
            return None

    def columns(self, run: str, file: str, wanted: Sequence[str], optional: Sequence[str] = ()) -> dict[str, list[Any]]:
        """See `Source`."""
        with (self._folder / run / file).open(encoding="utf-8") as lines:
            rows = list(csv.DictReader(lines) if file == EPISODES else map(json.loads, lines))
        found = {name: [row[name] for row in rows] for name in wanted}
        return found | {name: [row.get(name) for row in rows] for name in optional}


def open_source(path: Path) -> Source:
    """Open a folder of runs or a packed study; raises UsageError if the file is none."""
    return FolderSource(path) if path.is_dir() else PackedStudy(path)
