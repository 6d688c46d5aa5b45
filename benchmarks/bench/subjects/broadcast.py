"""A broadcast of the nature network's weights over TCP until all sessions have it: broadcast.py SESSIONS."""

from __future__ import annotations

import multiprocessing
import sys
import threading
from contextlib import ExitStack
from multiprocessing.connection import Connection

import numpy as np
from turns import attend, clocked
from work import ATARI, update_config

from common.messaging.keys import weights_key
from common.messaging.messages.weights import Weights
from common.messaging.session import open_session
from common.messaging.transport import Node, new_incarnation
from common.process.memory import keep_freed_memory
from common.process.processes import free_endpoint
from learner.agent import Agent

RUN = "bench"


def subscribers(endpoint: str, count: int, end: Connection) -> None:
    """Say when all have received something."""
    received, lock = 0, threading.Lock()

    def receive(_: object) -> None:
        nonlocal received
        with lock:
            received += 1
            if received == count:
                received = 0
                end.send("all")

    with ExitStack() as stack:
        for _ in range(count):
            session = stack.enter_context(open_session((), (endpoint,)))
            node = stack.enter_context(Node(session, RUN, "actor", new_incarnation()))
            session.declare_subscriber(weights_key(node, 1), receive)
        end.send("ready")
        end.recv()


def main(count: int) -> None:
    keep_freed_memory()
    endpoint = free_endpoint()
    flat = Agent(update_config("nature", "dqn", 32, "float32"), ATARI).networks[0].snapshot()
    spawn = multiprocessing.get_context("spawn")
    with Node(open_session((endpoint,)), RUN, "learner", new_incarnation()) as node:
        ours, theirs = spawn.Pipe()
        process = spawn.Process(target=subscribers, args=(endpoint, count, theirs), daemon=True)
        process.start()
        assert ours.recv() == "ready"
        payload = Weights(1, 1, np.asarray(flat)).encode(RUN)

        def publish() -> None:
            node.publish(weights_key(node, 1), payload)
            assert ours.recv() == "all"

        attend(lambda seconds: {"ms": 1e3 * clocked(publish, seconds)})
        ours.send(None)
        process.join()


if __name__ == "__main__":
    main(int(sys.argv[1]))
