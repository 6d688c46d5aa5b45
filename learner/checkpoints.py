"""Saves the checkpoints of a distributed run: begins them between two updates, writes them while training goes on."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from coop.common.errors import CoopError, RunError
from coop.common.messaging.conversation import Conversation, Task, asking, ended
from coop.common.messaging.keys import replay_key
from coop.common.messaging.messages.answers import Retry
from coop.common.messaging.messages.control import Snapshot, Written
from coop.common.messaging.sample_client import SampleClient
from coop.common.messaging.timing import SNAPSHOT_PATIENCE, WRITTEN_PAUSE
from coop.common.messaging.transport import NoAnswer, Node
from coop.common.messaging.wire import Message
from coop.common.process.files import FileDigest
from coop.learner.shared_checkpoints import SharedCheckpoints
from coop.records.checkpoints import DONE, KEPT, checkpoint_numbers
from coop.records.learner_checkpoints import saving_checkpoint
from coop.records.run_directory import RunDirectory


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
        self._writer: Task | None = None
        self._asked = 0

    def begin(self, state: Callable[[], dict[str, Any]]) -> bool:
        """Begin a checkpoint between two updates; do nothing and return False while the last one is being written."""
        if self._writer is not None and self._writer.is_alive():
            return False
        number = self._samples.pin()
        self._writer = self._node.start(
            f"checkpoint {number}", self._trying(number, state(), self._directory.records())
        )
        return True

    def saving(self, state: dict[str, Any]) -> Conversation[None]:
        """Save a checkpoint and wait until it is written.

        Raises:
            RunError: it could not be saved; the message gives the reason.
        """
        yield from self.written()
        yield from self._saving(self._samples.pin(), state, self._directory.records())

    def written(self) -> Conversation[None]:
        """Wait for the checkpoint being written, if there is one."""
        yield from ended(self._writer)

    def _trying(self, number: int, state: dict[str, Any], records: dict[str, FileDigest]) -> Conversation[None]:
        try:
            yield from self._saving(number, state, records)
        except RunError as error:
            self._event(f"{error}; the run goes on without it")

    def _saving(self, number: int, state: dict[str, Any], records: dict[str, FileDigest]) -> Conversation[None]:
        began, run_dir = self._node.now(), self._run_dir
        try:
            try:
                keep = checkpoint_numbers(run_dir, DONE)[-KEPT:]
                snapshot = Snapshot(number, keep, self._node.incarnation, self._asked)
                self._asked += 1
                yield from self._asking(snapshot.encode(self._node.run))
            finally:
                self._samples.release()
            with saving_checkpoint(
                run_dir,
                self._directory.run_id(),
                number,
                state,
                records=records,
                fallbacks=self._directory.fallbacks,
                settings=self._directory.settings,
                keep=True,  # the replay service's part alone may hold more than before
            ):
                written = Written(number).encode(self._node.run)
                while (yield from self._asking(written)).kind == Retry.kind:
                    yield WRITTEN_PAUSE
        except OSError as error:
            raise RunError(f"checkpoint {number} in {run_dir}: {error.strerror or error}") from error
        except CoopError as error:
            raise RunError(f"checkpoint {number}: {error}") from error
        self._shared.finished(number)
        self._event(f"checkpoint {number} saved, {self._node.now() - began:.1f} s")

    def _asking(self, question: bytearray) -> Conversation[Message]:
        """Ask the replay service, which may be restarting, until it answers or `SNAPSHOT_PATIENCE` has passed."""
        deadline = self._node.now() + SNAPSHOT_PATIENCE
        while True:
            try:
                return (yield from asking(self._node, replay_key(self._node, "snapshot"), question))
            except NoAnswer:
                if self._node.now() > deadline:
                    raise
            yield WRITTEN_PAUSE
