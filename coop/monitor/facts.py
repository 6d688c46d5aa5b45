"""What displays say of a run in words; a terminal and a web page say the same."""

from __future__ import annotations

from typing import Any

from coop.common.messaging.messages.status import LearnerStatus, Member, Wait
from coop.common.metrics import METRICS
from coop.common.process.console import averaged_over, counted, printable

SILENT_AFTER = 3.0  # seconds without a status, after which displays say so


def values(status: LearnerStatus) -> dict[str, float]:
    """What is known of the metrics that a status carries, but for lists, by name."""
    found = {}
    for metric in METRICS:
        if metric.field and not metric.listed:
            value: Any = status
            for name in metric.field.split("."):
                value = getattr(value, name, None)
            if value is not None:
                found[metric.name] = value
    return found


def facts(status: LearnerStatus) -> dict[str, str]:
    """The figures of a run by their labels, in the order in which they are shown; lines end with a newline."""
    lines, episodes = _lines(status), status.episodes
    returns = f"{status.return_mean_100:.1f}, mean of {averaged_over(episodes)}"
    shown = {
        "steps": f"{status.env_steps:,} of {status.total_steps:,}",
        "return": returns if episodes else "no episode has ended yet",
        "acting": _acting(status),
        **{label: lines.pop(label) for label in ("exploration", "speed", "table")},
        "ratio": _ratio(status),
        **({"waiting": "\n".join(map(_sentence, status.waits)) or "nobody"} if status.connected else {}),
        **lines,
    }
    return shown | ({"warning": printable(status.warning)} if status.warning else {})


def settings(status: LearnerStatus) -> str:
    """What is trained on what."""
    return printable(f"{status.env}, {status.method}, seed {status.seed}")


def times(status: LearnerStatus) -> str:
    """The time that the run has taken, and what is left of it."""
    left = "" if status.seconds_left is None else f", about {clock(status.seconds_left)} left"
    return f"{clock(status.seconds)} so far{left}"


def progress(status: LearnerStatus) -> float:
    """The share of the run that is done, 0 to 1."""
    return min(1.0, status.env_steps / status.total_steps) if status.total_steps else 0.0


def silence(seconds: float) -> str:
    """That the learner has been silent."""
    return f"the learner has been silent for {seconds:.0f} s"


def place(member: Member) -> str:
    """Where a member runs."""
    return printable(f"{member.host} (pid {member.pid})")


def detail(member: Member, status: LearnerStatus) -> str:
    """What a member does, in words; empty if its state says it all."""
    if member.state == "lost":
        return "does not answer"
    if member.reason:
        return printable(member.reason)
    if member.role == "learner":
        return f"{status.updates_per_s:,.0f} updates/s"
    return "" if member.steps_per_s is None else f"{member.steps_per_s:,.0f} steps/s"


def _acting(status: LearnerStatus) -> str:
    phase = counted(status.updates_to_swap, "update")
    if status.two_networks:
        return f"network {status.acting} of 2 acts and learns; the roles swap in {phase}"
    return f"the network is copied to its target in {phase}"


def _lines(status: LearnerStatus) -> dict[str, str]:
    """The lines that the table of metrics describes, by label."""
    known = values(status)
    if not status.s:
        del known["s"]
    if not status.two_networks:
        known.pop("q_gap", None)
    lines: dict[str, str] = {}
    for metric in METRICS:
        if metric.line and metric.name in known:
            words, before = metric.words.format(known[metric.name]), lines.get(metric.line, "")
            joint = "; " if before and words[0] not in " ," else ""
            lines[metric.line] = f"{before}{joint}{words}"
    return lines


def _ratio(status: LearnerStatus) -> str:
    ratio = status.ratio
    if ratio is None:
        return "not known without the replay service"
    if ratio.measured is None:
        return f"target {ratio.target:g} updates per step; no update yet"
    measured = f"{ratio.measured:.3f} updates per step (target {ratio.target:g})"
    if ratio.ahead is None:
        return measured
    ahead = f"acting {ratio.ahead:,.0f} steps ahead ({ratio.least:,.0f} to {ratio.most:,.0f})"
    return f"{measured}; {ahead}"


def _sentence(wait: Wait) -> str:
    verb = "wait" if wait.who == "actors" else "waits"
    return f"{wait.who} {verb} for {wait.for_whom} {wait.share:.0%} of the time: {printable(wait.reason)}"


def clock(seconds: float) -> str:
    """A time as hours, minutes and seconds."""
    whole = max(0, round(seconds))
    return f"{whole // 3600}:{whole // 60 % 60:02}:{whole % 60:02}"
