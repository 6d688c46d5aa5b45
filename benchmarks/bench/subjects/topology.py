"""A real `coop-learner` on the nature network, fed by a real `coop-replay`: topology.py METHOD DTYPE.

This process inserts what the replay ratio requires and takes the weights. A signal stops the learner between turns.
"""

from __future__ import annotations

import signal
import subprocess
import sys
import tempfile
import time
from contextlib import ExitStack
from pathlib import Path

from made_up import segments
from turns import attend
from work import ATARI, update_config

from coop.common.messaging.insert_client import InsertClient
from coop.common.messaging.joining import join
from coop.common.messaging.keys import replay_key
from coop.common.messaging.messages.control import Join
from coop.common.messaging.messages.status import ReplayStats, StatsQuestion
from coop.common.messaging.session import open_session
from coop.common.messaging.transport import NoAnswer, Node, new_incarnation
from coop.common.process.lifecycle import Stop
from coop.common.process.processes import ChildProcess, command, free_endpoint
from coop.common.settings.tables import to_toml

STEPS = 32
FILLED = 4096  # transitions before the measurements


class Topology:
    """A learner that is stopped between turns, a replay service, and this process, which inserts and subscribes."""

    def __init__(self, stack: ExitStack, method: str, dtype: str, folder: Path) -> None:
        config = update_config("nature", method, 32, dtype, capacity=10_000, learning_starts=1000, tolerance=1e12)
        head, replay = free_endpoint(), free_endpoint()
        settings = folder / "config.toml"
        settings.write_text(to_toml(config))
        flags = ["--config", str(settings), "--run-dir", str(folder / "run"), "--listen", head]
        log = stack.enter_context((folder / "learner.log").open("w"))
        learner = command("coop-learner", *flags)
        self._learner = stack.enter_context(subprocess.Popen(["taskset", "-c", "0", *learner], stdout=log, stderr=log))
        stack.callback(self._learner.kill)
        joining = ["--run", config.run, "--connect", head, "--listen", replay, "--run-dir", str(folder)]
        service = ChildProcess("replay", command("coop-replay", *joining), folder / "replay.log")
        service.start()
        stack.callback(service.end, 10)
        stack.callback(service.interrupt)
        incarnation, stop = new_incarnation(), Stop()
        self._node = stack.enter_context(Node(open_session((), (head, replay)), config.run, "actor", incarnation))
        join(self._node, stop, Join("actor", incarnation, []), (head,), 60.0, need_replay=True)
        self._weights = self._node.latest(self._node.key("weights", "1"))
        self._inserts = InsertClient(self._node, stop, window=8)
        self._segments = segments(ATARI, STEPS)
        self._run, self._ratio = config.run, config.replay.ratio
        while self._drawn() is None:
            time.sleep(0.1)
        self._insert_up_to(FILLED)
        while not self._drawn():
            time.sleep(0.1)
        self._learner.send_signal(signal.SIGSTOP)

    def turn(self, seconds: float) -> dict[str, float]:
        """Let the learner go on, and insert as many steps as the replay ratio requires; updates/s of processor time."""
        self._learner.send_signal(signal.SIGCONT)
        time.sleep(0.3)
        first, begun, processor = self._drawn() or 0, time.perf_counter(), self._processor_seconds()
        while time.perf_counter() - begun < seconds:
            time.sleep(0.02)
            self._insert_up_to(FILLED + int((self._drawn() or 0) / self._ratio))
        updates, spent = (self._drawn() or 0) - first, time.perf_counter() - begun
        processor = self._processor_seconds() - processor
        self._learner.send_signal(signal.SIGSTOP)
        return {"updates/s": updates / processor, "updates/s by the clock": updates / spent}

    def _insert_up_to(self, transitions: int) -> None:
        while self._inserts.acked < transitions:
            self._inserts.submit(next(self._segments))

    def _drawn(self) -> int | None:
        question = StatsQuestion().encode(self._run)
        try:
            return ReplayStats.decode(self._node.ask(replay_key(self._node, "stats"), question)).drawn
        except NoAnswer:  # it has not begun to answer
            return None

    def _processor_seconds(self) -> float:
        """Processor time of the learner's main thread, in seconds."""
        pid = self._learner.pid
        return int(Path(f"/proc/{pid}/task/{pid}/schedstat").read_text().split()[0]) / 1e9


with ExitStack() as everything, tempfile.TemporaryDirectory() as name:
    attend(Topology(everything, *sys.argv[1:], Path(name)).turn)
