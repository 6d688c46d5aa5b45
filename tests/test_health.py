"""Whether a process works, as container engines ask it."""

import json
import subprocess
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Iterator

import pytest

from coop.common.errors import UsageError
from coop.common.process.console import Console
from coop.common.process.processes import free_endpoint
from coop.monitor.health import STUCK, answering, state


@pytest.fixture
def address() -> str:
    return free_endpoint().partition("/")[2]


@pytest.fixture
def console(address: str) -> Iterator[Console]:
    """The console of a role that answers."""
    console = Console()
    with answering(address, console):
        yield console


def ask(address: str, path: str) -> tuple[int, str]:
    try:
        with urllib.request.urlopen(f"http://{address}{path}", timeout=30) as answer:
            return answer.status, json.load(answer)["state"]
    except urllib.error.HTTPError as refused:
        with refused:
            return refused.code, json.load(refused)["state"]


def test_a_role_that_has_not_begun_lives_but_is_not_ready(address: str, console: Console) -> None:
    assert ask(address, "/") == (200, "starting")
    assert ask(address, "/ready") == (503, "starting")
    console.event("joined")
    assert ask(address, "/ready") == (503, "starting"), "only the main loop counts"


def test_a_role_that_waits_for_another_one_works(address: str, console: Console) -> None:
    console.progress(0, "waiting for the learner", str)
    assert ask(address, "/") == ask(address, "/ready") == (200, "working")


def test_a_role_whose_loop_stands_still_does_not_work(address: str, console: Console) -> None:
    console.reported = time.monotonic() - STUCK
    assert ask(address, "/") == ask(address, "/ready") == (503, "stuck")
    asked = [sys.executable, "-m", "coop.monitor.health", address]
    stuck = subprocess.run(asked, capture_output=True, text=True, timeout=60, check=False)
    console.progress(0, "", str)
    well = subprocess.run(asked, capture_output=True, text=True, timeout=60, check=False)
    assert (stuck.returncode, json.loads(stuck.stdout)["state"]) == (1, "stuck")
    assert (well.returncode, json.loads(well.stdout)["state"]) == (0, "working")


def test_the_states() -> None:
    assert [state(idle) for idle in (None, 0.0, STUCK - 1, STUCK)] == ["starting", "working", "working", "stuck"]


def test_nobody_answers(address: str) -> None:
    asked = [sys.executable, "-m", "coop.monitor.health", address]
    done = subprocess.run(asked, capture_output=True, text=True, timeout=60, check=False)
    assert (done.returncode, done.stderr) == (1, f"health: error: {address}: Connection refused\n")


@pytest.mark.parametrize("address", [":7450", "localhost:", "localhost:70000"])
def test_bad_addresses(address: str) -> None:
    with pytest.raises(
        UsageError, match=rf"^--health {address}: PORT or HOST:PORT with a port from 0 to 65535 is needed$"
    ):
        answering(address, Console()).__enter__()


def test_an_address_in_use(address: str, console: Console) -> None:
    with pytest.raises(UsageError, match=rf"^--health {address}: Address already in use$"):
        answering(address, Console()).__enter__()
