"""Follows the status of a run's roles, and displays it; `coop-watch` does so from any machine."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, Self

import msgspec
from rich.console import Console, RenderableType

from coop.common.errors import BadMessage, JoinError, PeerLost, UsageError
from coop.common.messaging.joining import no_learner
from coop.common.messaging.keys import status_key
from coop.common.messaging.messages.status import LearnerStatus
from coop.common.messaging.session import open_session
from coop.common.messaging.transport import Node, new_incarnation
from coop.common.numbers import strict_json
from coop.common.process.cli import parse
from coop.common.process.console import PeerMonitor, progress_line, stamped
from coop.common.process.flags import HttpAddress
from coop.common.process.lifecycle import Stop, run_main
from coop.common.process.untrusted import check_run
from coop.monitor.display import LiveDisplay
from coop.monitor.screen import RunScreen

TICK = 0.1  # seconds
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
            return f"the learner of run {self.run!r} has sent no status in {waited:g} s; it may wait for other roles"
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


@dataclass(frozen=True)
class WatchOptions:
    """Flags of `coop-watch`."""

    run: str = "coop"
    """Name of the run."""
    connect: str = "tcp/127.0.0.1:7447"
    """Endpoint of the learner, for example tcp/head:7447."""
    join_timeout: float = 30.0
    """Seconds to search for the learner before giving up."""
    patience: float = 60.0
    """Seconds to wait for a lost learner before giving up."""
    zenoh_config: Path | None = None
    """A Zenoh configuration file (TLS, access control); the endpoint given as a flag still applies."""
    once: bool = False
    """Print the present status and end."""
    web: HttpAddress = ""
    """Show the screen as a web page too: PORT, on loopback, or HOST:PORT."""
    json: bool = False
    """With --once: print one JSON object instead of the screen; docs/watching.md lists its fields."""

    def __post_init__(self) -> None:
        """Raise UsageError for a name that no run has."""
        check_run(self.run)


def main() -> None:
    """Entry point."""
    run_main("coop-watch", _run)


def _run() -> None:
    options = parse(WatchOptions, "coop-watch", "Show the live status of a run until it ends.")
    if options.json and not options.once:
        raise UsageError("--json: needs --once")
    if options.web and options.once:
        raise UsageError("--web: shows a live run; leave out --once")
    ctrl_c = Stop()
    ctrl_c.on_signals()
    status = RunStatus(options.run, options.connect, new_incarnation(), options.zenoh_config)
    try:
        if options.once:
            _print_once(status, options, ctrl_c)
        else:
            _follow(status, options, ctrl_c)
    finally:
        status.close()


def _follow(status: RunStatus, options: WatchOptions, ctrl_c: Stop) -> None:
    """Show the status until the run ends."""
    ended = Stop()
    status.follow_stop(ended)
    with live_page(options.run, options.web) as page, Display(status, page) as display:
        while not ended.is_set() and not ctrl_c.wait(TICK):
            display.update()
            _check(status, options)
        if status.learner is not None:
            display.say(status.line())
        if ended.is_set():
            display.say(f"the run has ended: {ended.reason}")


def _print_once(status: RunStatus, options: WatchOptions, ctrl_c: Stop) -> None:
    """Wait for a status, and print it."""
    while status.learner is None:
        if ctrl_c.wait(TICK):
            ctrl_c.raise_for_status()
        status.refresh()
        _check(status, options)
    if options.json:
        print(strict_json(report(status.run, status.learner)))
    else:
        lines = [line for _, line in status.events()]
        Console().print(RunScreen(status.run, status.learner, lines, whole=True))


def report(run: str, status: LearnerStatus) -> dict[str, Any]:
    """The status as plain values: `LearnerStatus`'s fields, with the run's name, and of the events the lines alone."""
    return {"run": run, **msgspec.to_builtins(status), "events": [line for _, line in status.events]}


def _check(status: RunStatus, options: WatchOptions) -> None:
    """Raise JoinError or PeerLost if the learner has been silent for too long."""
    silent = status.silent_for()
    if status.learner is None and silent > options.join_timeout:
        raise JoinError(status.why_nothing(options.join_timeout))
    if status.learner is not None and silent > options.patience:
        raise PeerLost(f"the learner of run {options.run!r} has been silent for {options.patience:g} s")
