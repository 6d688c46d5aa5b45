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
    """Writes scalars for TensorBoard, which wait for space as a run's lines do.

    PyTorch's `SummaryWriter` has a thread of its own, and that one dies of a full disk.
    """

    def __init__(self, folder: Path) -> None:
        """Begin a file; raises OSError where it can't be."""
        folder.mkdir(parents=True, exist_ok=True)
        name = f"events.out.tfevents.{int(time.time()):010}.{socket.gethostname()}.{os.getpid()}"
        self._file = LineFile(folder / name, go_on=True)
        self._records = RecordWriter(_Records(self._file))
        self._add(Event(wall_time=time.time(), file_version="brain.Event:2"))

    @property
    def problem(self) -> str:
        """Why scalars are being kept; empty while none are."""
        return self._file.problem

    def add(self, name: str, value: float, step: int) -> None:
        """Add one value."""
        summary = Summary(value=[Summary.Value(tag=name, simple_value=value)])
        self._add(Event(wall_time=time.time(), step=step, summary=summary))

    def close(self) -> None:
        """Write what is left."""
        self._file.close()

    def _add(self, event: Event) -> None:
        self._records.write(event.SerializeToString())


class _Records:
    """What a `RecordWriter` takes for a file; it writes each record at once."""

    def __init__(self, file: LineFile) -> None:
        self.write = file.append
