"""TensorBoard: a run's scalars, histograms, films and settings, in tb/ of its directory."""

from __future__ import annotations

import os
import socket
import struct
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from google.protobuf.message import DecodeError
from tensorboard.compat.proto.event_pb2 import Event, SessionLog
from tensorboard.compat.proto.summary_pb2 import HistogramProto, Summary, SummaryMetadata
from tensorboard.compat.proto.tensor_pb2 import TensorProto
from tensorboard.compat.proto.types_pb2 import DT_STRING
from tensorboard.plugins.hparams import api_pb2, metadata, plugin_data_pb2
from tensorboard.plugins.hparams.summary_v2 import hparams_pb
from tensorboard.summary.writer.record_writer import RecordWriter

from coop.common.process.files import LineFile, write_atomic
from coop.common.process.untrusted import read_bytes
from coop.records.sinks import EPISODE, ROW, WELL, Kept, RecordedRun, ScalarSink

FOLDER = "tb"
SETTINGS = "hyperparameters"  # the first tag of an event that each file begins with
_FRAME = struct.Struct("<Q4x")  # before a record: its length, and a checksum of that; another follows the record


class TensorBoardSink(ScalarSink):
    """Writes files for TensorBoard; while the disk is full, records are kept, like a run's lines.

    PyTorch's `SummaryWriter` writes in its own thread, which a full disk would end.
    """

    name = "tensorboard"

    def __init__(self, run: RecordedRun) -> None:
        self._folder = run.path / FOLDER
        self._trial, self._cell = f"{run.run_id:x}", run.cell

    def begin(self, settings: Mapping[str, Any], kept: Kept | None) -> None:
        """Create a file, and cut those that are there back to `kept`, or to nothing; raises OSError if that fails.

        The settings are a table of text. The hyperparameters of the plugin HParams are those in which the runs of a
        sweep differ, and all of a run by itself.
        """
        self._folder.mkdir(parents=True, exist_ok=True)
        _cut_back(self._folder, kept or Kept(0, 0, -1))
        name = f"events.out.tfevents.{int(time.time()):010}.{socket.gethostname()}.{os.getpid()}"
        self._file = LineFile(self._folder / name, go_on=True)
        self._records = RecordWriter(_Records(self._file))
        self._add(Event(file_version="brain.Event:2"))
        if kept is not None:  # a TensorBoard that has read what was cut off drops it
            start = SessionLog(status=SessionLog.START, msg=f"{kept.episodes} {kept.rows}")
            self._add(Event(step=kept.env_step + 1, session_log=start))
        rows = "".join(f"|{name}|{value}|\n" for name, value in settings.items())
        text = Summary.Value(
            tag=SETTINGS,
            metadata=SummaryMetadata(plugin_data=SummaryMetadata.PluginData(plugin_name="text")),
            tensor=TensorProto(dtype=DT_STRING, string_val=[f"|setting|value|\n|-|-|\n{rows}".encode()]),
        )
        chosen = self._cell or settings
        plain = {name: value if isinstance(value, bool | int | float) else str(value) for name, value in chosen.items()}
        self._summary(0, text, *hparams_pb(plain, trial_id=self._trial).value)

    @property
    def problem(self) -> str:
        """Why records are being kept; empty if none are."""
        return self._file.problem

    def conclude(self, summary: Mapping[str, Any]) -> None:
        """Add what the run has reached, and, for HParams, how it has ended."""
        super().conclude(summary)
        whole = str(summary["exit"]).startswith(WELL)
        status = api_pb2.STATUS_SUCCESS if whole else api_pb2.STATUS_FAILURE
        told = plugin_data_pb2.HParamsPluginData(
            session_end_info=plugin_data_pb2.SessionEndInfo(status=status, end_time_secs=time.time())
        )
        about = metadata.create_summary_metadata(told)
        self._summary(0, Summary.Value(tag=metadata.SESSION_END_INFO_TAG, metadata=about, tensor=metadata.NULL_TENSOR))

    def film(self, gif: bytes, env_step: int) -> None:
        """See `Sink`."""
        width, height = (int.from_bytes(gif[place : place + 2], "little") for place in (6, 8))
        image = Summary.Image(width=width, height=height, colorspace=3, encoded_image_string=gif)
        self._summary(env_step, Summary.Value(tag="eval/video", image=image))

    def metrics(self, row: Mapping[str, Any]) -> None:
        """Add the numbers of a row, and the histograms of its samples."""
        super().metrics(row)
        self._histogram("replay/sample_age", 0, row["sample_age_histogram"], row["env_step"])
        self._histogram("replay/reuse", 1, row["reuse_histogram"], row["env_step"])

    def scalars(self, values: Mapping[str, float], env_step: int) -> None:
        """See `ScalarSink`."""
        self._summary(env_step, *(Summary.Value(tag=name, simple_value=value) for name, value in values.items()))

    def _histogram(self, name: str, least: int, counts: Sequence[int], step: int) -> None:
        """Add counts of integers; least: 0 or 1, the smallest. counts: entry b ends below 2^(least + b)."""
        limits = [2.0 ** (least + number) for number in range(len(counts))]
        histogram = HistogramProto(min=least, max=limits[-1], num=sum(counts), bucket_limit=limits, bucket=counts)
        self._summary(step, Summary.Value(tag=name, histo=histogram))

    def close(self) -> None:
        """Write the kept records, and close the file."""
        if hasattr(self, "_file"):  # it has begun
            self._file.close()

    def _summary(self, step: int, *values: Summary.Value) -> None:
        self._add(Event(step=step, summary=Summary(value=values)))

    def _add(self, event: Event) -> None:
        event.wall_time = time.time()
        self._records.write(event.SerializeToString())


class _Records:
    """The file object for a `RecordWriter`; writes each record at once."""

    def __init__(self, file: LineFile) -> None:
        self.write = file.append


def _cut_back(folder: Path, kept: Kept) -> None:
    """Drop what this run's earlier processes wrote and `kept` does not include, and records that a kill has torn."""
    counts, most = {EPISODE: 0, ROW: 0}, {EPISODE: kept.episodes, ROW: kept.rows}
    for path in sorted(folder.glob("events.out.tfevents.*")):
        content = read_bytes(path)
        events = list(_events(content))
        if all(tag != SETTINGS for _, tag, _ in events):
            continue  # somebody else's
        whole, in_row = [], True  # in_row: whether the newest row of metrics, whose histograms follow it, is kept
        for record, tag, event in events:
            keep = event.step <= kept.env_step or tag in ("", SETTINGS)
            if tag in counts:
                counts[tag] += 1
                keep = counts[tag] <= most[tag]
                in_row = keep if tag == ROW else in_row
            elif tag.startswith("replay/"):
                keep = in_row
            elif event.session_log.msg:  # what the run held then, also of a time without this sink
                counts = dict(zip(counts, map(int, event.session_log.msg.split()), strict=True))
            if keep:
                whole.append(record)
        if len(left := b"".join(whole)) < len(content):
            write_atomic(path, left)


def _events(content: bytes) -> Iterator[tuple[bytes, str, Event]]:
    """(record, first tag or nothing, event) of each whole event in a file."""
    place = 0
    while place + _FRAME.size <= len(content):
        end = place + _FRAME.size + _FRAME.unpack_from(content, place)[0] + 4
        try:
            event = Event.FromString(content[place + _FRAME.size : end - 4])
        except DecodeError:
            return
        if end > len(content):
            return
        values = event.summary.value
        yield content[place:end], values[0].tag if values else "", event
        place = end
