"""Fixtures of real Zenoh sessions, and the check that a test session leaves nothing behind."""

import gc
import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import hypothesis
import pytest
import torch
from forked import forked_children, forked_process, serve

from coop.common.messaging.conversation import RESTING
from coop.common.messaging.session import open_session
from coop.common.messaging.transport import Node, new_incarnation
from coop.common.process.limits import use_threads
from coop.common.settings.methods import METHODS
from coop.common.settings.policies import EVICTIONS, SAMPLERS
from coop.common.types import EnvSpec

gc.disable()  # until all tests are collected: of hundreds of thousands of objects none goes

# torch.compile's own processes would outlive the tests.
os.environ["TORCHINDUCTOR_COMPILE_THREADS"] = "1"

# What a user has trained is noted in the user's home; the tests' own is elsewhere.
os.environ["XDG_STATE_HOME"] = str(Path(tempfile.gettempdir()) / f"coop-tests-{os.getpid()}")

# Under nohup, children would ignore SIGHUP too, and some tests are about what it does.
signal.signal(signal.SIGHUP, signal.SIG_DFL)

# With their default threads, several processes starve each other.
use_threads(1)

# How long an example takes says nothing on a busy machine.
hypothesis.settings.register_profile("coop", deadline=None)
# Of a mutant it only matters whether an example fails; each one meets the same examples, and few: most are killed soon.
hypothesis.settings.register_profile(
    "mutants",
    deadline=None,
    max_examples=30,
    derandomize=True,
    database=None,
    phases=[hypothesis.Phase.explicit, hypothesis.Phase.generate],
)
hypothesis.settings.load_profile("coop")

SETTLE = 10.0  # seconds that threads and processes get to end


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Files with longer limits come first, so that no worker begins one of them while the others end."""
    limits: dict[Path, float] = {}
    for item in items:
        limit = item.get_closest_marker("timeout")
        limits[item.path] = max(limits.get(item.path, 0.0), limit.args[0] if limit else 0.0)
    items.sort(key=lambda item: -limits[item.path])


def pytest_collection_finish() -> None:
    gc.freeze()
    gc.enable()


def _children() -> set[int]:
    """Processes whose parent is this one, without those of multiprocessing, which end with it."""
    found = set()
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                parent = int((entry / "stat").read_text().rpartition(")")[2].split()[1])
                own = b"multiprocessing." in (entry / "cmdline").read_bytes()
            except OSError:
                continue
            if parent == os.getpid() and not own:
                found.add(int(entry.name))
    return found


def _sockets() -> set[str]:
    """Sockets that this process holds open."""
    found = set()
    for entry in Path("/proc/self/fd").iterdir():
        try:
            target = str(entry.readlink())
        except OSError:
            continue
        if target.startswith("socket:"):
            found.add(target)
    return found


def _left(before: tuple[set[int], set[str], set[threading.Thread]]) -> str:
    children, sockets, threads = before
    left = [f"process {pid}" for pid in _children() - children]
    left += [f"socket {name}" for name in _sockets() - sockets]
    # pytest-timeout's own timer of the running test is still there when the session's fixtures end.
    own = [thread for thread in threading.enumerate() if thread.name.startswith(("pytest_timeout", RESTING))]
    left += [f"thread {thread!r}" for thread in set(threading.enumerate()) - threads - set(own)]
    return ", ".join(left)


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 256 KiB."""
    if os.geteuid():
        pytest.skip("mounting a small file system needs root")
    path = tmp_path / "disk"
    path.mkdir()
    subprocess.run(["mount", "-t", "tmpfs", "-o", "size=256k", "tmpfs", str(path)], check=True)
    try:
        yield path
    finally:
        subprocess.run(["umount", "--lazy", str(path)], check=True)


@pytest.fixture(scope="session", autouse=True)
def nothing_left_behind() -> Iterator[None]:
    """Fail the session where a process, thread or socket of a test outlives it."""
    before = _children(), _sockets(), set(threading.enumerate())
    yield
    shutil.rmtree(os.environ["XDG_STATE_HOME"], ignore_errors=True)
    deadline = time.monotonic() + SETTLE
    while (left := _left(before)) and time.monotonic() < deadline:
        time.sleep(0.1)
    assert not left, f"left behind: {left}"


@pytest.fixture(autouse=True)
def parts_of_ones_own(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """No test meets the methods that another one registered, nor its modules `my_...`, which have the same names."""
    monkeypatch.setattr(METHODS, "_all", {**METHODS._all})
    for registry in (METHODS, EVICTIONS, SAMPLERS):
        monkeypatch.setattr(registry, "_own", {})
    yield
    for name, module in list(sys.modules.items()):
        if name.startswith("my_") and not Path(module.__file__ or "").is_relative_to(Path(__file__).parent):
            del sys.modules[name]


@pytest.fixture(autouse=True)
def the_same_random_numbers() -> None:
    """PyTorch's own generator, which initialises layers, otherwise differs from process to process."""
    torch.manual_seed(0)


@pytest.fixture
def endpoint(tmp_path: Path) -> str:
    return f"unixsock-stream/{tmp_path}/z.sock"


@pytest.fixture
def nodes(endpoint: str) -> Iterator[tuple[Node, Node]]:
    """Two connected nodes of one run: a learner that listens, and an actor."""
    with (
        Node(open_session((endpoint,)), "test", "learner", new_incarnation()) as first,
        Node(open_session((), (endpoint,)), "test", "actor", new_incarnation()) as second,
    ):
        deadline = time.monotonic() + 5
        while not second.presence.counts().get("learner") and time.monotonic() < deadline:
            time.sleep(0.02)
        yield first, second


@pytest.fixture(scope="module")
def quick_children() -> Iterator[None]:
    """Commands that this process starts as children are forks where torch has been imported."""

    def start(asking: socket.socket, requests: socket.socket) -> None:
        forked_process(serve, requests)

    with forked_children(start):
        yield


@pytest.fixture
def spec() -> EnvSpec:
    """CartPole's."""
    return EnvSpec("CartPole-v0", (4,), "float32", 1, 2)
