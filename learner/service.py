"""Runs a trainer in a distributed run: draws batches, broadcasts weights, writes files, and ends the run."""

from __future__ import annotations

from typing import Any

import msgspec

from coop.common.errors import RunError
from coop.common.messaging.conversation import Conversation, asking
from coop.common.messaging.keys import replay_key, stop_key
from coop.common.messaging.messages.control import EndOfRun
from coop.common.messaging.messages.evaluate import EvaluationRow
from coop.common.messaging.messages.status import LearnerStatus, ReplayStats, StatsQuestion
from coop.common.messaging.sample_client import SampleClient
from coop.common.messaging.timing import FAREWELL, FAREWELL_EVERY, LAST_EVALUATION, REPLAY_BACK, STATUS_EVERY
from coop.common.messaging.transport import NoAnswer, Node
from coop.common.process.console import Console, progress_line
from coop.common.process.lifecycle import Stop
from coop.learner.broadcast import Broadcaster
from coop.learner.checkpoints import Checkpoints
from coop.learner.evaluations import EvaluationInbox
from coop.learner.join_service import JoinService
from coop.learner.status import StatusReporter
from coop.learner.summary import summarise
from coop.learner.trainer import Effects, Trainer
from coop.records.checkpoints import take_request
from coop.records.run_directory import RunDirectory
from coop.records.summaries import Summary


class LearnerService:
    """Trains from a replay service until the run is complete or stopped.

    Args:
        trainer: new, or restored from the same checkpoint as the samples.
    """

    def __init__(
        self,
        node: Node,
        stop: Stop,
        trainer: Trainer,
        directory: RunDirectory,
        samples: SampleClient,
        checkpoints: Checkpoints,
        join_service: JoinService,
        console: Console,
    ) -> None:
        self._node = node
        self._stop = stop
        self._trainer = trainer
        self._agent = trainer.agent
        self._directory = directory
        self._samples = samples
        self._checkpoints = checkpoints
        self._broadcaster = Broadcaster(node, trainer.agent, trainer.drawn.inserted)
        self._evaluations = EvaluationInbox(node, lambda: trainer.drawn.inserted)
        self._status_due = 0.0
        self._reporter = StatusReporter(node, trainer, samples, join_service, console)
        self._join_service = join_service
        self._console = console
        node.presence.on_change(self._on_presence_change)

    def training(self) -> Conversation[Summary]:
        """Train to the end; return the summary that was saved.

        Raises:
            CoopError: the replay service rejected a request, gave an invalid answer, or could not save its state; or
                there is no space for the closing checkpoint or the summary.
        """
        outcome = ""
        try:
            while not (outcome := self._stop.reason if self._stop.is_set() else self._trainer.outcome()):
                yield from self._turn()
            yield from self._saving()
            outcome = self._trainer.diverged or outcome
        except (Exception, SystemExit) as error:  # users' code may raise anything
            outcome = f"failed: {error}"
            raise
        finally:
            yield from self._checkpoints.written()
            try:
                summary = yield from self._finish(outcome or "interrupted")  # by a second SIGINT
            finally:
                self._broadcaster.close()
        return summary

    def status(self) -> LearnerStatus | None:
        """The newest status published; None before the first. May be called by another thread."""
        return self._reporter.status

    def _turn(self) -> Conversation[None]:
        """Do one update if a batch is available."""
        trainer = self._trainer
        got = yield from self._samples.drawing()
        if got is not None:
            batch, drawn = got
            effects = trainer.train(batch, drawn, self._node.now())
            if effects.ids is not None and effects.priorities is not None:
                self._samples.prioritise(effects.ids, effects.priorities)
            self._apply(effects)
            if trainer.checkpoint_due() and self._checkpoints.begin(self._state):
                trainer.checkpoint_begun()
        elif trainer.all_updates_done() and (stats := (yield from self._replay_stats())) is not None:
            self._apply(trainer.receive(msgspec.structs.replace(trainer.drawn, inserted=stats.inserted)))
        if self._broadcaster.due:
            self._broadcaster.publish(trainer.drawn.inserted)
        if got is None and self._join_service.departure.is_due:
            yield from self._saving_for_departure()
        self._record_evaluations()
        if self._node.now() >= self._status_due:
            self._publish_status()

    def _apply(self, effects: Effects) -> None:
        if effects.broadcast:
            self._broadcaster.publish(self._trainer.drawn.inserted)
        self._directory.record(effects.episodes, effects.metrics)

    def _record_evaluations(self) -> None:
        """Write the results that evaluators have sent."""
        for result in self._evaluations.take():
            if isinstance(result, EvaluationRow):
                self._directory.evaluation(result)
            else:
                self._directory.film(result.gif.tobytes(), result.env_step)

    def _publish_status(self) -> None:
        """Publish the status for displays, and repeat the role for actors that missed it."""
        now = self._node.now()
        self._status_due = now + STATUS_EVERY
        if take_request(self._directory.path):
            self._trainer.ask_checkpoint()
        self._broadcaster.publish_role()
        status = self._reporter.publish(now)
        self._console.progress(status.updates, status.waiting, lambda: progress_line(msgspec.structs.asdict(status)))

    def _on_presence_change(self, role: str, incarnation: int, there: bool) -> None:
        """Report at once that a member has come or gone: the loop may be waiting for it."""
        now = self._node.now()
        self._join_service.members.token(role, incarnation, there, now)
        self._reporter.publish_members(now)

    def _saving_for_departure(self) -> Conversation[None]:
        """Save a checkpoint for a replay service that waits for it before leaving."""
        try:
            if self._agent.updates and self._trainer.saveable():
                yield from self._checkpoints.saving(self._state())
        except RunError as error:
            self._console.event(f"{error}; the run goes on without it")
        finally:
            self._join_service.departure.grant()

    def _saving(self) -> Conversation[None]:
        """Save the closing checkpoint, unless there was no update, the agent diverged or the replay service is gone."""
        if not self._agent.updates or not self._trainer.saveable():
            return
        deadline = self._node.now() + (0 if self._stop.is_set() else REPLAY_BACK)
        while (yield from self._replay_stats()) is None:
            if self._node.now() >= deadline:
                return
            yield STATUS_EVERY
        while True:
            serving = self._join_service.serving
            try:
                yield from self._checkpoints.saving(self._state())
            except RunError as error:  # by a replay service that has gone: the next one can
                left = isinstance(error.__cause__, NoAnswer) or self._join_service.serving != serving
                if not left or self._node.now() >= deadline:
                    raise
                yield STATUS_EVERY
            else:
                return

    def _finish(self, outcome: str) -> Conversation[Summary]:
        """Collect the final counters, write the summary, and stop the other roles."""
        self._join_service.departure.end()
        try:
            stats = yield from self._replay_stats()
            steps, lost, duplicates = self._trainer.drawn.inserted, None, None
            if stats is not None:  # of a replay service that may have begun with less than an earlier one held
                lost, duplicates = max(stats.lost, steps - stats.inserted), stats.duplicates
                steps = max(steps, stats.inserted)
            summary = summarise(self._trainer, outcome, self._node.now(), steps, lost, duplicates)
            self._directory.conclude(summary, summary.title)
        finally:
            yield from self._farewell(outcome)
        if self._directory.evaluated:
            self._directory.draw(summary.title)  # again, with what evaluators have sent since
        return summary

    def _replay_stats(self) -> Conversation[ReplayStats | None]:
        question = StatsQuestion().encode(self._node.run)
        try:
            return ReplayStats.decode((yield from asking(self._node, replay_key(self._node, "stats"), question)))
        except NoAnswer:
            return None

    def _state(self) -> dict[str, Any]:
        return {
            **self._trainer.state(self._node.now()),
            "episodes_received": self._samples.episodes,
        }

    def _farewell(self, outcome: str) -> Conversation[None]:
        """Announce the stop until the other roles have gone, or have had the time to go."""
        began, patience = self._node.now(), {"replay": FAREWELL, "actor": FAREWELL, "evaluator": FAREWELL}
        if outcome.startswith("complete"):
            patience["evaluator"] = LAST_EVALUATION
            self._broadcaster.publish(self._trainer.drawn.inserted, wait=True)
        while True:
            self._node.announce(stop_key(self._node), EndOfRun.because(outcome).encode(self._node.run))
            yield FAREWELL_EVERY
            self._record_evaluations()
            alive, seconds = self._node.presence.counts(), self._node.now() - began
            if not any(alive.get(role) and seconds < longest for role, longest in patience.items()):
                return
