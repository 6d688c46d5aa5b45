"""A real `coop-actor` with eight emulators of Breakout, the nature network and a real `coop-replay`: acting_coop.py.

It acts while it has its turn; a signal stops it otherwise.
"""

from __future__ import annotations

import os
import signal
import subprocess
import tempfile
import time
from contextlib import ExitStack
from pathlib import Path

from turns import attend
from work import EMULATORS, EPSILON, acting_config

from coop.common.envs.make import env_spec
from coop.common.messaging.keys import replay_key
from coop.common.messaging.messages.status import ReplayStats, StatsQuestion
from coop.common.messaging.session import open_session
from coop.common.messaging.transport import NoAnswer, Node, new_incarnation
from coop.common.process.processes import ChildProcess, command, free_endpoint
from coop.learner.agent import Agent
from coop.learner.broadcast import Broadcaster
from coop.learner.join_service import JoinService
from coop.learner.roster import Roster
from coop.learner.shared_checkpoints import SharedCheckpoints

RUN = "bench"
LOOK_EVERY = 0.02  # seconds; each request for the replay service's count costs the topology a little processor time


class Topology:
    """A learner that does not train (this process), a replay service, and one actor."""

    def __init__(self, stack: ExitStack, folder: Path) -> None:
        config = acting_config(RUN, EMULATORS, EPSILON)
        head, replay = free_endpoint(), free_endpoint()
        spec = env_spec(config.env)
        session = open_session((head,), (replay,))
        self._node = stack.enter_context(Node(session, RUN, "learner", new_incarnation()))
        agent = Agent(config, spec)
        digest, shared = agent.networks[0].layout_digest(), SharedCheckpoints([], "benchmark")
        JoinService(self._node, config, spec, digest, 0, shared, Roster(), print)
        Broadcaster(self._node, agent)
        joining = ["--run", RUN, "--connect", head]
        service = command("coop-replay", *joining, "--listen", replay, "--run-dir", str(folder))
        child = ChildProcess("replay", service, folder / "replay.log")
        child.start()
        stack.callback(child.end, 10)
        stack.callback(child.interrupt)
        self._actor = stack.enter_context(subprocess.Popen(command("coop-actor", *joining)))
        stack.callback(self._actor.kill)
        while not self._inserted():
            time.sleep(0.1)
        self._actor.send_signal(signal.SIGSTOP)

    def turn(self, seconds: float) -> dict[str, float]:
        """Steps that the actor inserts, between two changes of the count; the first turn after a stop is incomplete."""
        self._actor.send_signal(signal.SIGCONT)
        changes = [(time.perf_counter(), self._processor_seconds(), self._inserted())]
        while len(changes) < 4 or changes[-1][0] - changes[0][0] < seconds:
            time.sleep(LOOK_EVERY)
            if (count := self._inserted()) != changes[-1][2]:
                changes.append((time.perf_counter(), self._processor_seconds(), count))
        self._actor.send_signal(signal.SIGSTOP)
        spent, processor, steps = (last - first for first, last in zip(changes[1], changes[-1], strict=True))
        return {"steps/s": steps / spent, "steps/s of processor time": steps / processor}

    def _processor_seconds(self) -> float:
        fields = Path(f"/proc/{self._actor.pid}/stat").read_text().rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")

    def _inserted(self) -> int:
        question = StatsQuestion().encode(RUN)
        try:
            return ReplayStats.decode(self._node.ask(replay_key(self._node, "stats"), question)).inserted
        except NoAnswer:  # it has not begun to answer
            return 0


with ExitStack() as everything, tempfile.TemporaryDirectory() as folder:
    attend(Topology(everything, Path(folder)).turn)
