"""The screen that shows a run: a renderable for rich, which fits any width and height."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import zip_longest

from rich.console import Console, ConsoleOptions, RenderResult
from rich.text import Text

from common.messaging.messages.status import LearnerStatus, Member, Wait
from common.process.console import connected, counted
from common.process.display import printable
from common.returns import RETURN_WINDOW

FIGURES_WIDTH = 80  # columns of the figures where members and events stand beside them
WIDE = 136  # columns from which they do
GAP = "  "
LABEL = 12  # columns
SHORTEST = 8  # columns of a value, however narrow the terminal
SILENT_AFTER = 3.0  # seconds without a status
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
        if status.warning:
            rows.append(("warning", Text(printable(status.warning), "bold yellow")))
        if self.silent > SILENT_AFTER:
            rows.append(("", Text(f"the learner has been silent for {self.silent:.0f} s", "bold red")))
        lines = [_title(self.run, status, width)]
        for label, value in rows:
            lines += _hanging(console, Text(f"{label:{LABEL}}", "dim"), value, width)
        return lines

    def _members_and_events(self, console: Console, width: int, height: int | None) -> Lines:
        members = self.status.members if self.status else []
        title = f"members: {connected(self.status.connected)}" if self.status else "members"
        shown = len(members) if height is None else max(1, height - 2 - EVENTS_AT_LEAST)
        lines = [_heading(title, width), *_members(members, shown, self.status), _heading("events", width)]
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
    left = f"  {status.env}, {status.method}, seed {status.seed}"
    if status.seconds_left is None:
        right = f"{_clock(status.seconds)} so far"
    else:
        right = f"{_clock(status.seconds)} so far, about {_clock(status.seconds_left)} left"
    text = Text.assemble((printable(run), "bold"), printable(left))
    text.truncate(max(0, width - len(right) - 1), pad=True)
    return text.append(f" {right}")


def _rows(status: LearnerStatus, width: int, *, ascii_only: bool) -> list[tuple[str, Text]]:
    """The figures, each with its label."""
    lasting = "" if status.episodes <= RETURN_WINDOW else f"the last {RETURN_WINDOW} of "
    mean = f"{status.return_mean_100:.1f}, mean of {lasting}{counted(status.episodes, 'episode')}"
    rows = [
        ("steps", _progress(status, width, BAR_ASCII if ascii_only else BAR)),
        ("return", Text(mean if status.episodes else "no episode has ended yet")),
    ]
    if status.return_history:
        rows.append(("", sparkline(status.return_history, width, BLOCKS_ASCII if ascii_only else BLOCKS)))
    phase = counted(status.updates_to_swap, "update")
    if status.two_networks:
        acting = f"network {status.acting} of 2 acts and learns; the roles swap in {phase}"
    else:
        acting = f"the network is copied to its target in {phase}"
    chance = f"{status.epsilon:.1%} random actions (epsilon)"
    driven = f", s = {status.s:.3g} (error-driven)" if status.s else ""
    rows += [
        ("acting", Text(acting)),
        ("exploration", Text(chance + driven)),
        ("speed", Text(f"{status.env_steps_per_s:,.0f} steps/s, {status.updates_per_s:,.0f} updates/s")),
        ("table", Text(_table(status))),
        ("ratio", Text(_ratio(status))),
        ("waiting", _waits(status)),
    ]
    if (measured := status.measured) is not None:
        bound = "" if measured.q_bound is None else f" of at most {measured.q_bound:.4g}"
        gap = f"; the networks differ by {measured.q_gap:.3g} (Q gap)" if status.two_networks else ""
        rows += [
            ("weight lag", Text(f"samples were played with weights {measured.weight_lag_mean:,.0f} updates old")),
            ("Q-values", Text(f"mean |Q| {measured.q_abs_mean:.4g}{bound}{gap}")),
        ]
    return rows


def _progress(status: LearnerStatus, width: int, mark: str) -> Text:
    done = min(1.0, status.env_steps / status.total_steps) if status.total_steps else 0.0
    text = Text(f"{status.env_steps:,} of {status.total_steps:,} ")
    room = max(0, width - len(text) - 6)
    full = round(done * room)
    return text.append(mark * full, "green").append(mark * (room - full), "dim").append(f" {done:4.0%}")


def sparkline(values: Sequence[float], width: int, blocks: str = BLOCKS) -> Text:
    """Values as blocks between the least and the largest, which follow in figures; a sample if there are too many."""
    low, high = min(values), max(values)
    names = f" {low:.1f} to {high:.1f}"
    count = max(1, min(len(values), width - len(names)))
    sample = [values[(number + 1) * len(values) // count - 1] for number in range(count)]
    top = len(blocks) - 1
    line = "".join(blocks[round(top * (value - low) / (high - low)) if high > low else 0] for value in sample)
    return Text.assemble((line, "green"), (names, "dim"))


def _table(status: LearnerStatus) -> str:
    text = f"{status.size:,} of {status.capacity:,} transitions"
    if status.measured is not None:
        text += (
            f"; samples {status.measured.sample_age_mean:,.0f} steps old (p95 {status.measured.sample_age_p95:,.0f})"
        )
    return text


def _ratio(status: LearnerStatus) -> str:
    ratio = status.ratio
    if ratio is None:
        return "not known without the replay service"
    if ratio.measured is None:
        return f"target {ratio.target:g} updates per step; no update yet"
    ahead = f"acting {ratio.ahead:,.0f} steps ahead ({ratio.least:,.0f} to {ratio.most:,.0f})"
    return f"{ratio.measured:.3f} updates per step (target {ratio.target:g}); {ahead}"


def _waits(status: LearnerStatus) -> Text:
    return Text("\n".join(map(_sentence, status.waits)), "yellow") if status.waits else Text("nobody")


def _sentence(wait: Wait) -> str:
    verb = "wait" if wait.who == "actors" else "waits"
    return f"{wait.who} {verb} for {wait.for_whom} {wait.share:.0%} of the time: {printable(wait.reason)}"


def _heading(title: str, width: int) -> Text:
    return Text.assemble((f"{title} ", "dim"), ("-" * max(0, width - len(title) - 1), "dim"))


def _members(members: Sequence[Member], shown: int, status: LearnerStatus | None) -> Lines:
    """One line each, for as many as there is room; the last line counts the others."""
    more = len(members) - shown + 1 if len(members) > shown else 0
    members = members[: len(members) - more]
    names = max((len(member.name) for member in members), default=0)
    places = [printable(f"{member.host[:LONGEST_HOST]} (pid {member.pid})") for member in members]
    room = max(map(len, places), default=0)
    lines = []
    for member, place in zip(members, places, strict=True):
        detail = printable(member.reason)
        if member.state == "lost":
            detail = "does not answer"
        elif member.role == "learner" and not detail and status is not None:
            detail = f"{status.updates_per_s:,.0f} updates/s"
        elif member.steps_per_s is not None and not detail:
            detail = f"{member.steps_per_s:,.0f} steps/s"
        style = STYLES.get(member.state, "")
        head = f"{printable(member.name):{names}}  {place:{room}}  "
        lines.append(Text.assemble(head, (f"{member.state:10}{detail}", style)))
    return [*lines, Text(f"and {more:,} more", "dim")] if more else lines


def _beside(left: Lines, right: Lines) -> Lines:
    """Two columns, the left one `FIGURES_WIDTH` wide."""
    lines = []
    for first, second in zip_longest(left, right, fillvalue=Text()):
        line = first.copy()
        line.truncate(FIGURES_WIDTH, overflow="crop", pad=True)
        lines.append(Text.assemble(line, GAP, second))
    return lines


def _clock(seconds: float) -> str:
    whole = max(0, round(seconds))
    return f"{whole // 3600}:{whole // 60 % 60:02}:{whole % 60:02}"
