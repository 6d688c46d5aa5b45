"""Zenoh and numpy alone: copies segments into a ring, and batches out of it: service_bare.py tcp|shm copies|draws."""

from __future__ import annotations

import multiprocessing
import sys
from collections import deque
from contextlib import ExitStack
from multiprocessing.connection import Connection
from typing import Any

import numpy as np
import zenoh
from made_up import ATARI, segments
from service_batches import FRAME_BYTES, REQUEST, WORK, Read
from service_coop import PREFETCH, RUN, WINDOW
from service_work import CAPACITY, STEPS, Inserters, attend_service, insert_on_demand

from coop.common.messaging.messages.insert import encode_segment
from coop.common.messaging.session import open_session
from coop.common.process.memory import keep_freed_memory
from coop.common.process.processes import free_endpoint


def server(endpoint: str, shared_memory: bool, work: str, end: Connection) -> None:
    """Two queryables, each in a thread of Zenoh's."""
    ring = np.ones((CAPACITY, FRAME_BYTES), np.uint8)
    keep_freed_memory()
    answer = WORK[work][0](ring)
    inserted = 0

    def sample(query: zenoh.Query) -> None:
        with query:
            assert query.payload is not None
            query.reply("bare/sample", answer(query.payload.to_bytes()))

    def insert(query: zenoh.Query) -> None:
        nonlocal inserted
        with query:
            assert query.payload is not None
            data = np.frombuffer(query.payload.to_bytes(), np.uint8, STEPS * FRAME_BYTES)
            place = inserted % (CAPACITY - STEPS)
            ring[place : place + STEPS] = data.reshape(STEPS, FRAME_BYTES)
            inserted += STEPS
            query.reply("bare/insert", b"ok")

    with open_session((endpoint,), shared_memory=shared_memory) as session:
        session.declare_queryable("bare/sample", sample, complete=True)
        session.declare_queryable("bare/insert", insert, complete=True)
        end.send("ready")
        end.recv()


def inserter(endpoint: str, shared_memory: bool, end: Connection) -> None:
    segment = encode_segment(RUN, next(segments(ATARI, STEPS)))
    waiting: deque[Any] = deque()
    with open_session((), (endpoint,), shared_memory=shared_memory) as session:

        def submit() -> None:
            if len(waiting) == WINDOW:
                waiting.popleft().recv()
            waiting.append(session.get("bare/insert", handler=zenoh.handlers.FifoChannel(2), payload=segment))

        def drain() -> None:
            while waiting:
                waiting.popleft().recv()

        insert_on_demand(end, (submit, drain))


class Sampler:
    """Keeps `PREFETCH` draws in flight."""

    def __init__(self, session: zenoh.Session, read: Read) -> None:
        self._session = session
        self._read = read
        self._waiting = deque(self._ask() for _ in range(PREFETCH))

    def next(self) -> object:
        """What is read of one batch."""
        reply = self._waiting.popleft().recv()
        self._waiting.append(self._ask())
        assert reply.ok is not None
        return self._read(reply.ok.payload.to_bytes())

    def _ask(self) -> Any:  # noqa: ANN401 (zenoh's handler)
        return self._session.get("bare/sample", handler=zenoh.handlers.FifoChannel(2), payload=REQUEST)


def main(shared_memory: bool, work: str) -> None:
    keep_freed_memory()
    endpoint = free_endpoint()
    with ExitStack() as stack:
        spawn = multiprocessing.get_context("spawn")
        ours, theirs = spawn.Pipe()
        process = spawn.Process(target=server, args=(endpoint, shared_memory, work, theirs))
        process.start()
        stack.callback(process.join)
        stack.callback(ours.send, None)
        assert ours.recv() == "ready"
        inserters = Inserters(stack, inserter, endpoint, shared_memory)
        session = stack.enter_context(open_session((), (endpoint,), shared_memory=shared_memory))
        attend_service(inserters, Sampler(session, WORK[work][1]).next)


if __name__ == "__main__":
    main(sys.argv[1] == "shm", sys.argv[2])
