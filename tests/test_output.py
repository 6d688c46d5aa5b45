"""Output whose reader or terminal goes away, descriptors that are closed, and SIGHUP: no run is lost, nothing fails."""

import json
import os
import pty
import select
import signal
import subprocess
import sys
import sysconfig
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest
from commands import Command, run_for_a_line, wait_for

from coop.common.process.lifecycle import Stop
from coop.records.learner_checkpoints import newest_checkpoint

pytestmark = pytest.mark.timeout(300)  # several processes a test, also on a busy machine

SCRIPTS = Path(sysconfig.get_path("scripts"))
SMALL = "--replay.capacity 100 --replay.learning-starts 40 --network.hidden 8"
SHORT, LONG = f"{SMALL} --total-steps 300", f"{SMALL} --total-steps 1000000"
VARIABLES = {**os.environ, "OMP_NUM_THREADS": "1", "PATH": f"{SCRIPTS}:{os.environ['PATH']}"}
ENVS = """
import os, sys
import gymnasium
from gymnasium.envs.classic_control import CartPoleEnv

class Closing(CartPoleEnv):
    def __init__(self):
        super().__init__()
        sys.stdout.close()
        sys.stdout = sys.stderr = None
        os.close(1)

class Tidy(CartPoleEnv):
    def __init__(self, late=False):
        super().__init__()
        self.late = late
        if not late:
            os.closerange(3, 200)

    def step(self, action):
        if self.late:
            os.closerange(3, 200)
        return super().step(action)

gymnasium.register("Closing-v0", entry_point=Closing)
gymnasium.register("Tidy-v0", entry_point=Tidy)
"""


def shell(line: str, cwd: Path, **variables: str) -> subprocess.CompletedProcess[str]:
    command = ["bash", "-c", line]
    return subprocess.run(
        command, cwd=cwd, env=VARIABLES | variables, capture_output=True, text=True, timeout=200, check=False
    )


def how_it_ended(path: Path) -> str:
    return str(json.loads((path / "summary.json").read_text())["exit"])


@contextmanager
def on_a_terminal(line: str, cwd: Path, *, nohup: bool = False) -> Iterator[tuple[Command, int]]:
    """Run a command in a session with a terminal; gives it and the other side of the terminal."""
    side, terminal = pty.openpty()
    with Command(*line.split(), cwd=cwd, environment=VARIABLES, out=Path(os.ttyname(terminal)), nohup=nohup) as process:
        wait_for("the terminal", lambda: select.select([side], [], [], 0)[0])
        os.close(terminal)
        yield process, side


def read_until(side: int, path: Path) -> None:
    """Read a terminal until a file has two lines."""
    deadline = time.monotonic() + 120
    while not path.exists() or path.read_bytes().count(b"\n") < 2:
        assert time.monotonic() < deadline, f"no {path}"
        if select.select([side], [], [], 0.05)[0]:
            with suppress(OSError):
                os.read(side, 65536)


def test_a_reader_that_goes_ends_a_run_with_a_closing_checkpoint(tmp_path: Path) -> None:
    done = run_for_a_line("coop-lockstep", *LONG.split(), "--run-dir", "run", cwd=tmp_path)
    assert (done.returncode, done.stderr) == (141, "")
    assert how_it_ended(tmp_path / "run") == "interrupted"
    assert newest_checkpoint(tmp_path / "run") is not None


def test_a_terminal_that_goes_ends_a_topology_with_a_closing_checkpoint(tmp_path: Path) -> None:
    with on_a_terminal(f"coop-local {LONG} --run-dir run", tmp_path) as (process, side):
        read_until(side, tmp_path / "run" / "metrics.jsonl")
        os.close(side)
        assert process.wait(120) == 128 + signal.SIGHUP
    assert how_it_ended(tmp_path / "run") == "interrupted"
    assert newest_checkpoint(tmp_path / "run") is not None
    for log in (tmp_path / "run" / "logs").glob("*.log"):
        assert "Traceback" not in log.read_text()


def test_a_terminal_that_goes_without_a_signal_ends_a_sweep(tmp_path: Path) -> None:
    """As one that is not the session's own, of a container or a connection that is lost."""
    fixed = (
        "total_steps = 1000000\n[fixed.replay]\ncapacity = 100\nlearning_starts = 40\n[fixed.network]\nhidden = [8]\n"
    )
    (tmp_path / "g.toml").write_text(f'methods = ["dqn"]\nseeds = [0]\n[fixed]\n{fixed}')
    side, terminal = pty.openpty()
    line = [str(SCRIPTS / "coop-sweep"), "g.toml", "--dir", "d", "--jobs", "1", "--log", "none"]
    variables = VARIABLES | {"TERM": "xterm"}
    with subprocess.Popen(line, cwd=tmp_path, env=variables, stdout=terminal, start_new_session=True) as process:
        os.close(terminal)
        try:
            read_until(side, tmp_path / "d" / "dqn-seed=0" / "episodes.csv")
            os.close(side)
            assert process.wait(120) == 128 + signal.SIGPIPE
        finally:
            process.terminate()
    assert how_it_ended(tmp_path / "d" / "dqn-seed=0") == "interrupted"


def test_under_nohup_a_run_outlives_its_terminal(tmp_path: Path) -> None:
    line = f"coop-local {SMALL} --total-steps 1500 --run-dir run"
    with on_a_terminal(line, tmp_path, nohup=True) as (process, side):
        read_until(side, tmp_path / "run" / "metrics.jsonl")
        os.close(side)
        assert process.wait(200) == 0
    assert how_it_ended(tmp_path / "run") == "complete"


def test_closed_descriptors_of_a_lockstep_run(tmp_path: Path) -> None:
    done = shell(f"coop-lockstep {SHORT} --run-dir run <&- >&-", tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
    assert how_it_ended(tmp_path / "run") == "complete"
    printed = shell("coop-eval run --episodes 1 --networks 1 >&- 2>&-", tmp_path)
    assert printed.returncode == 0


def test_an_environment_that_closes_the_descriptors_that_it_has_not_opened(tmp_path: Path) -> None:
    """As what daemonizes itself does: a run that can go on does, and says how it ends; otherwise a line says why."""
    (tmp_path / "closing_envs.py").write_text(ENVS)
    lockstep = f"coop-lockstep --env.id closing_envs:Tidy-v0 {SHORT}"
    early = shell(f"{lockstep} --run-dir early", tmp_path)
    assert early.returncode == 0, early.stderr
    assert early.stdout.splitlines()[-1].startswith("complete: 300 steps")
    # Before 3.13, only the development mode prints what files fail of that nobody has closed.
    developing = {"PYTHONDEVMODE": "1", "PYTHONWARNINGS": "ignore"}
    late = shell(f"{lockstep} --env.kwargs '{{late = true}}' --run-dir late", tmp_path, **developing)
    assert late.returncode == 1
    assert "Traceback" not in late.stderr
    assert "a file that this process had open has been closed" in late.stderr.splitlines()[-1]


def test_a_topology_whose_environment_closes_its_output(tmp_path: Path) -> None:
    """Also on a full disk, and without standard error: no lock or log takes the place of what is closed."""
    (tmp_path / "closing_envs.py").write_text(ENVS)
    done = shell(f"coop-local --env.id closing_envs:Closing-v0 {SHORT} --run-dir run >/dev/full 2>&-", tmp_path)
    assert done.returncode == 0
    assert how_it_ended(tmp_path / "run") == "complete"
    assert (tmp_path / "run" / "logs" / "learner.log").read_text().splitlines()[-1].startswith("complete: 30")


def test_no_file_takes_the_place_of_a_closed_descriptor(tmp_path: Path) -> None:
    code = """
import os, sys
from pathlib import Path
from coop.common.process.files import LineFile, SyncedFile
from coop.records.locks import FileLock
for name, opened in (("lock", FileLock), ("synced", SyncedFile), ("lines", lambda path: LineFile(path, go_on=False))):
    os.close(1)
    file = opened(Path(sys.argv[1], name))
    os.write(1, b"a library's own words")
"""
    subprocess.run([sys.executable, "-c", code, tmp_path], check=True)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["lines", "lock", "synced"]
    assert not [path.name for path in tmp_path.iterdir() if b"words" in path.read_bytes()]


@pytest.mark.parametrize(
    ("command", "name"), [("coop-report", "läuft-猫"), ("coop-report", "b\udcff"), ("coop-eval", "b\udcff")]
)
def test_names_that_the_terminal_lacks(command: str, name: str, tmp_path: Path) -> None:
    done = shell(f"{command} '{name}'", tmp_path, PYTHONIOENCODING="ascii")
    assert done.returncode == 2
    assert done.stderr.startswith(f"{command}: error: ")
    assert done.stderr.count("\n") == 1


@pytest.mark.parametrize("flags", ["--help", "--nonsense"])
def test_answers_to_nowhere(flags: str, tmp_path: Path) -> None:
    for where in (">&- 2>&-", "2>/dev/full | true"):
        done = shell(f"coop-watch {flags} {where}; exit ${{PIPESTATUS[0]}}", tmp_path)
        assert (done.returncode, done.stderr) == (0 if flags == "--help" else 2, "")


def test_sighup_requests_a_stop_unless_it_is_ignored() -> None:
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
    ignoring, stopping = Stop(), Stop()
    try:
        signal.signal(signal.SIGHUP, signal.SIG_IGN)
        ignoring.on_signals()
        signal.raise_signal(signal.SIGHUP)
        assert not ignoring.is_set()
        signal.signal(signal.SIGHUP, signal.SIG_DFL)
        stopping.on_signals()
        signal.raise_signal(signal.SIGHUP)
        assert (stopping.reason, stopping.exit_status) == ("interrupted", 129)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@pytest.mark.parametrize("number", [signal.SIGHUP, signal.SIGTERM])
def test_a_signal_ends_commands_that_hold_no_state_in_order(number: signal.Signals) -> None:
    code = f"""
import os, time
from coop.common.process.lifecycle import raise_on_signals, run_main
def main():
    try:
        os.kill(os.getpid(), {int(number)})
        time.sleep(20)
    except Exception:
        print("users' code has swallowed it")
    finally:
        print("tidied up")
raise_on_signals()
run_main("coop-x", main)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (128 + number, "tidied up\n", "coop-x: interrupted\n")
