"""What consoles and displays say of the members of a run, of its progress and of a stall."""

import re

import pytest
from msgspec.structs import replace

from coop.common.messaging.members import Origin
from coop.common.messaging.messages.control import Join
from coop.common.messaging.timing import FORGOTTEN
from coop.common.process.console import RECENT, STALL_AFTER, Console, PeerMonitor, StallDetector, counted, progress_line
from coop.learner.roster import MemberTracker

STATUS = {
    "env_steps": 9964,
    "total_steps": 1_000_000,
    "updates_per_s": 247.3,
    "acting": 2,
    "return_mean_100": 175.12,
    "episodes": 133,
    "connected": {"learner": 1, "replay": 1, "actor": 2},
    "missing": [],
    "warning": "",
    "waiting": "",
}


@pytest.mark.parametrize(
    ("changes", "line"),
    [
        ({}, "step 9,964/1,000,000  return 175.1 (the last 100 of 133 episodes)  247 updates/s  network 2 acts  "
             "1 replay service, 2 actors"),
        ({"episodes": 52, "connected": {"actor": 1}, "waiting": "x"},
         "step 9,964/1,000,000  return 175.1 (52 episodes)  247 updates/s  network 2 acts  "
         "0 replay services, 1 actor  [x]"),
        ({"warning": "w"}, "step 9,964/1,000,000  return 175.1 (the last 100 of 133 episodes)  247 updates/s  "
         "network 2 acts  1 replay service, 2 actors  warning: w"),
        ({"missing": ["actor 0 on act (pid 8)"]},
         "step 9,964/1,000,000  return 175.1 (the last 100 of 133 episodes)  247 updates/s  network 2 acts  "
         "1 replay service, 2 actors  lost: actor 0 on act (pid 8)"),
        ({"episodes": 1}, "step 9,964/1,000,000  return 175.1 (1 episode)  247 updates/s  network 2 acts  "
         "1 replay service, 2 actors"),
        ({"episodes": 0, "env_steps": 0}, "step 0/1,000,000  no episode has ended yet  247 updates/s  network 2 acts  "
         "1 replay service, 2 actors"),
    ],
)  # fmt: skip
def test_the_progress_line(changes: dict[str, object], line: str) -> None:
    assert progress_line({**STATUS, **changes}) == line


def test_numbers_with_nouns() -> None:
    assert [counted(number, "actor") for number in (0, 1, 2, 1000)] == [
        "0 actors",
        "1 actor",
        "2 actors",
        "1,000 actors",
    ]


def test_what_others_wrote_forges_no_line(capsys: pytest.CaptureFixture[str]) -> None:
    console = Console()
    members = MemberTracker(console.event)
    members.add(Join("actor", 2, [], origin=Origin("act\n12:00:00 complete\x1b[2J\u202e", 8)), "actor 0")
    printed = capsys.readouterr().out
    assert printed[8:] == " actor 0 on act?12:00:00 complete?[2J? (pid 8) joined\n"
    assert console.recent()[0][1] == printed[:-1]


def test_members_come_and_go() -> None:
    events: list[str] = []
    members = MemberTracker(events.append)

    def new_events() -> list[str]:
        new = list(events)
        events.clear()
        return new

    members.token("replay", 1, True, 0.0)
    service = Join("replay", 1, ["tcp/rep:1"], origin=Origin("rep", 7))
    actor = Join("actor", 2, [], origin=Origin("act", 8))
    members.add(service, "replay service")
    members.add(replace(service, index=0), "replay service")  # asks each moment
    members.add(actor, "actor 0")
    assert new_events() == [
        "replay service on rep (pid 7) joined; it listens on tcp/rep:1",
        "actor 0 on act (pid 8) joined",
    ]
    members.token("actor", 1, False, 1.0)  # as a holder of an actor's certificate may declare
    members.token("route", 2, False, 1.0)
    members.token("actor", 2, False, 1.0)
    members.token("actor", 99, False, 1.0)  # one that never joined
    assert new_events() == ["actor 0 on act (pid 8) does not answer"]
    assert members.missing(1.0) == ["actor 0 on act (pid 8)"]
    members.token("actor", 2, True, 2.0)
    assert new_events() == ["actor 0 on act (pid 8) is back"]
    assert members.missing(2.0) == []
    members.token("replay", 1, False, 3.0)
    members.token("actor", 2, False, 3.0)
    new_events()
    members.add(replace(actor, incarnation=3, origin=Origin("act", 9)), "actor 1")
    assert members.missing(3.0) == ["replay service on rep (pid 7)"], "another one has taken the actor's place"
    assert members.missing(3.0 + FORGOTTEN) == []
    new_events()
    members.token("actor", 2, True, 4.0)
    assert new_events() == ["actor 0 on act (pid 8) is back"], "although another one had taken its place"
    members.leaving(2)
    members.token("actor", 2, False, 4.0)
    assert new_events() == ["actor 0 on act (pid 8) left"]
    members.add(replace(actor, index=0), "actor 0")
    assert new_events() == ["actor 0 on act (pid 8) is back"]


def test_a_standstill_is_told_once() -> None:
    look = StallDetector().check
    assert look(0.0, 5, "r") == ""
    assert look(STALL_AFTER - 0.1, 5, "r") == ""
    assert look(STALL_AFTER, 5, "") == "", "nothing is known to be waited for"
    assert look(STALL_AFTER, 5, "because") == "waiting: because"
    assert look(STALL_AFTER + 9, 5, "because of another reason") == ""
    assert look(STALL_AFTER + 10, 6, "") == "goes on"
    assert look(STALL_AFTER + 10, 7, "") == ""
    assert look(2 * STALL_AFTER + 9.9, 7, "again") == ""
    assert look(2 * STALL_AFTER + 10, 7, "again") == "waiting: again"


def test_others_go_out_of_sight_and_come_back() -> None:
    look = PeerMonitor("the learner").check
    assert look(False, "") == "", "not there yet"
    assert look(True, "head (pid 1)") == ""
    assert look(True, "head (pid 1)") == ""
    assert look(False, "head (pid 1)") == "the learner on head (pid 1) does not answer"
    assert look(False, "head (pid 1)") == ""
    assert look(True, "head (pid 1)") == "the learner on head (pid 1) is back"
    assert look(True, "head (pid 1)") == ""
    assert look(True, "head (pid 2)") == "the learner on head (pid 2) is back", "so soon that nobody missed it"


def test_events_have_a_time_and_a_number(capsys: pytest.CaptureFixture[str]) -> None:
    console = Console()
    for number in range(20):
        console.event(f"event {number}")
    lines = capsys.readouterr().out.splitlines()
    assert all(re.fullmatch(r"\d\d:\d\d:\d\d event \d+", line) for line in lines)
    recent = console.recent()
    assert len(recent) == RECENT
    assert [line for _, line in recent] == lines[-len(recent) :]
    assert [number for number, _ in recent] == sorted({number for number, _ in recent})
