"""Follows the status of a run's roles, and displays it."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Protocol, Self

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
from coop.monitor.display import LiveDisplay
from coop.monitor.screen import RunScreen

PLAIN_EVERY = 5.0  # seconds between lines if the output is no terminal


class RunStatus:
    """Follows one run through its learner.

    Args:
        endpoint: of the learner, or of a router connected to it.
        zenoh_config: like the run's roles.

    Attributes:
        run: its name.
        learner: the learner's newest status; None before the first.
    """

    def __init__(self, run: str, endpoint: str, incarnation: int, zenoh_config: Path | None = None) -> None:
        self.run = run
        self.learner: LearnerStatus | None = None
        self._endpoint = endpoint
        self._node = Node(open_session((), (endpoint,), zenoh_config), run, "watch", incarnation)
        self._statuses = self._node.latest(status_key(self._node, "learner"))
        self._updated_at = time.monotonic()

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
            return (
                f"the learner of run {self.run!r} has told nothing within {waited:g} s; it may wait for the other roles"
            )
        return no_learner(self._node, (self._endpoint,), waited)

    def follow_stop(self, stop: Stop) -> None:
        """Set `stop` when the learner ends the run."""
        self._node.follow_stop(stop)

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


class Page(Protocol):
    """A web page, at `url`, that shows a run."""

    url: str

    def show(self, status: LearnerStatus | None, events: Sequence[str], silent: float, ended: str) -> None:
        """Show the newest status; events: newest last. silent: seconds since it. ended: why the run did; else empty."""
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

    def __init__(self, status: RunStatus, page: Page | None = None) -> None:
        super().__init__(PLAIN_EVERY, refreshes=4, screen=True)
        self._page = page
        self._status = status
        self._shown = 0
        self._learner = PeerMonitor("the learner")
        self._over = Stop()  # set at the end of the run
        status.follow_stop(self._over)

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
        return self._over.is_set()

    def update(self) -> None:
        """Show the present status."""
        self._status.refresh()
        for number, line in self._status.events():
            if number > self._shown:
                self._shown = number
                self.say(line)
        learner = self._status.learner
        if learner is not None and not self._over.is_set():
            text = self._learner.check(self._status.learner_is_there(), learner.origin)
            if text:
                self.say(stamped(text))
        self._show_page()
        super().update()

    def _show_page(self) -> None:
        if self._page is not None:
            ended = self._over.reason if self._over.is_set() else ""
            self._page.show(self._status.learner, self.said(), self._status.silent_for(), ended)

    def line(self) -> str:
        """The status in one line."""
        return self._status.line()

    def picture(self) -> RenderableType:
        """The status as a screen."""
        return RunScreen(self._status.run, self._status.learner, self.said(), self._status.silent_for())
