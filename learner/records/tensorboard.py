"""Writes a run's TensorBoard file."""

from __future__ import annotations

import os
import socket
import time
from pathlib import Path

from tensorboard.compat.proto.event_pb2 import Event
from tensorboard.compat.proto.summary_pb2 import Summary
from tensorboard.summary.writer.record_writer import RecordWriter

from common.process.files import LineFile


class TensorBoardWriter:
    """Writes scalars for TensorBoard; while the disk is full they are kept, like a run's lines.

    PyTorch's `SummaryWriter` writes in its own thread, which a full disk would end.
    """

    def __init__(self, folder: Path) -> None:
        """Create a file; raises OSError if that fails."""
        folder.mkdir(parents=True, exist_ok=True)
        name = f"events.out.tfevents.{int(time.time()):010}.{socket.gethostname()}.{os.getpid()}"
        self._file = LineFile(folder / name, go_on=True)
        self._records = RecordWriter(_Records(self._file))
        self._add(Event(wall_time=time.time(), file_version="brain.Event:2"))

    @property
    def problem(self) -> str:
        """Why scalars are being kept; empty if none are."""
        return self._file.problem

    def add(self, name: str, value: float, step: int) -> None:
        """Add one value."""
        summary = Summary(value=[Summary.Value(tag=name, simple_value=value)])
        self._add(Event(wall_time=time.time(), step=step, summary=summary))

    def close(self) -> None:
        """Write the kept scalars, and close the file."""
        self._file.close()

    def _add(self, event: Event) -> None:
        self._records.write(event.SerializeToString())


class _Records:
    """The file object for a `RecordWriter`; writes each record at once."""

    def __init__(self, file: LineFile) -> None:
        self.write = file.append
