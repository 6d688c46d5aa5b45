"""A broadcast of the nature network's weights over TCP until all sessions have it: broadcast.py SESSIONS.

Broadcasts never block: one that comes before a session's subscription, or while its queue is full, does not reach it.
Then it is repeated.
"""

from __future__ import annotations

import multiprocessing
import sys
import threading
from collections import defaultdict
from contextlib import ExitStack
from functools import partial
from itertools import count
from multiprocessing.connection import Connection

import numpy as np
import zenoh
from turns import attend, clocked
from work import ATARI, update_config

from coop.common.messaging.messages.weights import Weights
from coop.common.messaging.session import open_session
from coop.common.messaging.transport import Node, new_incarnation
from coop.common.process.memory import keep_freed_memory
from coop.common.process.processes import free_endpoint
from coop.learner.agent import Agent

RUN = "bench"
BROADCASTS = f"{RUN}/broadcasts"  # the start of their keys
PATIENCE = 1.0  # seconds before a broadcast is repeated


def subscribers(endpoint: str, sessions: int, end: Connection) -> None:
    """Send the key of each broadcast that all sessions have received."""
    heard: defaultdict[str, set[int]] = defaultdict(set)
    lock = threading.Lock()

    def receive(session: int, sample: zenoh.Sample) -> None:
        key = str(sample.key_expr)
        with lock:
            if session not in heard[key]:
                heard[key].add(session)
                if len(heard[key]) == sessions:
                    end.send(key)

    with ExitStack() as stack:
        for number in range(sessions):
            session = stack.enter_context(open_session((), (endpoint,)))
            session.declare_subscriber(f"{BROADCASTS}/*", partial(receive, number))
        end.recv()


def main(sessions: int) -> None:
    keep_freed_memory()
    endpoint = free_endpoint()
    flat = Agent(update_config("nature", "dqn", 32, "float32"), ATARI).networks[0].snapshot()
    spawn = multiprocessing.get_context("spawn")
    with Node(open_session((endpoint,)), RUN, "learner", new_incarnation()) as node:
        ours, theirs = spawn.Pipe()
        process = spawn.Process(target=subscribers, args=(endpoint, sessions, theirs), daemon=True)
        process.start()
        numbers = count(1)
        payload = Weights(1, 1, np.asarray(flat)).encode(RUN)

        def publish() -> None:
            key = f"{BROADCASTS}/{next(numbers)}"
            node.publish(key, payload)
            while not ours.poll(PATIENCE):
                node.publish(key, payload)
            assert ours.recv() == key

        attend(lambda seconds: {"ms": 1e3 * clocked(publish, seconds)})
        ours.send(None)
        process.join()


if __name__ == "__main__":
    main(int(sys.argv[1]))
