"""Follows the status of a run's roles, and displays it."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any, Protocol, Self

import msgspec
from rich.console import RenderableType

from coop.common.errors import BadMessage
from coop.common.messaging.joining import no_learner
from coop.common.messaging.keys import status_key
from coop.common.messaging.messages.status import LearnerStatus
from coop.common.messaging.session import open_session
from coop.common.messaging.transport import Node
from coop.common.process.console import PeerMonitor, progress_line, stamped
from coop.common.process.lifecycle import Stop
from coop.monitor.curves import Point
from coop.monitor.display import LiveDisplay
from coop.monitor.screen import RunScreen

PLAIN_EVERY = 5.0  # seconds between lines if the output is no terminal


class RunStatus:
    """Follows one run through its learner.

    Args:
        endpoint: of the learner, or of a router connected to it.
        zenoh_config: like the run's roles.
        evaluations: returns those of the run, which no status carries.

    Attributes:
        run: its name.
        learner: the learner's newest status; None before the first.
    """

    def __init__(
        self,
        run: str,
        endpoint: str,
        incarnation: int,
        zenoh_config: Path | None = None,
        evaluations: Callable[[], list[Point]] = list,
    ) -> None:
        self.run = run
        self.learner: LearnerStatus | None = None
        self._endpoint = endpoint
        self._node = Node(open_session((), (endpoint,), zenoh_config), run, "watch", incarnation)
        self._statuses = self._node.latest(status_key(self._node, "learner"))
        self._updated_at = time.monotonic()
        self._monitor = PeerMonitor("the learner")
        self._over = Stop()  # set at the end of the run
        self._node.follow_stop(self._over)
        self._evaluations = evaluations

    def refresh(self) -> None:
        """Read the statuses published since the last call."""
        message = self._statuses.poll()
        if message is None:
            return
        try:
            self.learner = LearnerStatus.decode(message)
        except BadMessage:
            return  # an invalid status; the next one may be valid
        self._updated_at = time.monotonic()

    def silent_for(self) -> float:
        """Seconds since the learner's last status, or since the start if there was none."""
        return time.monotonic() - self._updated_at

    def why_nothing(self, waited: float) -> str:
        """Why there has been no status for `waited` seconds, in words."""
        if self.learner_is_there():
            return f"the learner of run {self.run!r} has sent no status in {waited:g} s; it may wait for other roles"
        return no_learner(self._node, (self._endpoint,), waited)

    def loss(self) -> str:
        """See `Followed`."""
        if self.learner is None or self._over.is_set():
            return ""
        return self._monitor.check(self.learner_is_there(), self.learner.origin)

    def over(self) -> str:
        """See `Followed`."""
        return self._over.reason if self._over.is_set() else ""

    def points(self) -> None:
        """See `Followed`."""

    def evaluations(self) -> list[Point]:
        """See `Followed`."""
        return self._evaluations()

    def line(self) -> str:
        """The status in one line."""
        if self.learner is None:
            return "waiting for the learner"
        return stamped(progress_line(msgspec.structs.asdict(self.learner)))

    def events(self) -> Sequence[tuple[int, str]]:
        """The newest lines of the learner's console, with increasing numbers."""
        return self.learner.events if self.learner is not None else []

    def learner_is_there(self) -> bool:
        """True while a learner is connected."""
        return bool(self._node.presence.members("learner"))

    def close(self) -> None:
        """Leave the run."""
        self._node.close()


class Followed(Protocol):
    """A run that is followed, by the messages of its learner or by its files.

    run: its name. learner: its newest status; None before the first.
    """

    run: str
    learner: LearnerStatus | None

    def refresh(self) -> None:
        """Read what is new."""

    def events(self) -> Sequence[tuple[int, str]]:
        """The newest lines of its console, with increasing numbers."""
        ...

    def loss(self) -> str:
        """The line to say now of a learner that has disappeared or is back; empty if there is none."""
        ...

    def silent_for(self) -> float:
        """Seconds since the learner's last status, or since the start if there was none; 0 where none is due."""
        ...

    def over(self) -> str:
        """Why the run has ended; empty while it goes on."""
        ...

    def points(self) -> list[dict[str, float]] | None:
        """What is new of the curves: metrics by name; None for those of the status."""
        ...

    def evaluations(self) -> list[Point]:
        """Environment steps and mean return of each evaluation."""
        ...

    def line(self) -> str:
        """The status in one line."""
        ...


class Page(Protocol):
    """A web page, at `url`, that shows a run."""

    url: str

    def show(
        self,
        status: LearnerStatus | None,
        events: Sequence[str],
        silent: float,
        ended: str,
        points: Iterable[Mapping[str, float]] | None = None,
        evaluations: Sequence[Point] = (),
    ) -> None:
        """Show the newest status; events: newest last. For the others see `Followed`."""
        ...


@contextmanager
def live_page(run: str, address: str) -> Iterator[Page | None]:
    """Serve a run's page at PORT or HOST:PORT; none if that is empty. Raises UsageError if that can't be done."""
    if not address:
        yield None
        return
    from coop.monitor.live_page import LivePage  # noqa: PLC0415 (http.server takes time, and few runs need it)

    with closing(LivePage(run, address)) as page:
        yield page


class Display(LiveDisplay):
    """Displays a status.

    page: shows it too; see `live_page`.
    """

    def __init__(self, status: Followed, page: Page | None = None) -> None:
        super().__init__(PLAIN_EVERY, refreshes=4, screen=True)
        self._page = page
        self._status = status
        self._shown = 0

    def __enter__(self) -> Self:
        super().__enter__()
        if self._page is not None:
            self.say(stamped(f"this screen is also at {self._page.url}"))
        return self

    def __exit__(self, *error: object) -> None:
        self._show_page()  # with the reason of the end
        super().__exit__(*error)

    @property
    def run_is_over(self) -> bool:
        """Whether the learner has said so."""
        return bool(self._status.over())

    def update(self) -> None:
        """Show the present status."""
        status = self._status
        status.refresh()
        for number, line in status.events():
            if number > self._shown:
                self._shown = number
                self.say(line)
        if text := status.loss():
            self.say(stamped(text))
        self._show_page()
        super().update()

    def _show_page(self) -> None:
        if self._page is not None:
            now = self._status
            self._page.show(now.learner, self.said(), now.silent_for(), now.over(), now.points(), now.evaluations())

    def line(self) -> str:
        """The status in one line."""
        return self._status.line()

    def picture(self) -> RenderableType:
        """The status as a screen."""
        return RunScreen(self._status.run, self._status.learner, self.said(), self._status.silent_for())


def report(run: str, status: LearnerStatus) -> dict[str, Any]:
    """The status as plain values: `LearnerStatus`'s fields, with the run's name, and of the events the lines alone."""
    return {"run": run, **msgspec.to_builtins(status), "events": [line for _, line in status.events]}
