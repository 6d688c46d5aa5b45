"""Which of Zenoh's threads carry the links of a process."""

import os
import subprocess
import sys

import pytest

from coop.common.messaging.links import close
from coop.common.messaging.session import THREADS, open_session

ZENOHS = {"acc", "net", "rx", "tx"}
OPEN = """
import os, sys, time
from pathlib import Path
from coop.common.messaging.session import open_session

process, there, *wanted = sys.argv[1:]
before = dict(os.environ)
listen = () if process == "connect" else ("tcp/127.0.0.1:0",)
session = open_session(listen, (there,), mode="router" if process == "router" else "peer")
assert os.environ == before, "a process started from here would inherit it"
deadline = time.monotonic() + 30
threads = set()
while not threads.issuperset(wanted) and time.monotonic() < deadline:
    time.sleep(0.5)  # those that nobody wants have this long to come
    threads = {(thread / "comm").read_text().split("-")[0].strip() for thread in Path("/proc/self/task").iterdir()}
print(*threads)
session.close()
"""


@pytest.mark.parametrize(
    ("process", "own_choice", "threads"),
    [
        ("connect", "", {"acc"}),
        ("listen", "", {"acc", "tx"}),
        ("router", "", {"acc", "net", "rx", "tx"}),
        ("connect", "(tx:(worker_threads:1))", {"net", "rx", "tx"}),
    ],
)
def test_a_process_has_the_threads_that_its_links_need(
    process: str, own_choice: str, threads: set[str], endpoint: str
) -> None:
    env = {**os.environ, THREADS: own_choice} if own_choice else os.environ
    session = open_session((endpoint,))
    try:
        command = [sys.executable, "-c", OPEN, process, endpoint, *threads]
        done = subprocess.run(command, env=env, capture_output=True, text=True, timeout=60, check=False)
    finally:
        close(session)
    assert done.returncode == 0, done.stderr
    assert set(done.stdout.split()) & ZENOHS == threads
