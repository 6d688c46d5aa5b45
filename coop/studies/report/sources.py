"""Sources of a report's runs: a folder of run directories, or a packed study."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import pandas as pd

from coop.common.errors import RunError
from coop.common.process.output import warn
from coop.common.process.untrusted import check_links, read_text
from coop.common.settings.tables import check_toml
from coop.records.reading import check_records, column, read_csv, read_jsonl, run_names
from coop.records.run_ids import RUN_ID
from coop.studies.report.packed import CONFIG, EPISODES, SUMMARY, SWEEP, PackedStudy


class RunSource(Protocol):
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

        Raises RunError, KeyError or ValueError if a wanted one is missing or can't be read.
        """
        ...

    def table(self, run: str, file: str) -> pd.DataFrame:
        """All columns of a run's episodes or metrics, empty if it has none; raises RunError."""
        ...


class FolderSource:
    """A folder of run directories, or a single one."""

    def __init__(self, folder: Path) -> None:
        self._checked: set[str] = set()  # runs whose records are those that they seal
        single = (folder / CONFIG).is_file()
        self._folder = folder.resolve().parent if single else folder
        check_links(folder)
        self.sweep = None if single else self._sweep()
        self.names = [folder.resolve().name] if single else self._checked_names(run_names(folder))

    def _checked_names(self, names: list[str]) -> list[str]:
        """The runs without a user's copies of them, which are no further runs; a warning names these.

        Raises RunError if a link leads out of one.
        """
        for name in names:
            check_links(self._folder / name)
        first: dict[tuple[str, str | None], str] = {}
        for name in names:
            # A packed run has no id; one that went on by itself has another summary.
            run = self.text(name, RUN_ID) or name, self.text(name, SUMMARY)
            if first.setdefault(run, name) != name and self.sweep is None:
                warn(f"{self._folder / name}: a copy of {first[run]}, left out")
        return [name for name in names if name in first.values()]

    def _sweep(self) -> str | None:
        text = self.text("", SWEEP)
        if text is not None:  # one that the user wrote has no checksum
            check_toml(text, self._folder / SWEEP, needed=any(self._folder.glob(f"*/{RUN_ID}")))
        return text

    def path(self, run: str) -> Path:
        """The folder of a run."""
        return self._folder / run

    def text(self, run: str, file: str) -> str | None:
        """See `RunSource`."""
        path = self._folder / run / file
        try:
            return read_text(path)
        except FileNotFoundError:
            return None
        except (OSError, UnicodeDecodeError) as error:
            raise RunError(f"{path}: can't be read: {getattr(error, 'strerror', None) or error}") from error

    def columns(self, run: str, file: str, wanted: Sequence[str], optional: Sequence[str] = ()) -> dict[str, list[Any]]:
        """See `RunSource`."""
        path, first = self._folder / run / file, 2 if file == EPISODES else 1
        rows = self._read(run, file)
        found = {name: column(rows, name, path, first) for name in wanted}
        return found | {name: column(rows, name, path, first, optional=True) for name in optional}

    def table(self, run: str, file: str) -> pd.DataFrame:
        """All columns of a run's episodes or metrics, empty if it has none; raises RunError."""
        try:
            return pd.DataFrame(self._read(run, file)).apply(_numbers)
        except FileNotFoundError:
            return pd.DataFrame()

    def _read(self, run: str, file: str) -> list[dict[str, Any]]:
        if run not in self._checked:
            check_records(self._folder / run)
            self._checked.add(run)
        path = self._folder / run / file
        return read_csv(path) if file == EPISODES else read_jsonl(path)


def _numbers(column: pd.Series) -> pd.Series:
    """A column of text as integers or floats, if all of it are numbers."""
    for kind in (np.int64, np.float64):
        if column.dtype.kind not in "iuf":
            with suppress(ValueError, TypeError, OverflowError):
                return column.astype(kind)
    return column


def open_source(path: Path) -> RunSource:
    """Open a folder of runs or a packed study.

    Raises:
        UsageError: the file is none, or a run has a name that is none.
        RunError: a link leads out of a run.
    """
    return FolderSource(path) if path.is_dir() else PackedStudy(path)
