"""The product's own classes, which tell the checks what they do."""

from __future__ import annotations

from typing import Any, NamedTuple

from benchmarks.simulate.checks import Checks
from coop.common.transitions import Batch, Drawn, DrawRequest, Segment
from coop.learner.roster import Roster
from coop.learner.trainer import Effects, Trainer
from coop.replay.core import ReplayCore, Reply, RetryLater
from coop.replay.service import ReplayService

CHECKED_EVERY = 12  # inserts between two looks at the whole table


class Watched(NamedTuple):
    """The classes to put in place of the real ones."""

    core: type[ReplayCore]
    service: type[ReplayService]
    roster: type[Roster]


def watched(checks: Checks) -> Watched:
    """Those of a run's replay services and learners."""

    class Core(ReplayCore):
        """See `ReplayCore`."""

        since = 0
        foreign = False  # it holds another run's transitions

        def insert(self, segment: Segment, payload: bytes = b"") -> int | RetryLater:
            if self.foreign:
                return super().insert(segment, payload)
            before, ahead = self.table.inserted, self.limiter.ahead(self.table.inserted, checks.counted(self))
            outcome = super().insert(segment, payload)
            if self.table.inserted > before:
                checks.inserted(before, ahead)
                self.since += 1
                if self.since % CHECKED_EVERY == 0:
                    checks.look_at(self)
            return outcome

        def draw(self, request: DrawRequest) -> Reply | RetryLater:
            if self.foreign:
                return super().draw(request)
            checks.asked(self, request)
            known = request.sequence < checks.counted(self)
            outcome = super().draw(request)
            if not isinstance(outcome, RetryLater):
                checks.drawn(self, request, outcome, known)
            return outcome

    class Service(ReplayService):
        """See `ReplayService`; its core is looked at before it serves."""

        def __init__(self, node: Any, core: Any, *rest: Any, **named: Any) -> None:  # noqa: ANN401
            super().__init__(node, core, *rest, **named)
            core.foreign = checks.strangers.foreign(node.process)
            if not core.foreign:
                checks.service_begins(node.process, core)

    class Members(Roster):
        """See `Roster`; tells whom it admits."""

        def replay(self, *args: Any) -> int:  # noqa: ANN401
            index = super().replay(*args)
            if self._path is not None and not checks.strangers.foreign_folder(self._path.parent):
                checks.serving = self.serving
            return index

    return Watched(Core, Service, Members)


def watched_trainer(checks: Checks, incarnation: int) -> type[Trainer]:
    """That of a learner."""

    class WatchedTrainer(Trainer):
        """See `Trainer`."""

        def __init__(self, *args: Any) -> None:  # noqa: ANN401
            super().__init__(*args)
            checks.trainer_begins(self)

        def train(self, batch: Batch, drawn: Drawn, now: float) -> Effects:
            checks.trains(incarnation, self.agent, batch, drawn)
            effects = super().train(batch, drawn, now)
            checks.trained(self.agent, effects)
            return effects

        def load_state(self, state: dict[str, Any], now: float) -> None:
            super().load_state(state, now)
            checks.restored(self.agent)

    return WatchedTrainer
