"""Displays progress: a live picture on a terminal, otherwise a line from time to time."""

from __future__ import annotations

import io
import sys
import time
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import ExitStack, closing, redirect_stderr
from typing import Self

from rich.console import Console, RenderableType
from rich.live import Live

from coop.common.process.console import printable
from coop.common.process.files import NO_SPACE
from coop.common.process.output import out

KEPT = 200  # lines said while the picture fills the screen


class LiveDisplay(ABC):
    """A context manager whose `update` is called repeatedly.

    plain_every: seconds between lines if the output is no terminal; a line is never repeated.
    refreshes: pictures per second on a terminal.
    screen: the picture fills the terminal; the lines said meanwhile are printed at the end, and so are those that
        anything in this process writes to standard error, if that is a terminal.
    """

    def __init__(self, plain_every: float, refreshes: float, *, screen: bool = False) -> None:
        # Decided once: rich writes nothing to what was a terminal and is none any more, and nobody would notice that.
        self._console = Console(file=out(), force_terminal=Console(file=out()).is_terminal)
        self._draws = self._console.is_terminal and not self._console.is_dumb_terminal
        self._live = Live(
            console=self._console, auto_refresh=False, transient=True, screen=screen, redirect_stderr=not screen
        )
        self._screen = screen
        self._redirected = ExitStack()
        self._said: deque[str] = deque(maxlen=KEPT)
        self._every = 1 / refreshes if self._draws else plain_every
        self._due = time.monotonic() + (0 if self._draws else plain_every)
        self._plain = ""

    def __enter__(self) -> Self:
        if self._draws:
            self._live.start()
            if self._screen and sys.stderr is not None and sys.stderr.isatty():
                lines = self._redirected.enter_context(closing(_Lines(self.say, sys.stderr.fileno())))
                self._redirected.enter_context(redirect_stderr(lines))
        return self

    def __exit__(self, *_: object) -> None:
        self._redirected.close()
        if self._live.is_started:
            self._live.stop()
            for text in self._said if self._screen else ():
                self._print(text)

    def update(self) -> None:
        """Show the present state, if it is time."""
        now = time.monotonic()
        if now < self._due:
            return
        self._due = now + self._every
        if self._draws:
            self._live.update(self.picture(), refresh=True)
        else:
            before, self._plain = self._plain, self.line()
            if self._plain != before:
                self._print(self._plain)

    def say(self, text: str) -> None:
        """Print a permanent line."""
        self._said.append(text)
        if not (self._screen and self._live.is_started):
            self._print(text)

    def said(self) -> Sequence[str]:
        """The newest permanent lines."""
        return self._said

    def _print(self, text: str) -> None:
        try:
            self._console.print(printable(text), highlight=False, markup=False, soft_wrap=True)
        except OSError as error:
            if error.errno not in NO_SPACE:  # Python's buffer keeps it for later
                raise

    @abstractmethod
    def picture(self) -> RenderableType:
        """The present state, for a terminal."""

    @abstractmethod
    def line(self) -> str:
        """The present state in one line."""


class _Lines(io.TextIOBase):
    """Gives each line that is written to `say`. Signal handlers write to the file itself."""

    def __init__(self, say: Callable[[str], None], file: int) -> None:
        self._say = say
        self._file = file
        self._rest = ""

    def write(self, text: str) -> int:
        *lines, self._rest = (self._rest + text).split("\n")
        for line in lines:
            self._say(line)
        return len(text)

    def close(self) -> None:
        if self._rest:
            self.write("\n")
        super().close()

    def fileno(self) -> int:
        return self._file
