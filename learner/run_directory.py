"""The files of a run: config, episodes, metrics, TensorBoard, summary and the learning curve."""

from __future__ import annotations

import csv
import json
import os
import secrets
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from torch.utils.tensorboard import SummaryWriter

from common.config import RunConfig, to_toml
from common.errors import RunError
from common.experience import EpisodeRecord
from common.files import write_whole

EPISODE_FIELDS = (
    "episode", "env_step", "update", "actor", "stream", "return", "length",
    "epsilon", "s", "q1_mean", "q2_mean", "param_version",
)  # fmt: skip
RUN_ID = "run-id"


class RunDirectory:
    """Writes a run's files as the run goes on; every line is complete on disk when its call returns."""

    def __init__(self, path: Path, config: RunConfig, sizes: dict[str, int] | None = None) -> None:
        """Begin a run's files, or go on with those cut back to `sizes` in bytes; RunError where that can't be."""
        self.path = path
        try:
            path.mkdir(parents=True, exist_ok=True)
            write_whole(path / "config.toml", to_toml(config).encode())
            for name, size in (sizes or {}).items():
                os.truncate(path / name, size)
            mode = "w" if sizes is None else "a"
            self._episodes = (path / "episodes.csv").open(mode, newline="", encoding="utf-8", buffering=1)
            self._metrics = (path / "metrics.jsonl").open(mode, encoding="utf-8", buffering=1)
        except OSError as error:
            raise RunError(f"run directory {path}: {error.strerror or error}") from error
        self._csv = csv.writer(self._episodes, lineterminator="\n")
        if sizes is None:
            self._csv.writerow(EPISODE_FIELDS)
        self._board = SummaryWriter(str(path / "tb"))

    def run_id(self) -> int:
        """The random id of this run, drawn when it began, which tells it from others of its name; raises RunError."""
        path = self.path / RUN_ID
        try:
            if not path.exists():
                write_whole(path, f"{secrets.randbits(63)}\n".encode())
        except OSError as error:
            raise RunError(f"{path}: {error}") from error
        return read_run_id(self.path)

    def episode(self, number: int, record: EpisodeRecord, update: int, s: float) -> None:
        """Add a line to episodes.csv."""
        end = record.end
        place = (number, record.env_step, update, f"{record.actor:x}", record.stream)
        values = (f"{value:.6g}" for value in (end.epsilon, s, end.q1_mean, end.q2_mean))
        self._csv.writerow((*place, f"{end.episode_return:g}", end.length, *values, end.param_version))
        self._board.add_scalar("episode/return", end.episode_return, record.env_step)

    def metrics(self, row: dict[str, Any]) -> None:
        """Add a line to metrics.jsonl, and the same to TensorBoard."""
        self._metrics.write(json.dumps(row) + "\n")
        for name, value in row.items():
            if name not in ("time", "env_step"):
                self._board.add_scalar(f"train/{name}", value, row["env_step"])

    def summary(self, values: dict[str, Any]) -> None:
        """Write summary.json, whole or not at all."""
        write_whole(self.path / "summary.json", f"{json.dumps(values, indent=2)}\n".encode())

    def sizes(self) -> dict[str, int]:
        """How long the files that grow are now, in bytes."""
        self.flush()
        return {name: (self.path / name).stat().st_size for name in ("episodes.csv", "metrics.jsonl")}

    def flush(self) -> None:
        """Hand everything written so far to the operating system."""
        self._episodes.flush()
        self._metrics.flush()

    def close(self) -> None:
        """Flush and close all files."""
        self._episodes.close()
        self._metrics.close()
        self._board.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def read_run_id(run_dir: Path) -> int:
    """The id of the run in a directory; raises RunError."""
    path = run_dir / RUN_ID
    try:
        return int(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise RunError(f"{path}: {error}") from error
