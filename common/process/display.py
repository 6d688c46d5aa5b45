"""Displays progress: a live picture on a terminal, otherwise a line from time to time."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from typing import Self

from rich.console import Console, RenderableType
from rich.live import Live


class LiveDisplay(ABC):
    """A context manager whose `update` is called repeatedly.

    plain_every: seconds between lines if the output is no terminal; a line is never repeated.
    refreshes: pictures per second on a terminal.
    """

    def __init__(self, plain_every: float, refreshes: float) -> None:
        self._console = Console()
        self._live = Live(console=self._console, refresh_per_second=refreshes, transient=True)
        self._plain_every = plain_every
        self._due = time.monotonic() + plain_every
        self._plain = ""

    def __enter__(self) -> Self:
        if self._console.is_terminal:
            self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._live.stop()

    def update(self) -> None:
        """Show the present state."""
        if self._console.is_terminal:
            self._live.update(self.picture())
        elif time.monotonic() >= self._due:
            self._due = time.monotonic() + self._plain_every
            before, self._plain = self._plain, self.line()
            if self._plain != before:
                self.say(self._plain)

    def say(self, text: str) -> None:
        """Print a permanent line."""
        self._console.print(text, highlight=False, markup=False, soft_wrap=True)

    @abstractmethod
    def picture(self) -> RenderableType:
        """The present state, for a terminal."""

    @abstractmethod
    def line(self) -> str:
        """The present state in one line."""
