"""Who is given which number, and which replay service serves."""

from pathlib import Path

import pytest

import coop.learner.roster
from coop.common.errors import BadMessage, RunError
from coop.common.messaging.members import Origin
from coop.common.messaging.messages.control import Join
from coop.common.messaging.messages.status import MAX_MISSING
from coop.common.messaging.timing import LEASE
from coop.common.process.files import write_atomic
from coop.learner.roster import AlreadyServed, MemberTracker, Roster


def actor(incarnation: int, index: int = -1) -> Join:
    return Join("actor", incarnation, [], index)


def replay(incarnation: int, index: int = -1) -> Join:
    return Join("replay", incarnation, ["tcp/h:1"], index, origin=Origin(f"host{incarnation}", incarnation))


def test_no_number_is_given_twice_also_after_a_restart_of_the_learner(tmp_path: Path) -> None:
    roster = Roster(tmp_path)
    assert [roster.actor(actor(incarnation)) for incarnation in (11, 12, 11)] == [0, 1, 0]
    again = Roster(tmp_path)
    assert again.actor(actor(13)) == 2, "a new one, before the old ones have come back"
    assert again.actor(actor(12, index=1)) == 1, "its own one"
    assert again.actor(actor(14)) == 3
    with pytest.raises(BadMessage, match=r"fields.index: 4; 4 actors have been numbered"):
        again.actor(actor(15, index=4))
    with pytest.raises(BadMessage, match=r"fields.index"):
        again.actor(actor(15, index=2**63 - 1))
    assert again.actor(actor(15)) == 4, "and nobody is locked out"


def test_many_actors_do_not_each_wait_for_the_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    saved: list[bytes] = []
    monkeypatch.setattr(
        coop.learner.roster, "write_atomic", lambda path, data: (saved.append(data), write_atomic(path, data))
    )
    roster = Roster(tmp_path)
    assert [roster.actor(actor(incarnation)) for incarnation in range(1000)] == list(range(1000))
    assert len(saved) < 60
    assert [roster.actor(actor(999)), roster.actor(actor(1000))] == [999, 1000]
    with pytest.raises(BadMessage, match=r"fields.index: 1001; 1001 actors have been numbered"):
        roster.actor(actor(1001, index=1001))
    assert 1001 <= Roster(tmp_path).actor(actor(2000)) <= 1001 * 1.13


def test_one_replay_service_serves(tmp_path: Path) -> None:
    roster = Roster(tmp_path, now=100.0)
    assert roster.replay(replay(1), 100.0, {1}) == 0
    assert roster.replay(replay(1), 101.0, {1}) == 0, "asks again"
    with pytest.raises(AlreadyServed, match=r"the replay service on host1 \(pid 1\) serves this run"):
        roster.replay(replay(2), 200.0, {1, 2})
    with pytest.raises(AlreadyServed):
        roster.replay(replay(2), 101.0 + LEASE / 2, {2})  # its token is gone, but it may still believe that it serves
    assert roster.replay(replay(2), 101.0 + LEASE, {2}) == 1
    with pytest.raises(RunError, match=r"the replay service on host2 \(pid 2\) has taken over from this one"):
        roster.replay(replay(1, index=0), 110.0, {1, 2})


def test_a_learner_that_comes_back_knows_who_serves(tmp_path: Path) -> None:
    roster = Roster(tmp_path, now=0.0)
    roster.replay(replay(1), 0.0, {1})
    roster.replay(replay(2), 10.0, {2})
    again = Roster(tmp_path, now=20.0)
    with pytest.raises(RunError, match="has taken over"):
        again.replay(replay(1, index=0), 20.1, {1})
    with pytest.raises(AlreadyServed, match="host2"):
        again.replay(replay(3), 20.1, {3})
    assert again.replay(replay(2, index=1), 20.2, {2}) == 1
    again.dismiss(1)
    with pytest.raises(AlreadyServed):
        again.replay(replay(3), 20.3, {3})
    again.dismiss(2)
    with pytest.raises(AlreadyServed):
        again.replay(replay(3), 20.3, {2, 3})
    assert again.replay(replay(3), 20.3, {3}) == 2, "nobody waits for one that has left"


def test_a_roster_that_can_t_be_kept_or_read(tmp_path: Path) -> None:
    roster = Roster(tmp_path / "gone")
    with pytest.raises(RunError, match=r"roster\.json"):
        roster.actor(actor(1))
    file = tmp_path / "roster.json"
    file.write_text("{}x")
    with pytest.raises(RunError, match=r"roster\.json"):
        Roster(tmp_path)
    file.unlink()
    Roster(tmp_path).replay(replay(1), 0.0, {1})
    content = file.read_text()
    for damaged in (content.replace('"replays": 1', '"replays": 3'), content.replace("host1", "host2"), "{}"):
        assert damaged != content
        file.write_text(damaged)
        with pytest.raises(RunError, match=r"roster\.json: wrong checksum"):
            Roster(tmp_path)
        assert file.read_text() == damaged


def test_members_that_are_gone_are_not_remembered_for_ever(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of actors that join and are killed, or only ask, neither memory nor a status keeps all."""
    monkeypatch.setattr(coop.learner.roster, "MOST_KEPT", 1100)
    events: list[str] = []
    roster, members = Roster(tmp_path), MemberTracker(events.append)
    there = {0, 1}
    for incarnation in range(3000):
        request = actor(incarnation)
        members.add(request, f"actor {roster.actor(request)}")
        members.token("actor", incarnation, True, 0.0)
        if incarnation not in there:
            members.token("actor", incarnation, False, 0.0)
            members.leaving(incarnation)
        if (kept := members.forget(lambda: there)) is not None:
            roster.forget(kept)
    assert len(members._joined) <= 1100 >= len(roster._actors)
    assert len(members._lost) <= 1100 >= len(members._away)
    assert len(members.missing(0.0)) <= MAX_MISSING
    assert [member.name for member in members.listed(100.0, 8)][:2] == ["actor 0", "actor 1"], "those that are there"
    assert [roster.actor(actor(who)) for who in (0, 1, 20_000)] == [0, 1, 3000]
    members.token("actor", 1, False, 100.0)
    assert events[-1].endswith("does not answer")
    assert (tmp_path / coop.learner.roster.ROSTER).stat().st_size < 200
