"""Reads records that others are writing: whole lines only, each once.

A line of text that can't be read is left out: that is for displays, and who resumes or reports the run names it.
"""

from __future__ import annotations

import csv
import os
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

from coop.records.checkpoints import EVALUATIONS

MOST = 1 << 24  # bytes of one reading
TAIL = 1 << 16  # bytes, more than any row of metrics.jsonl
COMPARED = 256  # bytes of the newest lines, which a file that only grows keeps


class GrowingFile:
    """The lines of a file that grows, as far as they are whole.

    restarted: at the last reading the file was shorter than before, another one, or had other lines: what had been read
        is no longer true, as after a resumption from a checkpoint, and it was read anew.
    from_start: the last reading began at the file's first line.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.restarted, self.from_start = False, True
        self._read = 0
        self._newest = b""  # the end of what has been read

    def raw_lines(self) -> list[bytes]:
        """The whole lines since the last call; raises OSError while the file is not there or can't be read."""
        self.restarted = False
        with self.path.open("rb") as file:
            if self._read:
                file.seek(self._read - len(self._newest))
                if file.read(len(self._newest)) != self._newest:
                    self._read, self._newest, self.restarted = 0, b"", True
            self.from_start = not self._read
            lines: list[bytes] = []
            file.seek(self._read)
            while whole := file.read(MOST).rpartition(b"\n")[0]:
                self._read += len(whole) + 1
                self._newest = whole[-COMPARED:] + b"\n"
                lines += whole.split(b"\n")
                file.seek(self._read)
            return lines

    def lines(self) -> list[str]:
        """The same as text; none while the file is not there or can't be read."""
        try:
            return [line.decode(errors="replace") for line in self.raw_lines()]
        except OSError:
            return []


class GrowingTable(GrowingFile):
    """The rows of a CSV file that grows."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self._columns: list[str] = []

    def rows(self) -> Iterator[dict[str, str]]:
        """Yield the rows since the last call, by the names of their columns."""
        lines = self.lines()
        if self.restarted:
            self._columns = []
        for line in lines:
            try:
                (values,) = csv.reader([line])
            except csv.Error:
                continue  # as a row with other columns
            if not self._columns:
                self._columns = values
            elif len(values) == len(self._columns):
                yield dict(zip(self._columns, values, strict=True))


class Evaluations:
    """The evaluations of a run, as they are recorded."""

    def __init__(self, folder: Path) -> None:
        self._file = GrowingTable(folder / EVALUATIONS)
        self._points: list[list[float | None]] = []

    def points(self) -> list[list[float | None]]:
        """Environment steps and mean return of each, so far."""
        rows = list(self._file.rows())
        if self._file.restarted:
            self._points = []
        for row in rows:
            with suppress(KeyError, ValueError):
                self._points.append([float(row["env_step"]), float(row["return_mean"])])
        return self._points


def tail(path: Path, most: int = TAIL) -> str:
    """The end of a file, from the begin of a line; empty if there is none or it can't be read."""
    try:
        with path.open("rb") as file:
            start = max(0, os.fstat(file.fileno()).st_size - most)
            file.seek(start)
            text = file.read().decode(errors="replace")
    except OSError:
        return ""
    return text.partition("\n")[2] if start else text
