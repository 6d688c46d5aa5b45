"""What `coop-watch` shows, at any size of the terminal, and as JSON."""

import re

import msgspec
import pytest
from msgspec.structs import replace
from rich.console import Console

from coop.common.errors import BadMessage
from coop.common.messaging import wire
from coop.common.messaging.messages.status import LearnerStatus, Measured, Member, Ratio, Wait
from coop.monitor.display import LiveDisplay
from coop.monitor.screen import RunScreen, sparkline
from coop.monitor.watch import report
from website.assemble import assembled

EVENTS = [f"14:50:{number:02} actor {number} on node{number} (pid {number}) joined" for number in range(30)]
STATUS = LearnerStatus(
    env_steps=31_240,
    total_steps=50_000,
    updates=31_100,
    updates_per_s=1198.2,
    acting=2,
    episodes=412,
    return_mean_100=187.43,
    epsilon=0.05,
    s=0.031,
    waiting="",
    connected={"learner": 1, "replay": 1, "actor": 2},
    warning="",
    missing=[],
    events=list(enumerate(EVENTS)),
    origin="head (pid 1)",
    env="CartPole-v1",
    method="coop",
    seconds=3_725.4,
    seconds_left=61.0,
    env_steps_per_s=1204.0,
    updates_to_swap=12,
    size=500,
    capacity=500,
    return_history=[9.0, 20.0, 187.4],
    ratio=Ratio(1.0, 0.998, 12.0, -64.0, 80.0),
    waits=[Wait("actors", "the learner", 0.63, "inserts are 64 steps ahead of updates")],
    members=[
        Member("actor 2", "actor", "node2", 44, "lost"),
        Member("learner", "learner", "head", 1, "training"),
        Member("replay service", "replay", "head", 2, "serving"),
        Member("actor 0", "actor", "node0", 42, "playing", 612.0),
        Member("actor 1", "actor", "node1", 43, "waiting", 0.0, "the replay service does not answer"),
    ],
    measured=Measured(
        td_error=0.1,
        loss=0.02,
        q_gap=0.31,
        q_abs_mean=42.13,
        q_bound=100.0,
        sample_age_mean=251.0,
        sample_age_p95=478.0,
        reuse_mean=12.1,
        evicted_unsampled=0.0,
        weight_lag_mean=203.0,
    ),
)


def shown(
    status: LearnerStatus | None, width: int, height: int, *, whole: bool = False, silent: float = 0
) -> list[str]:
    """The lines of a screen, without the blanks at their ends."""
    console = Console(width=width, height=height, color_system=None)
    with console.capture() as capture:
        console.print(RunScreen("demo", status, EVENTS, silent, whole))
    return [line.rstrip() for line in capture.get().splitlines()]


def test_a_screen_of_80_by_24() -> None:
    lines = shown(STATUS, 80, 24)
    assert lines == [
        "demo  CartPole-v1, coop, seed 0               1:02:05 so far, about 0:01:01 left",
        "steps       31,240 of 50,000 ━━━━━━━━━━━━━━━━━━━━━━━━━━━━━━━━━━━━━━━━━━━━━  62%",
        "return      187.4, mean of the last 100 of 412 episodes",
        "            ▁▁█ 9.0 to 187.4",
        "acting      network 2 of 2 acts and learns; the roles swap in 12 updates",
        "exploration 5.0% random actions (epsilon), s = 0.031 (error-driven)",
        "speed       1,204 steps/s, 1,198 updates/s",
        "table       500 of 500 transitions; samples 251 steps old (p95 478)",
        "ratio       0.998 updates per step (target 1); acting 12 steps ahead (-64 to 80)",
        "waiting     actors wait for the learner 63% of the time: inserts are 64 steps",
        "            ahead of updates",
        "weight lag  samples were played with weights 203 updates old",
        "Q-values    mean |Q| 42.13 of at most 100; the networks differ by 0.31 (Q gap)",
        "members: 1 replay service, 2 actors --------------------------------------------",
        "actor 2         node2 (pid 44)  lost      does not answer",
        "learner         head (pid 1)    training  1,198 updates/s",
        "replay service  head (pid 2)    serving",
        "actor 0         node0 (pid 42)  playing   612 steps/s",
        "actor 1         node1 (pid 43)  waiting   the replay service does not answer",
        "events -------------------------------------------------------------------------",
        *EVENTS[-4:],
    ]


def test_a_wide_screen_has_two_columns() -> None:
    lines = shown(STATUS, 140, 50)
    assert len(lines) <= 50
    assert lines[0].startswith("demo  CartPole-v1")
    assert " members: 1 replay service, 2 actors -" in lines[0]
    assert lines[1].startswith("steps ")
    assert lines[1].endswith("actor 2         node2 (pid 44)  lost      does not answer")
    assert lines[36].endswith(EVENTS[-1]), "all events, each on a line of its own"


@pytest.mark.parametrize("width", [1, 12, 30, 79, 135, 136, 400])
@pytest.mark.parametrize("height", [1, 5, 13, 24])
def test_any_terminal(width: int, height: int) -> None:
    for status in (STATUS, None):
        lines = shown(status, width, height)
        assert len(lines) <= height
        assert all(len(line) <= width for line in lines)


def test_more_members_than_lines() -> None:
    many = [Member(f"actor {number}", "actor", "n", number, "playing", 5.0) for number in range(40)]
    lines = shown(replace(STATUS, members=[*STATUS.members[:2], *many]), 80, 24)
    assert lines[14:20] == [
        "actor 2  node2 (pid 44)  lost      does not answer",
        "learner  head (pid 1)    training  1,198 updates/s",
        "actor 0  n (pid 0)       playing   5 steps/s",
        "actor 1  n (pid 1)       playing   5 steps/s",
        "actor 2  n (pid 2)       playing   5 steps/s",
        "and 37 more",
    ]
    whole = shown(replace(STATUS, members=many), 80, 24, whole=True)
    assert [line for line in whole if line.startswith("actor")][-1] == "actor 39  n (pid 39)  playing   5 steps/s"
    assert whole[-1] == EVENTS[-1]


def test_what_is_not_there_yet() -> None:
    new = replace(
        STATUS,
        episodes=0,
        return_history=[],
        ratio=None,
        waits=[],
        measured=None,
        seconds_left=None,
        two_networks=False,
        updates_to_swap=1,
        s=0.0,
        warning="mean |Q| is high",
    )
    lines = shown(new, 80, 24, silent=7.2)
    for line in (
        "return      no episode has ended yet",
        "acting      the network is copied to its target in 1 update",
        "exploration 5.0% random actions (epsilon)",
        "table       500 of 500 transitions",
        "ratio       not known without the replay service",
        "waiting     nobody",
        "warning     mean |Q| is high",
        "            the learner has been silent for 7 s",
    ):
        assert line in lines
    assert lines[0].endswith(" 1:02:05 so far")
    assert shown(None, 80, 24)[:2] == ["demo", "waiting for the learner"]
    unmeasured = replace(new, ratio=Ratio(0.25, None, -312.0, -8.0, 12.0))
    assert "ratio       target 0.25 updates per step; no update yet" in shown(unmeasured, 80, 24)


def test_each_that_waits_has_a_line() -> None:
    waits = [Wait("the learner", "actors", 0.4, "no inserts"), Wait("actors", "the learner", 0.05, "no draws")]
    lines = shown(replace(STATUS, waits=waits), 80, 24)
    at = lines.index("waiting     the learner waits for actors 40% of the time: no inserts")
    assert lines[at + 1] == "            actors wait for the learner 5% of the time: no draws"


def test_names_from_other_machines_cannot_steer_the_terminal() -> None:
    evil = replace(STATUS, members=[Member("actor 0", "actor", "\x1b[2J\nnode", 1, "waiting", 0.0, "\x1b]0;x\x07")])
    text = "\n".join(shown(evil, 80, 24))
    assert "?[2J?node (pid 1)  waiting   ?]0;x?" in text
    assert "\x1b" not in text


def test_a_sparkline() -> None:
    assert str(sparkline([1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0], 80)) == "▁▂▃▄▅▆▇█ 1.0 to 8.0"
    assert str(sparkline([3.0, 3.0], 80, "_.-=+*#@")) == "__ 3.0 to 3.0"
    assert str(sparkline(list(map(float, range(100))), 21)) == "▂▂▃▄▅▆▆▇█ 0.0 to 99.0"


def test_the_json_object_is_as_documented() -> None:
    page = assembled("docs/watching.md")
    section = page.partition("## The JSON object")[2].partition("\n## ")[0]
    rows = [line.split(" | ", 1) for line in section.splitlines() if line.startswith("| `")]
    fields = [name for names, _ in rows for name in re.findall(r"`(\w+)`", names)]
    reported = report("demo", STATUS)
    assert sorted(reported) == sorted(fields)
    meanings = {
        name: set(re.findall(r"`(\w+)`", text)) for names, text in rows for name in re.findall(r"`(\w+)`", names)
    }
    assert meanings["ratio"] == reported["ratio"].keys()
    assert meanings["waits"] == reported["waits"][0].keys()
    assert meanings["members"] == reported["members"][0].keys()
    assert reported["measured"].keys() == set(re.findall(r"`measured\.(\w+)`", page))
    assert reported["events"] == EVENTS


class Pictures(LiveDisplay):
    def picture(self) -> str:
        return "the picture"

    def line(self) -> str:
        return "the line"


def test_lines_said_while_the_picture_fills_the_screen(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setenv("TERM", "xterm")
    with Pictures(5.0, 1000, screen=True) as display:
        display.update()
        display.say("an event\x1b[2J")
        assert list(display.said()) == ["an event\x1b[2J"]
    before, left, after = capsys.readouterr().out.partition("\x1b[?1049l")
    assert left, "the second screen"
    assert "the picture" in before
    assert "an event" not in before
    assert after.endswith("an event?[2J\n")
    monkeypatch.setenv("TERM", "dumb")
    with Pictures(0.0, 1000, screen=True) as display:
        display.update()
        display.say("an event")
        assert list(display.said()) == ["an event"], "progress is no event"
    assert capsys.readouterr().out == "the line\nan event\n"


def test_statuses_of_earlier_and_later_versions() -> None:
    """The wire's version did not change with the fields that displays show now."""
    fields = msgspec.to_builtins(STATUS)
    names = list(LearnerStatus.__struct_fields__)
    old = {name: fields[name] for name in names[: names.index("env")]}
    read = LearnerStatus.decode(wire.decode(bytes(wire.encode("status", "r", old))))
    assert (read.updates, read.members, read.measured) == (31_100, [], None)
    assert shown(read, 80, 24)
    new = LearnerStatus.decode(wire.decode(bytes(wire.encode("status", "r", {**fields, "later": 1}))))
    assert new == STATUS
    for name, value in (
        ("members", [fields["members"][0]] * 257),
        ("return_history", [0.0] * 129),
        ("members", [{**fields["members"][0], "state": "dancing"}]),
        ("waits", [{**fields["waits"][0], "share": 1.1}]),
        ("seconds", float("nan")),
    ):
        with pytest.raises(BadMessage, match=f"fields.{name}"):
            LearnerStatus.decode(wire.decode(bytes(wire.encode("status", "r", {**fields, name: value}))))
