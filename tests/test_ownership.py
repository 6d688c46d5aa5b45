"""Whose a run directory is, who works in it, and which checkpoint a run goes on from."""

import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from commands import Command, run_command, wait_for
from samples import make_segment
from test_checkpoints import CONFIG, save, save_learner

from coop.common.errors import RunError, UsageError
from coop.common.messaging.conversation import drive
from coop.common.messaging.joining import join
from coop.common.messaging.messages.control import Join
from coop.common.messaging.session import open_session
from coop.common.messaging.transport import Node, new_incarnation
from coop.common.process.files import FileDigest, truncate
from coop.common.process.lifecycle import Stop
from coop.common.types import EnvSpec
from coop.learner.join_service import JoinService
from coop.learner.roster import Roster
from coop.learner.shared_checkpoints import SharedCheckpoints
from coop.records.checkpoints import Manifest
from coop.records.locks import INHERITED, RunLock
from coop.records.resumption import Survey, Whole, go_back, survey
from coop.records.run_directory import RunDirectory, claim_run_directory
from coop.records.run_ids import RUN_ID, claim, read_run_id
from coop.records.run_options import RunOptions
from coop.replay.core import ReplayCore
from coop.replay.persistence.checkpoints import ReplayCheckpoints, part_path
from coop.replay.persistence.folder import ReplayFolder
from coop.replay.persistence.journal import Journal, journal_files

pytestmark = pytest.mark.timeout(300)  # several processes a test, also on a busy machine


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def a_replay_folder(folder: Path, spec: EnvSpec, run_id: int = 5, checkpoints: tuple[int, ...] = (500, 1000)) -> None:
    """What a replay service of the run leaves: parts of checkpoints and a journal."""
    core = ReplayCore(CONFIG, spec, Journal(folder / "journal", run_id, 1, keep=True))
    written = ReplayCheckpoints(folder, run_id)
    for number in checkpoints:
        core.insert(make_segment(spec, number))
        save(core, written, number, *checkpoints)


@pytest.mark.parametrize("named", [True, False])
def test_another_run_s_folder_is_refused_and_stays_as_it_is(named: bool, spec: EnvSpec, tmp_path: Path) -> None:
    a_replay_folder(tmp_path, spec, run_id=5)
    if named:
        claim(tmp_path, 5)
    before = contents(tmp_path)
    for resume in (False, True):
        with pytest.raises(RunError, match="belongs to another run than the learner's"):
            ReplayFolder(tmp_path, 6).check(resume=resume)
    assert contents(tmp_path) == before
    with pytest.raises(UsageError, match="holds a run already"):
        ReplayFolder(tmp_path, 5).check(resume=False)
    assert ReplayFolder(tmp_path, 5).check(resume=True) == f"goes on in {tmp_path}"


def test_a_journal_alone_tells_whose_it_is(spec: EnvSpec, tmp_path: Path) -> None:
    a_replay_folder(tmp_path, spec, run_id=5, checkpoints=())
    with pytest.raises(RunError, match="journal: belongs to another run"):
        ReplayFolder(tmp_path, 6).check(resume=True)


def test_parts_of_an_unknown_run_are_refused(tmp_path: Path) -> None:
    part_path(tmp_path, 500).mkdir(parents=True)
    with pytest.raises(RunError, match="do not name their run"):
        ReplayFolder(tmp_path, 5).check(resume=True)


def test_a_new_folder_is_the_run_s_from_its_first_write(tmp_path: Path) -> None:
    folder = ReplayFolder(tmp_path / "new", 5)
    assert folder.check(resume=True).startswith("starts: ")
    assert not folder.path.exists()
    with folder.lock():
        assert read_run_id(folder.path) == 5
        with pytest.raises(RunError, match=rf"in use by coop-replay on .* \(pid {os.getpid()}\)"):
            folder.lock()
    other = ReplayFolder(folder.path, 6)
    with pytest.raises(RunError, match="belongs to another run"):
        other.check(resume=True)
    with pytest.raises(RunError, match="belongs to another run"):
        other.lock()


HOLD = """
import sys
from pathlib import Path
from coop.records.locks import RunLock
with RunLock(Path(sys.argv[1]), "coop-lockstep", ("learner", "replay")).sign():
    print("held", flush=True)
    sys.stdin.read()
"""


def test_a_live_run_directory_is_locked_and_free_at_death(tmp_path: Path) -> None:
    command = [sys.executable, "-c", HOLD, str(tmp_path)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as holder:
        assert holder.stdout is not None
        assert holder.stdout.readline() == "held\n"
        before = contents(tmp_path)
        for roles in (("learner",), ("replay",), ("learner", "replay")):
            with pytest.raises(RunError) as refused:
                RunLock(tmp_path, "coop-learner", roles)
            text = str(refused.value)
            assert text.startswith(f"run directory {tmp_path}: in use by coop-lockstep on ")
            assert text.endswith(f" (pid {holder.pid})")
        assert contents(tmp_path) == before
        holder.send_signal(signal.SIGKILL)
        holder.wait(20)
    with (
        RunLock(tmp_path, "coop-learner", ("learner",)),
        RunLock(tmp_path, "coop-replay", ("replay",)).sign(),
        pytest.raises(RunError, match="in use by coop-replay"),
    ):
        RunLock(tmp_path, "coop-local", ("replay", "learner"))


def test_a_supervisor_s_locks_are_its_children_s_too(tmp_path: Path) -> None:
    command = [sys.executable, "-c", HOLD, str(tmp_path / "run")]
    refused = f"in use by coop-local on {os.uname().nodename} (pid {os.getpid()})"
    with (
        RunLock(tmp_path / "run", "coop-local", ("learner", "replay")).sign() as lock,
        RunLock(tmp_path / "other", "coop-local", ("learner", "replay")).sign() as other,
    ):
        for held, out, problem in (
            (lock.descriptors, "held\n", ""),
            (other.descriptors, "", refused),
            ((), "", refused),
        ):
            environ = {**os.environ, INHERITED: ",".join(map(str, held))}
            child = subprocess.run(
                command, pass_fds=held, env=environ, input="", capture_output=True, text=True, check=False
            )
            assert child.stdout == out, child.stderr
            assert problem in child.stderr


@pytest.mark.parametrize(
    ("name", "flags"),
    [
        ("coop-learner", ["--listen", "tcp/127.0.0.1:0"]),
        ("coop-local", []),
        ("coop-lockstep", []),
    ],
)
def test_commands_respect_the_lock(name: str, flags: list[str], tmp_path: Path) -> None:
    with RunLock(tmp_path, "coop-learner", ("learner",)).sign():
        before = contents(tmp_path)
        done = run_command(name, "--run-dir", tmp_path, "--resume", *flags)
        place = f"coop-learner on {os.uname().nodename} (pid {os.getpid()})"
        assert done.stderr == f"{name}: error: run directory {tmp_path}: in use by {place}\n"
        assert done.returncode == 1
        assert contents(tmp_path) == before


def test_a_run_id_is_drawn_once(tmp_path: Path) -> None:
    first = claim_run_directory(tmp_path, RunOptions().run_config())
    assert claim_run_directory(tmp_path, RunOptions().run_config()) == first
    claim(tmp_path, first)
    with pytest.raises(RunError, match="belongs to another run"):
        claim(tmp_path, first + 1)


def test_resume_without_a_run_starts_and_another_run_is_refused(tmp_path: Path) -> None:
    options = RunOptions(resume=True, run_dir=tmp_path / "run")
    assert options.directory() == tmp_path / "run"
    RunDirectory(tmp_path / "run", options.run_config()).close()
    assert options.directory() == tmp_path / "run"
    for other, words in (
        (replace(options, seed=1), "whose seed is 0"),
        (replace(options, run="b"), "whose run is coop"),
    ):
        with pytest.raises(RunError, match=words):
            other.directory()
    with pytest.raises(UsageError, match=r"learner\.gamma = 0\.5, but 0\.99"):
        replace(options, learner=replace(options.learner, gamma=0.5)).directory()
    claim(tmp_path / "theirs", 5)
    with pytest.raises(RunError, match="a replay service's, of the run with id 5"):
        replace(options, run_dir=tmp_path / "theirs").directory()
    with pytest.raises(UsageError, match="holds a run already"):
        replace(options, resume=False).directory()


def offer(*checkpoints: int, serving: bool = False, incarnation: int = 3) -> Join:
    return Join("replay", incarnation, ["tcp/h:1"], checkpoints=list(checkpoints), serving=serving)


@pytest.mark.parametrize(
    ("mine", "theirs", "number"),
    [
        ((500, 1000), offer(500, 1000), 1000),
        ((500, 1000), offer(0, 500, 1500), 500),
        ((500, 1000), offer(serving=True), 1000),
        ((), offer(), 0),
        ((), offer(500), 0),
    ],
)
def test_the_newest_checkpoint_that_both_hold(mine: tuple[int, ...], theirs: Join, number: int) -> None:
    shared = SharedCheckpoints(mine, "run")
    assert shared.offered(theirs) == (number, False)
    assert drive(shared.decided(), Stop()) == number
    shared.finished(2000)
    assert shared.offered(offer(500, 2000)) == (2000, False), "one that comes back in the middle of the run"


def test_no_checkpoint_in_common() -> None:
    shared = SharedCheckpoints((500, 1000), "runs/a")
    words = (
        rf"runs/a holds checkpoints 500, 1000, the replay service on \S+ \(pid {os.getpid()}\) holds none; "
        "nothing was changed. With --restart the training starts over"
    )
    with pytest.raises(UsageError, match=words):
        shared.offered(offer())
    with pytest.raises(UsageError, match=words):
        drive(shared.decided(), Stop())
    restarted = SharedCheckpoints((500, 1000), "runs/a", restart=True)
    assert restarted.offered(offer(1500)) == (0, True)
    assert drive(restarted.decided(), Stop()) == 0
    assert restarted.offered(offer(incarnation=4)) == (0, False), "one that comes later begins with what it holds"
    stop = Stop()
    stop.set("interrupted")
    assert drive(SharedCheckpoints((500,), "runs/a").decided(), stop) is None


def test_the_learner_goes_back_to_the_checkpoint_that_is_chosen(tmp_path: Path) -> None:
    for number in (500, 1000):
        save_learner(tmp_path, number, {"updates": number})
    (tmp_path / "checkpoints" / "1000" / "learner.pt").write_bytes(b"torn")
    found = survey(tmp_path, every=True)
    assert [each.number for each in found.whole] == [500]
    go_back(found, 500)
    assert not (tmp_path / "checkpoints" / "1000").exists()
    go_back(found, None)
    assert not list((tmp_path / "checkpoints").iterdir())
    moved = sorted(path.parent.name for path in (tmp_path / "aside").rglob("learner.pt"))
    assert moved == ["1000", "500"], "moved aside, not deleted"


def serve_replay(endpoint: str, folder: Path, *flags: str) -> subprocess.CompletedProcess[str]:
    """`coop-replay` in a folder, until it ends by itself or has said that it serves, when it is interrupted."""
    service = Command("coop-replay", "--run", "test", "--connect", endpoint, "--run-dir", folder, *flags)
    wait_for("its end", lambda: service.returncode is not None or "checkpoint" in service.output()[0])
    service.send_signal(signal.SIGINT)
    return service.end(60)


@pytest.fixture
def learner(endpoint: str, spec: EnvSpec) -> Callable[..., SharedCheckpoints]:
    """Makes the join service of a learner that holds the given checkpoints."""

    def receive(node: Node, *held: int, restart: bool = False) -> SharedCheckpoints:
        shared = SharedCheckpoints(held, "runs/a", restart=restart)
        JoinService(node, CONFIG, spec, "layout", 5, shared, Roster(), lambda _: None)
        return shared

    return receive


def test_a_replay_service_refuses_restores_and_begins_anew(
    endpoint: str, spec: EnvSpec, tmp_path: Path, learner: Callable[..., SharedCheckpoints]
) -> None:
    theirs, ours = tmp_path / "theirs", tmp_path / "ours"
    a_replay_folder(theirs, spec, run_id=6)
    a_replay_folder(ours, spec, run_id=5)
    before = contents(theirs)
    with Node(open_session((endpoint,)), "test", "learner", new_incarnation()) as node:
        learner(node, 500, 1000, 1500)
        refused = serve_replay(endpoint, theirs, "--resume")
        assert refused.returncode == 1
        assert "belongs to another run than the learner's" in refused.stderr
        assert contents(theirs) == before
        done = serve_replay(endpoint, ours, "--resume")
        assert "restored checkpoint 1000" in done.stdout, done.stderr
        assert (ours / RUN_ID).read_text() == "5\n"
    shutil.rmtree(part_path(ours, 1000).parent)
    for restart in (False, True):
        with Node(open_session((endpoint,)), "test", "learner", new_incarnation()) as node:
            learner(node, 1000, restart=restart)
            done = serve_replay(endpoint, ours, "--resume")
            if restart:
                assert "no checkpoint to restore" in done.stdout, done.stderr
                assert not list((ours / "checkpoints").iterdir())
                assert not journal_files(ours / "journal")
            else:
                assert done.returncode == 1
                assert (
                    "no checkpoint to resume from: runs/a holds checkpoints 1000, the replay service on " in done.stderr
                )
                assert "holds checkpoints 500; nothing was changed. With --restart" in done.stderr
                assert part_path(ours, 500).exists()


def test_who_only_asks_takes_nobody_s_place(
    nodes: tuple[Node, Node], learner: Callable[..., SharedCheckpoints]
) -> None:
    node, other = nodes
    shared = learner(node, 500)
    assert join(other, Stop(), Join("replay", 1, []), (), 5) is not None
    stop = Stop()
    stop.set("enough")
    assert drive(shared.decided(), stop) is None, "nothing is decided by a question"
    reply = join(other, Stop(), Join("replay", 1, ["tcp/h:1"], checkpoints=[500]), (), 5)
    assert reply is not None
    assert (reply.checkpoint, reply.replay_endpoints) == (500, ["tcp/h:1"])
    again = join(other, Stop(), Join("replay", 2, []), (), 5)
    assert again is not None
    assert again.replay_endpoints == ["tcp/h:1"]


def test_a_file_is_never_lengthened(tmp_path: Path) -> None:
    path = tmp_path / "episodes.csv"
    path.write_bytes(b"twelve bytes")
    with pytest.raises(RunError, match="has 12 bytes, and should have at least 13"):
        truncate(path, 13)
    assert path.read_bytes() == b"twelve bytes"
    truncate(path, 6)
    assert path.read_bytes() == b"twelve"
    (tmp_path / "link").symlink_to(path)
    with pytest.raises(RunError, match="is a link, which is not followed"):
        truncate(tmp_path / "link", 3)
    assert path.read_bytes() == b"twelve"
    config = RunOptions().run_config()
    seals = Manifest(5, 100, {}, {"episodes.csv": FileDigest(99, 0)})
    with pytest.raises(RunError, match="has 6 bytes, and should have at least 99"):
        RunDirectory(tmp_path, config, Survey(tmp_path, (Whole(tmp_path, seals),)), 100)
    assert path.read_bytes() == b"twelve"
