"""`coop-watch` follows a run that it has no part in, to its end."""

import contextlib
import fcntl
import json
import os
import pty
import re
import signal
import socket
import struct
import subprocess
import sysconfig
import termios
import threading
import time
import urllib.request
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
from commands import run_command

from coop.common.messaging.messages.status import LearnerStatus
from coop.common.messaging.transport import new_incarnation
from coop.common.process.processes import free_endpoint
from coop.monitor.watch import RunStatus

SCRIPTS = Path(sysconfig.get_path("scripts"))
# Unbuffered, Python drops what is left of a write that a signal has cut short.
ENVIRONMENT = {**os.environ, "TERM": "xterm", "PYTHONUNBUFFERED": ""}


class Terminal:
    """A terminal of 80 x 24, and all that is written to it."""

    def __init__(self) -> None:
        self._reading, self.writing = pty.openpty()
        fcntl.ioctl(self.writing, termios.TIOCSWINSZ, struct.pack("HHHH", 24, 80, 0, 0))
        self._written = bytearray()
        self._thread = threading.Thread(target=self._read)
        self._thread.start()

    def _read(self) -> None:
        with contextlib.suppress(OSError):  # the last process that wrote has gone
            while part := os.read(self._reading, 65536):
                self._written += part

    def text(self) -> str:
        return self._written.decode(errors="ignore")

    def pictures(self) -> list[list[str]]:
        """The lines of each whole picture, without colours."""
        return [re.sub(r"\x1b\[[\d;?]*\w", "", part).split("\r\n") for part in self.text().split("\x1b[H")[1:-1]]

    def close(self) -> None:
        os.close(self.writing)
        self._thread.join()
        os.close(self._reading)


@contextlib.contextmanager
def started(command: Sequence[str], **options: Any) -> Iterator[subprocess.Popen[str]]:
    """A console command, which is ended where the test has not seen its end."""
    with subprocess.Popen([str(SCRIPTS / command[0]), *command[1:]], text=True, **options) as process:
        try:
            yield process
        finally:
            process.terminate()


def wait_for(status: RunStatus, reached: Callable[[LearnerStatus], bool]) -> LearnerStatus:
    deadline = time.monotonic() + 100
    while (status.refresh() or status.learner) is None or not reached(status.learner):
        assert time.monotonic() < deadline, status.learner
        time.sleep(0.05)
    return status.learner


def states(status: LearnerStatus) -> dict[str, str]:
    return {member.name: member.state for member in status.members}


@pytest.mark.timeout(300)  # on a busy machine
def test_watching_a_run_to_its_end(tmp_path: Path) -> None:
    endpoint = free_endpoint()
    watch = ("coop-watch", "--connect", endpoint)
    nobody = run_command(*watch, "--join-timeout", "0.5", "--once")
    assert (nobody.returncode, nobody.stdout) == (1, "")
    assert nobody.stderr == f"coop-watch: error: no learner of run 'coop' found at {endpoint} within 0.5 s\n"
    page, metrics = (free_endpoint().removeprefix("tcp/") for _ in range(2))
    local = ["coop-local", "--listen", endpoint, "--total-steps", "1000000", "--run-dir", str(tmp_path / "r")]
    local += ["--web", page, "--prometheus", metrics]
    status, terminal = RunStatus("coop", endpoint, new_incarnation()), Terminal()
    with (
        contextlib.closing(terminal),
        contextlib.closing(status),
        ThreadPoolExecutor() as threads,
        started(local, stdout=terminal.writing, env=ENVIRONMENT) as run,
    ):
        before = wait_for(status, lambda now: now.measured is not None and "actor 0" in states(now))
        first = threads.submit(run_command, *watch)
        assert states(before) == {"learner": "training", "replay service": "serving", "actor 0": "playing"}
        assert {member.host for member in before.members} == {socket.gethostname()}

        now = json.loads(run_command(*watch, "--once", "--json", check=True).stdout)
        assert (now["run"], now["env"], now["method"], now["capacity"]) == ("coop", "CartPole-v0", "coop", 5000)
        assert [member["name"] for member in now["members"]] == ["learner", "replay service", "actor 0"]
        assert now["size"] <= now["env_steps"]
        assert 0 < now["updates_to_swap"] <= 100
        assert now["ratio"]["measured"] == pytest.approx(1, abs=0.2)
        assert now["ratio"]["least"] <= now["ratio"]["ahead"] <= now["ratio"]["most"]
        assert now["measured"]["q_abs_mean"] <= now["measured"]["q_bound"] == pytest.approx(20)
        assert now["seconds_left"] > 0
        assert now["return_history"][-1] > 0
        assert sum("actor" in line and line.endswith("joined") for line in now["events"]) == 1
        with urllib.request.urlopen(f"http://{page}/page.json", timeout=60) as answer:
            shown = json.loads(answer.read())
        assert (shown["run"], shown["settings"]) == ("coop", "CartPole-v0, coop, seed 0")
        assert shown["points"][-1][0] > 0
        with urllib.request.urlopen(f"http://{metrics}/metrics", timeout=60) as answer:
            exported = answer.read().decode()
        assert re.search(r'^coop_updates_total{env="CartPole-v0",method="coop",seed="0"} [1-9]', exported, re.MULTILINE)
        other = run_command(*watch, "--run", "my", "--join-timeout", "0.5")
        assert other.stderr.endswith("within 0.5 s; there is run 'coop'\n")
        # A learner tells its status twice a second.
        hasty = run_command(*watch, "--patience", "0.1")
        assert hasty.returncode == 1
        assert hasty.stderr.endswith("the learner of run 'coop' has been silent for 0.1 s\n")
        with started([*watch, "--patience", "90"], stdout=subprocess.PIPE) as second:
            assert second.stdout is not None
            printed = second.stdout.readline()
            second.send_signal(signal.SIGINT)
            printed += second.stdout.read()
            assert second.wait(110) == 0
        assert "joined" in printed
        assert "the run has ended" not in printed

        os.kill(before.members[-1].pid, signal.SIGKILL)
        lost = wait_for(status, lambda now: states(now).get("actor 0") == "lost")
        assert [member.role for member in lost.members] == ["actor", "learner", "replay"]
        assert lost.connected["actor"] == 0
        wait_for(status, lambda _: "starting it again" in " ".join(map(str.strip, terminal.pictures()[-1])))
        run.send_signal(signal.SIGINT)
        assert run.wait(110) == 130
        done = first.result()
    assert (done.returncode, done.stderr) == (0, "")
    assert re.search(r"step [\d,]+/1,000,000  return [\d.]+ \((the last 100 of )?\d+ episodes?\)", done.stdout)
    assert done.stdout.endswith("the run has ended: interrupted\n")

    pictures = [lines for lines in terminal.pictures() if lines[0].startswith("coop  CartPole-v0, coop, seed 0")]
    assert [(len(lines), lines[-4:]) for lines in pictures if len(lines) != 24] == []
    assert any("lost      does not answer" in line for lines in pictures for line in lines)
    left = terminal.text().partition("\x1b[?1049l")[2]
    assert "killed by SIGKILL" in left, "the events remain when the screen has gone"
    assert left.rstrip().endswith(f"; coop-local --resume --run-dir {tmp_path / 'r'} goes on")


NOISY = """
import sys
from coop.monitor.display import LiveDisplay

class Pictures(LiveDisplay):
    def picture(self):
        return "the picture"
    def line(self):
        return ""

with Pictures(0.0, 1000, screen=True) as display:
    for _ in range(3):
        print("an error", "of a library", file=sys.stderr)
        display.update()
    sys.stderr.write("half")
    assert sys.stderr.fileno() == 2
print("later", file=sys.stderr)
"""


@pytest.mark.parametrize("both", [True, False])
def test_what_others_write_to_standard_error_does_not_move_the_picture(both: bool, tmp_path: Path) -> None:
    errors = tmp_path / "errors"
    with contextlib.closing(Terminal()) as terminal, errors.open("w") as file:
        streams = {"stdout": terminal.writing, "stderr": terminal.writing if both else file}
        with started(["python", "-c", NOISY], env=ENVIRONMENT, **streams) as process:
            assert process.wait(60) == 0
    begun, *pictures = terminal.pictures()
    assert begun == [""]
    assert {(len(lines), lines[0].strip()) for lines in pictures} == {(24, "the picture")}
    left = terminal.text().partition("\x1b[?1049l")[2]
    if both:
        assert left.count("an error of a library\r\n") == 3
        assert left.endswith("half\r\nlater\r\n")
    else:
        assert errors.read_text() == "an error of a library\n" * 3 + "halflater\n"


def test_watch_refuses_json_for_a_live_screen() -> None:
    refused = run_command("coop-watch", "--json")
    assert (refused.returncode, refused.stderr) == (2, "coop-watch: error: --json: needs --once\n")
