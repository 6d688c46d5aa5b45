"""Locks of folders on file systems that several kernels may share, and in containers that look alike."""

import fcntl
import os
import shutil
import signal
import subprocess
import sys
import sysconfig
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest
from samples import until

from coop.common.errors import RunError
from coop.records import locks
from coop.records.locks import RunLock

pytestmark = pytest.mark.timeout(300)  # eight sweeps on a busy machine

APART = ["unshare", "--pid", "--fork", "--kill-child", "--mount-proc"]  # as in a container

# A process on another host: its kernel is another one, and it does not see the locks of this one.
HOST = """
import fcntl, secrets, sys, time
from pathlib import Path
from coop.common.errors import RunError
from coop.records import locks
from coop.common.process.files import LineFile
locks.LOCAL, locks.BEAT, locks.LEASE, locks.SETTLE = frozenset(), 0.1, float(sys.argv[2]), 0.3
boot = secrets.token_hex(8)
locks._place = lambda descriptor: boot
def flock(*_):
    if len(sys.argv) > 3:
        raise OSError(int(sys.argv[3]), "no locks")
fcntl.flock = flock
folder = Path(sys.argv[1])
try:
    with locks.RunLock(folder, "coop-learner", ("learner",)):
        print("held", flush=True)
        lines = LineFile(folder / f"{boot}.csv", go_on=False)
        for line in sys.stdin:
            lines.write(line)
            print("written", flush=True)
except RunError as error:
    print(error, flush=True)
    sys.exit(1)
"""


@contextmanager
def host(folder: Path, lease: float = 1.0, *more: str) -> Iterator[subprocess.Popen[str]]:
    line = [sys.executable, "-c", HOST, str(folder), str(lease), *more]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    with subprocess.Popen(line, text=True, **pipes) as process:  # type: ignore[call-overload]
        try:
            yield process
        finally:
            process.kill()


def said(process: subprocess.Popen[str]) -> str:
    assert process.stdout is not None
    return process.stdout.readline().strip()


@pytest.mark.parametrize("no_locks", [(), ("38",)])  # ENOSYS, as Lustre answers that is mounted without them
def test_a_lease_holds_where_locks_do_not_reach(tmp_path: Path, no_locks: tuple[str, ...]) -> None:
    with host(tmp_path, 1.0, *no_locks) as first:
        assert said(first) == "held"
        with host(tmp_path, 1.0, *no_locks) as second:
            assert said(second).startswith(f"run directory {tmp_path}: in use by coop-learner on ")
        first.kill()
        first.wait()
        began = time.monotonic()
        with host(tmp_path, 1.0, *no_locks) as third:
            assert said(third) == "held", "a dead owner's lease ends"
            assert time.monotonic() - began < 20
            assert third.stdin is not None
            third.stdin.close()
            third.wait(20)
        with host(tmp_path, 60.0) as fourth:
            assert said(fourth) == "held", "who ends well leaves nothing to wait for"


def test_of_many_that_begin_at_once_one_holds(tmp_path: Path) -> None:
    with ExitStack() as stack:
        hosts = [stack.enter_context(host(tmp_path, 5.0)) for _ in range(6)]
        heard = sorted(said(each) for each in hosts)
    assert heard.count("held") == 1, heard
    assert all("in use by" in text for text in heard if text != "held")


def test_an_owner_that_stood_still_writes_no_more(tmp_path: Path) -> None:
    with host(tmp_path) as first:
        assert said(first) == "held"
        first.send_signal(signal.SIGSTOP)
        with host(tmp_path) as second:
            assert said(second) == "held"
            assert first.stdin is not None
            assert first.stderr is not None
            first.stdin.write("late\n")
            first.stdin.flush()
            first.send_signal(signal.SIGCONT)
            assert first.wait(20) == 1
            assert first.stderr.read() == (
                f"error: run directory {tmp_path}: another process has taken it over while this one stood still\n"
            )
            assert "late" not in "".join(path.read_text() for path in tmp_path.glob("*.csv"))
            assert second.stdin is not None
            second.stdin.write("still mine\n")
            second.stdin.flush()
            assert said(second) == "written"


def test_each_write_looks_whether_the_lease_is_still_held(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The thread that touches the file may be the last one to wake."""
    monkeypatch.setattr(locks, "LOCAL", frozenset())
    monkeypatch.setattr(locks, "SETTLE", 0.0)
    monkeypatch.setattr(locks, "BEAT", 1000.0)
    ended: list[int] = []
    monkeypatch.setattr(os, "_exit", ended.append)
    with RunLock(tmp_path, "coop-learner", ("learner",)):
        (tmp_path / ".learner.lock").write_text("coop-learner elsewhere\nanother token\nanother place\n")
        locks.check_held()
        assert ended == [], "not yet, since nobody may take it over so soon"
        monkeypatch.setattr(locks, "LEASE", 0.0)
        locks.check_held()
        assert ended == [1]
        monkeypatch.setattr(locks, "LEASE", 100.0)
    assert (tmp_path / ".learner.lock").read_text().startswith("coop-learner elsewhere"), "it is not ours to release"


def test_a_stopped_owner_on_this_kernel_keeps_its_lock(tmp_path: Path) -> None:
    line = [
        sys.executable,
        "-c",
        HOST.replace("fcntl.flock = flock", "locks.LOCAL = {'any'}; locks._is_local = lambda f: True"),
    ]
    with subprocess.Popen(
        [*line, str(tmp_path), "0.1"], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as owner:
        assert said(owner) == "held"
        owner.send_signal(signal.SIGSTOP)
        time.sleep(0.5)
        with pytest.raises(RunError, match="in use by coop-learner"):
            RunLock(tmp_path, "coop-learner", ("learner",))
        owner.kill()
        owner.wait()
        RunLock(tmp_path, "coop-learner", ("learner",)).release()


def test_no_lock_goes_through_a_link(tmp_path: Path) -> None:
    mine = tmp_path / "mine"
    mine.write_text("precious")
    run = tmp_path / "run"
    run.mkdir()
    (run / ".learner.lock").symlink_to(mine)
    with pytest.raises(RunError, match="a link that leads out of the run"):
        RunLock(run, "coop-learner", ("learner",))
    assert mine.read_text() == "precious"


PODS = 4
GRID = 'methods = ["dqn", "coop"]\nseeds = [0, 1]\n[fixed]\ntotal_steps = 60\n'


def test_sweeps_in_containers_that_look_alike_run_each_cell_once(tmp_path: Path) -> None:
    """As Kubernetes starts them: process 1 of its own namespace, each with the same host name, on one volume."""
    unshare = [*APART, "--uts"]
    if (
        shutil.which("unshare") is None
        or subprocess.run([*unshare, "true"], capture_output=True, check=False).returncode
    ):
        pytest.skip("unshare: not permitted here")
    (tmp_path / "g.toml").write_text(GRID)
    program = Path(sysconfig.get_path("scripts")) / "coop-sweep"
    inside = f"hostname pod; exec {program} {tmp_path}/g.toml --dir {tmp_path}/d --jobs 1"
    with ExitStack() as stack:
        pods = [
            stack.enter_context(
                subprocess.Popen(
                    [*unshare, "sh", "-c", inside], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
                )
            )
            for _ in range(PODS)
        ]
        printed = [pod.communicate(timeout=250)[0] for pod in pods]
    assert [pod.returncode for pod in pods] == [0] * PODS, printed
    ran = sorted(line.partition(": return")[0] for text in printed for line in text.splitlines() if ": return" in line)
    assert len(ran) == len(set(ran)) == 4, ran
    logs = [log.read_text() for log in (tmp_path / "d").glob("*/run.log")]
    assert sum(log.count("complete: 60 steps") for log in logs) == 4  # one process may play several cells
    assert not list((tmp_path / "d").glob("sweep.toml.*"))
    until(lambda: not list((tmp_path / "d").glob("*.part")))


def test_who_looks_from_another_container_sees_who_holds_a_folder(tmp_path: Path) -> None:
    if shutil.which("unshare") is None or subprocess.run([*APART, "true"], capture_output=True, check=False).returncode:
        pytest.skip("unshare: not permitted here")
    look = "import sys, pathlib; from coop.records.locks import holder; print(holder(pathlib.Path(sys.argv[1])))"
    line = [*APART, sys.executable, "-c", look, str(tmp_path)]
    lock = RunLock(tmp_path, "coop-learner", ("learner",)).sign()
    seen = subprocess.run(line, capture_output=True, text=True, check=True).stdout
    assert seen.startswith("('coop-learner on ")
    assert seen.endswith("True)\n")
    killed = (tmp_path / ".learner.lock").read_bytes()
    lock.release()
    (tmp_path / ".learner.lock").write_bytes(killed)
    assert subprocess.run(line, capture_output=True, text=True, check=True).stdout.endswith("False)\n")


def test_who_looks_keeps_nobody_out(tmp_path: Path) -> None:
    RunLock(tmp_path, "coop-learner", ("learner",)).sign().release()
    with Path(tmp_path / ".learner.lock").open("rb") as looking:
        fcntl.flock(looking, fcntl.LOCK_SH)
        timer = threading.Timer(locks.LOOK, lambda: fcntl.flock(looking, fcntl.LOCK_UN))
        timer.start()
        RunLock(tmp_path, "coop-learner", ("learner",)).release()
        timer.join()


def test_a_child_that_users_code_has_left_holds_no_folder(tmp_path: Path) -> None:
    lock = RunLock(tmp_path, "coop-lockstep", ("learner",)).sign()
    left, asked = os.pipe()
    child = os.fork()
    if not child:
        os.close(asked)
        os.read(left, 1)
        os._exit(0)
    lock.release()
    try:
        RunLock(tmp_path, "coop-lockstep", ("learner",)).release()
    finally:
        os.close(asked)
        os.waitpid(child, 0)
        os.close(left)
