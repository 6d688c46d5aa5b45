"""Writes a run's TensorBoard file, under the names that the field uses."""

from __future__ import annotations

import os
import socket
import struct
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, Protocol

from google.protobuf.message import DecodeError
from tensorboard.compat.proto.event_pb2 import Event, SessionLog
from tensorboard.compat.proto.summary_pb2 import HistogramProto, Summary, SummaryMetadata
from tensorboard.compat.proto.tensor_pb2 import TensorProto
from tensorboard.compat.proto.types_pb2 import DT_STRING
from tensorboard.summary.writer.record_writer import RecordWriter

from coop.common.metrics import TAGS
from coop.common.process.files import LineFile, write_atomic
from coop.common.process.untrusted import read_bytes

# The first tags of an episode, of a row of metrics and of the settings, with which each file begins.
EPISODE, ROW, SETTINGS = "charts/episodic_return", "losses/q_values", "hyperparameters"
_FRAME = struct.Struct("<Q4x")  # before a record: its length, and a checksum of that; another follows the record


class Mirror(Protocol):
    """Takes the scalars that TensorBoard's file gets."""

    def hyperparameters(self, values: Mapping[str, Any]) -> None:
        """Add the settings by name."""
        ...

    def scalars(self, values: Mapping[str, float], step: int) -> None:
        """Add scalars by tag; step: the run's environment steps."""
        ...

    def close(self) -> None:
        """Write what is left."""
        ...


class Kept(NamedTuple):
    """What a run has recorded that goes on: lines of episodes.csv and metrics.jsonl, and environment steps."""

    episodes: int
    rows: int
    env_step: int


class TensorBoardWriter:
    """Writes scalars for TensorBoard; while the disk is full they are kept, like a run's lines.

    PyTorch's `SummaryWriter` writes in its own thread, which a full disk would end.
    """

    def __init__(self, folder: Path, mirror: Mirror | None = None, kept: Kept | None = None) -> None:
        """Create a file, and cut those that are there back to `kept`, or to nothing; raises OSError if that fails."""
        self._mirror = mirror
        folder.mkdir(parents=True, exist_ok=True)
        _cut_back(folder, kept or Kept(0, 0, -1))
        name = f"events.out.tfevents.{int(time.time()):010}.{socket.gethostname()}.{os.getpid()}"
        self._file = LineFile(folder / name, go_on=True)
        self._records = RecordWriter(_Records(self._file))
        self._add(Event(wall_time=time.time(), file_version="brain.Event:2"))
        if kept is not None:  # a TensorBoard that has read what was cut off drops it
            start = SessionLog(status=SessionLog.START)
            self._add(Event(wall_time=time.time(), step=kept.env_step + 1, session_log=start))

    @property
    def problem(self) -> str:
        """Why scalars are being kept; empty if none are."""
        return self._file.problem

    def hyperparameters(self, values: Mapping[str, Any]) -> None:
        """Add the settings by name, as a table."""
        if self._mirror is not None:
            self._mirror.hyperparameters(values)
        rows = "".join(f"|{name}|{value}|\n" for name, value in values.items())
        text = f"|setting|value|\n|-|-|\n{rows}"
        value = Summary.Value(
            tag=SETTINGS,
            metadata=SummaryMetadata(plugin_data=SummaryMetadata.PluginData(plugin_name="text")),
            tensor=TensorProto(dtype=DT_STRING, string_val=[text.encode()]),
        )
        self._add(Event(wall_time=time.time(), step=0, summary=Summary(value=[value])))

    def episode(self, episode_return: float, length: int, step: int) -> None:
        """Add a finished episode; step: the run's environment steps at its end, and below."""
        self._scalars({EPISODE: episode_return, "charts/episodic_length": length}, step)

    def evaluation(self, return_mean: float, return_sd: float, step: int) -> None:
        """Add an evaluation of the acting network."""
        self._scalars({"eval/return_mean": return_mean, "eval/return_sd": return_sd}, step)

    def video(self, gif: bytes, step: int) -> None:
        """Add an animated GIF."""
        width, height = (int.from_bytes(gif[place : place + 2], "little") for place in (6, 8))
        image = Summary.Image(width=width, height=height, colorspace=3, encoded_image_string=gif)
        summary = Summary(value=[Summary.Value(tag="eval/video", image=image)])
        self._add(Event(wall_time=time.time(), step=step, summary=summary))

    def metrics(self, row: Mapping[str, Any]) -> None:
        """Add the numbers of a row of metrics.jsonl, and the histograms of its samples."""
        step, q_values = row["env_step"], row[f"q{row['acting']}_mean"]
        numbers = {name: value for name, value in row.items() if name != "env_step" and isinstance(value, int | float)}
        scalars = {TAGS.get(name, f"train/{name}"): value for name, value in numbers.items()}
        self._scalars({ROW: q_values, **scalars}, step)
        self._histogram("replay/sample_age", 0, row["sample_age_histogram"], step)
        self._histogram("replay/reuse", 1, row["reuse_histogram"], step)

    def _scalars(self, values: Mapping[str, float], step: int) -> None:
        if self._mirror is not None:
            self._mirror.scalars(values, step)
        summary = Summary(value=[Summary.Value(tag=name, simple_value=value) for name, value in values.items()])
        self._add(Event(wall_time=time.time(), step=step, summary=summary))

    def _histogram(self, name: str, least: int, counts: Sequence[int], step: int) -> None:
        """Add counts of integers; least: 0 or 1, the smallest. counts: entry b ends below 2^(least + b)."""
        limits = [2.0 ** (least + number) for number in range(len(counts))]
        histogram = HistogramProto(min=least, max=limits[-1], num=sum(counts), bucket_limit=limits, bucket=counts)
        summary = Summary(value=[Summary.Value(tag=name, histo=histogram)])
        self._add(Event(wall_time=time.time(), step=step, summary=summary))

    def close(self) -> None:
        """Write the kept scalars, and close the file."""
        self._file.close()
        if self._mirror is not None:
            self._mirror.close()

    def _add(self, event: Event) -> None:
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
        for record, tag, step in events:
            keep = step <= kept.env_step or tag in ("", SETTINGS)
            if tag in counts:
                counts[tag] += 1
                keep = counts[tag] <= most[tag]
                in_row = keep if tag == ROW else in_row
            elif tag.startswith("replay/"):
                keep = in_row
            if keep:
                whole.append(record)
        if len(left := b"".join(whole)) < len(content):
            write_atomic(path, left)


def _events(content: bytes) -> Iterator[tuple[bytes, str, int]]:
    """(record, first tag or nothing, step) of each whole event in a file."""
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
        yield content[place:end], values[0].tag if values else "", event.step
        place = end
