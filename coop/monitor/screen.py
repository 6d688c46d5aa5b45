"""The screen that shows a run: a renderable for rich, which fits any width and height."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import zip_longest

from msgspec.structs import replace
from rich.console import Console, ConsoleOptions, RenderResult
from rich.text import Text

from coop.common.messaging.messages.status import LearnerStatus
from coop.common.process.console import connected, printable
from coop.monitor.facts import SILENT_AFTER, detail, facts, place, progress, settings, silence, times

FIGURES_WIDTH = 80  # columns of the figures where members and events stand beside them
WIDE = 136  # columns from which they do
GAP = "  "
LABEL = 12  # columns
SHORTEST = 8  # columns of a value, however narrow the terminal
EVENTS_AT_LEAST = 3
LONGEST_HOST = 24  # letters
BLOCKS, BLOCKS_ASCII = "▁▂▃▄▅▆▇█", "_.-=+*#@"
BAR, BAR_ASCII = "━", "="
STYLES = {"lost": "bold red", "waiting": "yellow"}

Lines = list[Text]


@dataclass(frozen=True)
class RunScreen:
    """What is known of a run at one moment.

    run: its name. status: the learner's newest; None before the first. events: newest last. silent: seconds since the
    status. whole: however many lines it takes; otherwise those that fit on the terminal.
    """

    run: str
    status: LearnerStatus | None
    events: Sequence[str]
    silent: float = 0.0
    whole: bool = False

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """Yield the lines."""
        width, height = options.max_width, None if self.whole else options.max_height
        if width < WIDE:
            lines = self._figures(console, options, width)
            lines += self._members_and_events(console, width, None if height is None else height - len(lines))
        else:
            figures = self._figures(console, options, FIGURES_WIDTH)
            others = self._members_and_events(console, width - FIGURES_WIDTH - len(GAP), height)
            lines = _beside(figures, others)
        for line in lines[:height]:
            line.truncate(width, overflow="crop")
            yield line

    def _figures(self, console: Console, options: ConsoleOptions, width: int) -> Lines:
        status = self.status
        if status is None:
            return [Text(printable(self.run), "bold"), Text("waiting for the learner")]
        rows = _rows(status, max(SHORTEST, width - LABEL), ascii_only=options.ascii_only)
        if self.silent > SILENT_AFTER:
            rows.append(("", Text(silence(self.silent), "bold red")))
        lines = [_title(self.run, status, width)]
        for label, value in rows:
            lines += _hanging(console, Text(f"{label:{LABEL}}", "dim"), value, width)
        return lines

    def _members_and_events(self, console: Console, width: int, height: int | None) -> Lines:
        lines, status = [_heading("members", width)], self.status
        if status is not None:
            shown = len(status.members) if height is None else max(1, height - 2 - EVENTS_AT_LEAST)
            lines = [_heading(f"members: {connected(status.connected)}".rstrip(": "), width), *_members(status, shown)]
        lines.append(_heading("events", width))
        events: Lines = []
        for event in self.events:
            clock, _, text = printable(event).partition(" ")
            events += _hanging(console, Text(f"{clock} "), Text(text), width)
        left_out = 0 if height is None else max(0, len(lines) + len(events) - height)
        return lines + events[left_out:]


def _hanging(console: Console, head: Text, text: Text, width: int) -> Lines:
    """A text wrapped beside the end of its first words."""
    parts = text.wrap(console, max(SHORTEST, width - len(head))) or [Text()]
    return [Text.assemble(" " * len(head) if number else head, part) for number, part in enumerate(parts)]


def _title(run: str, status: LearnerStatus, width: int) -> Text:
    right = times(status)
    text = Text.assemble((printable(run), "bold"), f"  {settings(status)}")
    text.truncate(max(0, width - len(right) - 1), pad=True)
    return text.append(f" {right}")


def _rows(status: LearnerStatus, width: int, *, ascii_only: bool) -> list[tuple[str, Text]]:
    """The figures, each with its label; progress as a bar, and the returns as a line."""
    figures = facts(status)
    rows = [("steps", _progress(figures.pop("steps"), progress(status), width, BAR_ASCII if ascii_only else BAR))]
    rows.append(("return", Text(figures.pop("return"))))
    if status.return_history:
        rows.append(("", sparkline(status.return_history, width, BLOCKS_ASCII if ascii_only else BLOCKS)))
    styles = {"waiting": "yellow" if status.waits else "", "warning": "bold yellow"}
    return [*rows, *((label, Text(text, styles.get(label, ""))) for label, text in figures.items())]


def _progress(text: str, done: float, width: int, mark: str) -> Text:
    row = Text(f"{text} ")
    room = max(0, width - len(row) - 6)
    full = round(done * room)
    return row.append(mark * full, "green").append(mark * (room - full), "dim").append(f" {done:4.0%}")


def sparkline(values: Sequence[float], width: int, blocks: str = BLOCKS) -> Text:
    """Values as blocks between the least and the largest, which follow in figures; a sample if there are too many."""
    low, high = min(values), max(values)
    names = f" {low:.1f} to {high:.1f}"
    count = max(1, min(len(values), width - len(names)))
    sample = [values[(number + 1) * len(values) // count - 1] for number in range(count)]
    top = len(blocks) - 1
    line = "".join(blocks[round(top * (value - low) / (high - low)) if high > low else 0] for value in sample)
    return Text.assemble((line, "green"), (names, "dim"))


def _heading(title: str, width: int) -> Text:
    return Text.assemble((f"{title} ", "dim"), ("-" * max(0, width - len(title) - 1), "dim"))


def _members(status: LearnerStatus, shown: int) -> Lines:
    """One line each, for as many as there is room; the last line counts the others."""
    members = status.members
    more = len(members) - shown + 1 if len(members) > shown else 0
    members = members[: len(members) - more]
    names = max((len(member.name) for member in members), default=0)
    places = [place(replace(member, host=member.host[:LONGEST_HOST])) for member in members]
    room = max(map(len, places), default=0)
    lines = []
    for member, where in zip(members, places, strict=True):
        head = f"{printable(member.name):{names}}  {where:{room}}  "
        state = f"{member.state:10}{detail(member, status)}"
        lines.append(Text.assemble(head, (state, STYLES.get(member.state, ""))))
    return [*lines, Text(f"and {more:,} more", "dim")] if more else lines


def _beside(left: Lines, right: Lines) -> Lines:
    """Two columns, the left one `FIGURES_WIDTH` wide."""
    lines = []
    for first, second in zip_longest(left, right, fillvalue=Text()):
        line = first.copy()
        line.truncate(FIGURES_WIDTH, overflow="crop", pad=True)
        lines.append(Text.assemble(line, GAP, second))
    return lines
