"""How a command ends after a signal, whenever it comes: 130 after SIGINT, 143 after SIGTERM."""

import json
import os
import signal
import subprocess
import sysconfig
import time
from pathlib import Path

import pytest
from commands import Command, lines, run_command, wait_for
from samples import until

from coop.common.errors import PeerLost
from coop.common.process.lifecycle import SUPERVISED, Stop

pytestmark = pytest.mark.timeout(300)  # several processes a test, also on a busy machine

SCRIPTS = Path(sysconfig.get_path("scripts"))
ROLES = ("coop-learner", "coop-replay", "coop-actor", "coop-lockstep", "coop-local", "coop-sweep")


def catches(pid: int, number: int) -> bool:
    """Whether a process has a handler of its own for a signal."""
    status = dict(line.split(":\t", 1) for line in Path(f"/proc/{pid}/status").read_text().splitlines())
    return bool(int(status["SigCgt"], 16) >> (number - 1) & 1)


@pytest.mark.parametrize("name", ROLES)
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_while_a_command_starts(name: str, number: signal.Signals, tmp_path: Path) -> None:
    flags = ["small-buffers"] if name == "coop-sweep" else []
    with subprocess.Popen(
        [SCRIPTS / name, *flags], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=tmp_path
    ) as process:
        deadline = time.monotonic() + 60
        while not catches(process.pid, signal.SIGTERM):
            assert process.poll() is None
            assert time.monotonic() < deadline
            time.sleep(0.001)
        process.send_signal(number)
        out, err = process.communicate(timeout=60)
    assert (process.returncode, out, err) == (128 + number, "", f"{name}: interrupted\n")
    assert not list(tmp_path.iterdir()), "nothing had begun"


INSIDE_WAIT = """
import os, signal, time
from coop.common.process.lifecycle import Stop
stop = Stop()
stop.on_signals()
with stop._changed:  # as `wait` does for a moment
    os.kill(os.getpid(), signal.SIGTERM)
    time.sleep(0.01)
print(stop.wait(60), stop.reason, stop.exit_status)
"""


def test_a_signal_at_the_worst_moment() -> None:
    done = subprocess.run(
        [SCRIPTS / "python", "-c", INSIDE_WAIT], capture_output=True, text=True, timeout=60, check=True
    )
    assert done.stdout == "True interrupted 143\n"


def test_lockstep_says_how_it_ended_and_goes_on(tmp_path: Path) -> None:
    path = tmp_path / "run"
    flags = ("--total-steps", "3000", "--run-dir", str(path), "--resume")
    with Command("coop-lockstep", *flags) as run:
        wait_for("the first metrics", lambda: lines(path / "metrics.jsonl") >= 1)
        run.send_signal(signal.SIGTERM)
        out, err = run.communicate(timeout=60)
    assert (run.returncode, err) == (143, "")
    last = out.splitlines()[-1]
    assert last.startswith("interrupted: ")
    assert last.endswith(f"; coop-lockstep --resume --run-dir {path} goes on")
    assert json.loads((path / "summary.json").read_text())["exit"] == "interrupted"
    done = run_command("coop-lockstep", *flags)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.startswith("resuming from checkpoint ")


@pytest.mark.parametrize("taken", ["SIG_DFL", "lambda *_: None", "lambda *_: sys.exit(0)"])
def test_an_environment_that_takes_the_signals_loses_no_run(taken: str, tmp_path: Path) -> None:
    (tmp_path / "taking.py").write_text(TAKING.format(taken))
    flags = ("--env.id", "taking:Taking-v0", "--total-steps", "100000", "--run-dir", "run")
    with Command("coop-lockstep", *flags, cwd=tmp_path) as run:
        wait_for("the first metrics", lambda: lines(tmp_path / "run" / "metrics.jsonl") >= 1)
        run.send_signal(signal.SIGTERM)
        _, err = run.communicate(timeout=60)
    assert (run.returncode, err) == (143, "")
    assert json.loads((tmp_path / "run" / "summary.json").read_text())["exit"] == "interrupted"


TAKING = """
import signal, sys
import gymnasium
from gymnasium.envs.classic_control import CartPoleEnv
from signal import SIG_DFL

class Taking(CartPoleEnv):
    def __init__(self):
        super().__init__()
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, {})

gymnasium.register("Taking-v0", Taking, max_episode_steps=200)
"""


@pytest.mark.parametrize(("number", "status"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_whole_run_on_one_machine(number: signal.Signals, status: int, tmp_path: Path) -> None:
    path = tmp_path / "run"
    with Command("coop-local", "--total-steps", "100000", "--run-dir", str(path)) as local:
        wait_for("the first metrics", lambda: lines(path / "metrics.jsonl") >= 1)
        local.send_signal(number)
        out, err = local.communicate(timeout=90)
    assert (local.returncode, err) == (status, "")
    assert out.splitlines()[-1].endswith(f"; coop-local --resume --run-dir {path} goes on")
    assert json.loads((path / "summary.json").read_text())["exit"] == "interrupted"


def test_the_first_reason_tells_the_status() -> None:
    stop = Stop()
    stop.set("complete")
    stop.set("interrupted", exit_status=143)
    stop.raise_for_status()
    interrupted = Stop()
    interrupted.set("interrupted", exit_status=143)
    with pytest.raises(SystemExit, match="143"):
        interrupted.raise_for_status()
    lost = Stop()
    lost.set("the learner has gone", failed=True)
    with pytest.raises(PeerLost, match="the learner has gone"):
        lost.raise_for_status()


def test_signals_taken_over_again_and_again_are_taken_back() -> None:
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
    stop = Stop()
    try:
        stop.on_signals()
        ours = signal.getsignal(signal.SIGINT)
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, signal.SIG_IGN)
            until(lambda number=number: not stop.is_set() and signal.getsignal(number) == ours, 5.0)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def test_a_supervisor_that_goes_at_any_time_stops_its_processes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(SUPERVISED, str(os.getppid()))
    stop = Stop()
    assert not stop.is_set()
    monkeypatch.setattr(os, "getppid", lambda: 1)
    until(stop.is_set, 5.0)
    assert (stop.reason, stop.exit_status) == ("the supervisor is gone", 0)


def test_only_a_second_sigint_interrupts_at_once() -> None:
    """A scheduler sends SIGTERM to all processes of a job, and a supervisor among them passes it on as SIGINT."""
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    stop = Stop()
    try:
        stop.on_signals()
        for number in (signal.SIGTERM, signal.SIGINT, signal.SIGTERM):
            signal.raise_signal(number)
        assert (stop.reason, stop.exit_status) == ("interrupted", 143)
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
