"""A real `coop-replay` and its clients: service_coop.py tcp|shm|whole|router (before the inserting ones).

whole: over TCP without the learner's mirror, so that each batch brings all its frames.
"""

from __future__ import annotations

import sys
import tempfile
from contextlib import ExitStack
from multiprocessing.connection import Connection
from pathlib import Path

import msgspec
from made_up import ATARI, segments
from service_work import BATCH, CAPACITY, STEPS, Inserters, attend_service, insert_on_demand

from coop.common.messaging.insert_client import InsertClient
from coop.common.messaging.mirror import FrameMirror
from coop.common.messaging.route import open_client
from coop.common.messaging.sample_client import SampleClient
from coop.common.messaging.session import open_session
from coop.common.messaging.transport import Node, new_incarnation
from coop.common.process.lifecycle import Stop
from coop.common.process.memory import keep_freed_memory
from coop.common.process.processes import ChildProcess, command, free_endpoint
from coop.common.settings.capacity import mirror_slots
from coop.common.settings.tables import validated
from coop.learner.join_service import JoinService
from coop.learner.roster import Roster
from coop.learner.shared_checkpoints import SharedCheckpoints

RUN = "bench"
PREFETCH = 8
WINDOW = 16  # segments of an inserting process in flight, as many as an actor with 8 emulators has
# A run whose limiter admits everything.
CONFIG = validated(
    {
        "run": RUN,
        "total_steps": 10**12,
        "env": {"id": "breakout"},
        "replay": {"capacity": CAPACITY, "learning_starts": 1000, "tolerance": 1e12},
    }
)


def inserter(endpoints: tuple[str, ...], way: str, end: Connection) -> None:
    incarnation = new_incarnation()
    stream = (msgspec.structs.replace(segment, incarnation=incarnation) for segment in segments(ATARI, STEPS))
    shared_memory = way == "shm"
    if way == "router":
        session = open_client(endpoints, None, shared_memory, 30.0, Stop())
        assert session is not None
    else:
        session = open_session((), endpoints, shared_memory=shared_memory)
    with Node(session, RUN, "actor", incarnation) as node:
        client = InsertClient(node, Stop(), window=WINDOW)
        insert_on_demand(end, (lambda: client.submit(next(stream)), client.drain))


def main(way: str) -> None:
    keep_freed_memory()
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        head, replay, gate = (free_endpoint() for _ in range(3))

        def serve(name: str, *flags: str) -> None:
            service = ChildProcess(name, command(f"coop-{name}", *flags), folder / name)
            service.start()
            stack.callback(service.end, 10)
            stack.callback(service.interrupt)

        incarnation = new_incarnation()
        node = stack.enter_context(Node(open_session((head,), shared_memory=way == "shm"), RUN, "learner", incarnation))
        JoinService(
            node, CONFIG, ATARI, "", run_id=0, shared=SharedCheckpoints([], "benchmark"), roster=Roster(), event=print
        )
        gates = [gate] if way == "router" else []
        flags = ["--run", RUN, "--connect", head, *gates, "--listen", replay, "--run-dir", str(folder)]
        serve("replay", *flags, *["--shared-memory"] * (way == "shm"))
        if way == "router":
            serve("router", "--connect", head, "--listen", gate)
        inserters = Inserters(stack, inserter, (gate,) if way == "router" else (head, replay), way)
        mirror = None if way == "whole" else FrameMirror(ATARI, mirror_slots(CONFIG, ATARI))
        sampler = SampleClient(
            node, Stop(), incarnation, ATARI, BATCH, PREFETCH, shared_memory=way == "shm", mirror=mirror
        )
        inserters.insert(1.0)
        attend_service(inserters, sampler.next, settle=0 if way == "whole" else CAPACITY // BATCH)


if __name__ == "__main__":
    main(sys.argv[1])
