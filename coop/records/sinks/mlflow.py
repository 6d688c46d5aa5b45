"""MLflow (extra `mlflow`): a run's scalars and settings."""

from __future__ import annotations

import importlib
import os
import time
from collections.abc import Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import Any

from coop.common.process.files import make_folder
from coop.records.locks import FileLock
from coop.records.sinks import WELL, Kept, RecordedRun, ScalarSink

BATCH = 1000  # metrics in a request, MLflow's own bound
PARAMS = 100  # settings in a request, likewise
ID = "coop.run_id"  # the tag by which a resumed run is found
ITS_STORE, ITS_EXPERIMENT = "MLFLOW_TRACKING_URI", "MLFLOW_EXPERIMENT_NAME"
RETRIES = "MLFLOW_HTTP_REQUEST_MAX_RETRIES"


class MlflowSink(ScalarSink):
    """One run of MLflow, whose own variables direct it.

    Without MLFLOW_TRACKING_URI the files are in logs/mlruns of the run directory, or in mlruns of the sweep's folder.
    The runs of a sweep are an experiment. A resumed run continues the same run there; what was logged of steps after
    its checkpoint stays. A thread of its own sends, so that training does not wait for a server.
    """

    name, extra, library = "mlflow", "mlflow", "mlflow"

    def __init__(self, run: RecordedRun) -> None:
        """Begin the run, or continue it where the id is known."""
        store = os.environ.get(ITS_STORE)
        folder = run.path.parent / "mlruns" if run.sweep else run.path / "logs" / "mlruns"
        if store is None:
            make_folder(folder)
            os.environ.setdefault("MLFLOW_ALLOW_FILE_STORE", "true")  # MLflow prefers a database, of 40 tables a run
        mlflow = importlib.import_module("mlflow")  # an extra, and it takes seconds
        self._entities = importlib.import_module("mlflow.entities")
        self._client = mlflow.MlflowClient(tracking_uri=store or folder.as_uri())
        with _at_once(), _locked(folder) if store is None else nullcontext():  # or two cells make an experiment each
            self._id = self._begun(run)
        self._status = "KILLED"  # until it is told how the run has ended
        self._late: list[Any] = []
        self._thread = ThreadPoolExecutor(1, "mlflow")
        self._sent: Future[None] | None = None

    def _begun(self, run: RecordedRun) -> str:
        """The id there of a run, which is begun or goes on."""
        experiment = os.environ.get(ITS_EXPERIMENT) or run.sweep or "coop"
        found = self._client.get_experiment_by_name(experiment)
        number = found.experiment_id if found else self._client.create_experiment(experiment)
        run_id = f"{run.run_id:x}"
        there = self._client.search_runs([number], filter_string=f"tags.`{ID}` = '{run_id}'")
        tags = {ID: run_id, **{f"coop.{name}": str(value) for name, value in run.cell.items()}}
        begun = there[0] if there else self._client.create_run(number, run_name=run.path.name, tags=tags)
        self._client.update_run(begun.info.run_id, status="RUNNING")
        return str(begun.info.run_id)

    def begin(self, settings: Mapping[str, Any], kept: Kept | None) -> None:
        """See `Sink`. A parameter of MLflow can't change: those that a resumed run has changed keep their value."""
        there = self._client.get_run(self._id).data.params
        params = [self._entities.Param(name, str(value)) for name, value in settings.items() if name not in there]
        for first in range(0, len(params), PARAMS):
            self._client.log_batch(self._id, params=params[first : first + PARAMS])

    def scalars(self, values: Mapping[str, float], env_step: int) -> None:
        """See `ScalarSink`; raises what the newest request has failed of."""
        now = int(1000 * time.time())
        self._late += [self._entities.Metric(tag, float(value), now, env_step) for tag, value in values.items()]
        if self._sent is None or self._sent.done():
            self._send()

    def conclude(self, summary: Mapping[str, Any]) -> None:
        """See `Sink`."""
        super().conclude(summary)
        ended = str(summary["exit"])
        self._status = "FINISHED" if ended.startswith(WELL) else "KILLED" if ended == "interrupted" else "FAILED"

    def close(self) -> None:
        """See `Sink`."""
        try:
            while self._late or self._sent is not None:
                self._send()
            self._client.set_terminated(self._id, self._status)
        finally:
            self._thread.shutdown()

    def _send(self) -> None:
        """Wait for the last request, and send the next one, if there is anything to send."""
        sent, self._sent = self._sent, None
        if sent is not None:
            sent.result()
        batch, self._late = self._late[:BATCH], self._late[BATCH:]
        if batch:
            self._sent = self._thread.submit(self._client.log_batch, self._id, metrics=batch)


@contextmanager
def _at_once() -> Iterator[None]:
    """Let MLflow try a request three times in some seconds; by itself it tries a server that is away for minutes."""
    own = RETRIES in os.environ
    os.environ.setdefault(RETRIES, "2")
    try:
        yield
    finally:
        if not own:
            os.environ.pop(RETRIES, None)


@contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Hold a lock of a folder, which others of its runs hold for a moment only."""
    while True:
        try:
            lock = FileLock(folder / ".coop.lock")
            break
        except BlockingIOError:
            time.sleep(0.1)
    try:
        yield
    finally:
        lock.release()
