"""What a run tells of itself: follows the status of every role, and shows it."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import msgspec
from rich.console import Group, RenderableType
from rich.progress_bar import ProgressBar
from rich.table import Table

from common.errors import BadMessage
from common.messaging.keys import status_key
from common.messaging.messages.status import LearnerStatus
from common.messaging.transport import Node, open_session
from common.process.display import LiveDisplay
from common.process.lifecycle import Stop

PLAIN_EVERY = 5.0  # seconds between lines where the output is no terminal


class RunStatus:
    """Follows one run through its learner.

    Args:
        endpoint: of the learner, or of any process that is connected to it and forwards.
        zenoh_config: as for every role of the run.
    """

    def __init__(self, run: str, endpoint: str, incarnation: int, zenoh_config: Path | None = None) -> None:
        self._node = Node(open_session((), (endpoint,), zenoh_config), run, "watch", incarnation)
        self._learner = self._node.latest(status_key(self._node, "learner"))
        self._told_at = time.monotonic()
        self.learner: dict[str, Any] = {}

    def refresh(self) -> None:
        """Take in what has been told since."""
        message = self._learner.take()
        if message is None:
            return
        try:
            self.learner = msgspec.structs.asdict(LearnerStatus.decode(message))
        except BadMessage:
            return  # one that can't be shown; the next may be better
        self._told_at = time.monotonic()

    def silent_for(self) -> float:
        """Seconds since the learner's last status; since the beginning if there was none."""
        return time.monotonic() - self._told_at

    def follow_stop(self, stop: Stop) -> None:
        """Set `stop` when the learner ends the run."""
        self._node.follow_stop(stop)

    def line(self) -> str:
        """The status in one line."""
        told = self.learner
        if not told:
            return "waiting for the learner"
        text = (
            f"step {told['env_steps']:,}/{told['total_steps']:,}  {self.returns()}  "
            f"{told['updates_per_s']:.0f} updates/s  "
            f"network {told['acting']} acts  {self.connected()}"
        )
        return f"{text}  [{told['waiting']}]" if told.get("waiting") else text

    def returns(self) -> str:
        """The mean return, in words."""
        mean, episodes = self.learner["return_mean_100"], self.learner["episodes"]
        return f"return {mean:.1f} (last 100 of {episodes:,} episodes)" if episodes else "no episode has ended yet"

    def missing(self) -> list[str]:
        """Processes that have gone and that nobody has replaced."""
        lost = [name for name in self._node.presence.missing() if name.startswith("learner")]
        return lost or list(self.learner.get("missing", []))

    def connected(self) -> str:
        """Who is connected, in words."""
        counts = self.learner.get("connected", {})
        return ", ".join(f"{counts.get(role, 0)} {role}" for role in ("learner", "replay", "actor"))

    def close(self) -> None:
        """Leave the run."""
        self._node.close()


class Display(LiveDisplay):
    """Shows a status."""

    def __init__(self, status: RunStatus) -> None:
        super().__init__(PLAIN_EVERY, refreshes=4)
        self._status = status
        self._missing: list[str] = []
        self._over = Stop()  # after it they leave
        status.follow_stop(self._over)

    def update(self) -> None:
        """Show what the status says now."""
        self._status.refresh()
        missing = [] if self._over.is_set() else self._status.missing()
        for name in set(missing) - set(self._missing):
            self.say(f"{name} does not answer")
        self._missing = missing
        super().update()

    def line(self) -> str:
        """The status in one line."""
        return self._status.line()

    def picture(self) -> RenderableType:
        """The status as a panel."""
        told = self._status.learner
        table = Table(show_header=False, box=None)
        table.add_column(style="dim")
        table.add_column()
        if not told:
            table.add_row("status", "waiting for the learner")
            return table
        rows = {
            "step": f"{told['env_steps']:,} of {told['total_steps']:,}",
            "episodes": self._status.returns(),
            "updates": f"{told['updates']:,}, {told['updates_per_s']:.0f}/s",
            "acting": f"network {told['acting']}, epsilon {told['epsilon']:.3f}, s {told['s']:.3f}",
            "connected": self._status.connected(),
        }
        if told.get("waiting"):
            rows["waiting"] = str(told["waiting"])
        for name, value in rows.items():
            table.add_row(name, value)
        return Group(table, ProgressBar(total=told["total_steps"], completed=told["env_steps"], width=60))
