"""What must hold if a second learner starts: in the folder of the first, or of another run of the same name."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from benchmarks.simulate.world import Process
from coop.common.messaging import wire
from coop.common.messaging.messages.weights import Role
from coop.common.messaging.runs import name_of
from coop.common.messaging.wire import Message
from coop.records.run_ids import has_run_id, read_run_id

if TYPE_CHECKING:
    from benchmarks.simulate.checks import Checks


class Strangers:
    """Knows which processes take part in another run of the same name, by the id of the run that they joined."""

    def __init__(self, checks: Checks) -> None:
        self._checks = checks
        self._learners: list[Process] = []  # those of other runs
        self._known: dict[int, Process] = {}  # processes by incarnation
        self._holders: dict[Path, Process] = {}  # the last learner in a folder

    def begins(self, process: Process, *, stranger: bool) -> None:
        """A process has begun; stranger: it is the learner of another run."""
        self._known[process.state["incarnation"]] = process
        if stranger:
            self._learners.append(process)

    def process(self, incarnation: int) -> Process | None:
        """The process of an incarnation."""
        return self._known.get(incarnation)

    def took(self, process: Process, folder: Path) -> None:
        """A learner has got the lock of its folder."""
        other = self._holders.get(folder)
        self._checks.hold("one learner", other is None or not other.alive, f"{process.name} beside another learner")
        self._holders[folder] = process

    def foreign(self, process: Process) -> bool:
        """Whether a process takes part in another run."""
        return bool(self._learners) and (process in self._learners or self._is_theirs(process.state.get("run")))

    def foreign_folder(self, folder: Path) -> bool:
        """Whether a folder is another run's."""
        return bool(self._learners) and has_run_id(folder) and self._is_theirs(read_run_id(folder))

    def _is_theirs(self, run: int | None) -> bool:
        return run is not None and any(each.state.get("run") == run for each in self._learners)

    def answers(self, node: Any, key: str, message: Message) -> None:  # noqa: ANN401
        """A process answers a question: one that was asked in a run is answered in that run alone.

        It may have been asked before the asker had joined one, and come late; then nobody takes the answer.
        """
        asker = self._known.get(message.fields.get("incarnation", message.fields.get("learner")))
        if asker is not None and message.run != name_of(message.run):
            self._together(asker, node.process, f"{node.process.name} answers {asker.name}, {key}")

    def heard(self, node: Any, source: Any, key: str) -> None:  # noqa: ANN401
        """A process has obeyed what another one has broadcast."""
        self._together(node.process, source.process, f"{node.process.name} obeys {source.process.name}, {key}")

    def _together(self, one: Process, other: Process, words: str) -> None:
        if self._learners:
            mine, theirs = one.state.get("run"), other.state.get("run")
            self._checks.hold("one run", mine is None or theirs is None or mine == theirs, f"{words}: another run")


@lru_cache(64)
def acting_of(role: bytes) -> tuple[str, int]:
    """Whose role it is, and the network that acts, from 0 on."""
    message = wire.decode(role)
    return message.run, Role.decode(message).acting - 1
