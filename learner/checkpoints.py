"""Saves the checkpoints of a distributed run: begins them between two updates, writes them while training goes on."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from coop.common.errors import CoopError, RunError
from coop.common.messaging.keys import replay_key
from coop.common.messaging.messages.answers import Retry
from coop.common.messaging.messages.control import Snapshot, Written
from coop.common.messaging.sample_client import SampleClient
from coop.common.messaging.transport import NoAnswer, Node
from coop.common.messaging.wire import Message
from coop.common.process.files import FileDigest
from coop.common.process.lifecycle import Worker
from coop.learner.shared_checkpoints import SharedCheckpoints
from coop.records.checkpoints import DONE, KEPT, checkpoint_numbers
from coop.records.learner_checkpoints import save_checkpoint
from coop.records.run_directory import RunDirectory

PATIENCE = 5.0  # seconds to wait for the replay service's answer
PAUSE = 0.05  # seconds between requests


class Checkpoints:
    """Saves checkpoints, one at a time.

    If a checkpoint cannot be saved, one event says so, and the run continues without it.

    Args:
        shared: notes the finished checkpoints.
        event: called with a line for each checkpoint.
    """

    def __init__(
        self,
        node: Node,
        directory: RunDirectory,
        samples: SampleClient,
        shared: SharedCheckpoints,
        event: Callable[[str], None],
    ) -> None:
        self._node = node
        self._directory = directory
        self._run_dir = directory.path
        self._event = event
        self._samples = samples
        self._shared = shared
        self._writer = Worker("checkpoints")

    def begin(self, state: Callable[[], dict[str, Any]]) -> bool:
        """Begin a checkpoint between two updates; do nothing and return False while the last one is being written."""
        if self._writer.busy:
            return False
        number, frozen, records = self._samples.pin(), state(), self._directory.records()
        self._writer.begin(lambda: self._try(number, frozen, records))
        return True

    def save(self, state: dict[str, Any]) -> None:
        """Save a checkpoint and wait until it is written.

        Raises:
            RunError: it could not be saved; the message gives the reason.
        """
        self.wait()
        self._save(self._samples.pin(), state, self._directory.records())

    def wait(self) -> None:
        """Wait for the checkpoint being written, if there is one."""
        self._writer.wait()

    def _try(self, number: int, state: dict[str, Any], records: dict[str, FileDigest]) -> None:
        try:
            self._save(number, state, records)
        except RunError as error:
            self._event(f"{error}; the run goes on without it")

    def _save(self, number: int, state: dict[str, Any], records: dict[str, FileDigest]) -> None:
        began = time.monotonic()
        try:
            try:
                self._ask(Snapshot(number, checkpoint_numbers(self._run_dir, DONE)[-KEPT:]).encode(self._node.run))
            finally:
                self._samples.release()
            written = Written(number).encode(self._node.run)
            save_checkpoint(
                self._run_dir,
                self._directory.run_id(),
                number,
                state,
                lambda _: self._wait_for(written),
                records=records,
                fallbacks=self._directory.fallbacks,
                settings=self._directory.settings,
            )
        except OSError as error:
            raise RunError(f"checkpoint {number} in {self._run_dir}: {error.strerror or error}") from error
        except CoopError as error:
            raise RunError(f"checkpoint {number}: {error}") from error
        self._shared.finished(number)
        self._event(f"checkpoint {number} saved, {time.monotonic() - began:.1f} s")

    def _wait_for(self, question: bytearray) -> None:
        while self._ask(question).kind == Retry.kind:
            time.sleep(PAUSE)

    def _ask(self, question: bytearray) -> Message:
        """Ask the replay service, which may be restarting, until it answers or `PATIENCE` seconds have passed."""
        deadline = time.monotonic() + PATIENCE
        while True:
            try:
                return self._node.ask(replay_key(self._node, "snapshot"), question)
            except NoAnswer:
                if time.monotonic() > deadline:
                    raise
            time.sleep(PAUSE)
