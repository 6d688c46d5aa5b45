"""Speed of the replay service over Zenoh on loopback: `python benchmarks/replay_service.py`.

A real `coop-replay` process, two inserting processes and one sampling client (this process), over TCP and shared
memory. The reference is bare Zenoh with numpy: a process that gathers the same number of frames from a ring and copies
segments into it, without checks, counters or limiter. Both take turns in every round, so that the ratios hold on a busy
machine. With `--router`, inserting processes behind a `coop-router` take turns with those that have links of their own
instead. Prints medians with their range over the rounds.
"""

from __future__ import annotations

import argparse
import math
import multiprocessing
import statistics
import tempfile
import time
from collections import deque
from collections.abc import Callable
from contextlib import ExitStack
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import zenoh
from table import ATARI, segments

from common.messaging.clients import InsertClient, SampleClient
from common.messaging.messages.insert import encode_segment
from common.messaging.route import open_client
from common.messaging.session import open_session
from common.messaging.transport import Node, new_incarnation
from common.process.lifecycle import Stop
from common.process.memory import keep_freed_memory
from common.process.processes import ChildProcess, command, free_endpoint
from common.settings.tables import validated
from learner.join_service import JoinService
from learner.roster import Roster
from learner.shared_epochs import SharedEpochs

BATCH, PREFETCH, STEPS = 32, 4, 32
CAPACITY = 50_000
FRAMES = BATCH * (ATARI.stack + 1)  # of a batch without repeats
FRAME_BYTES = 84 * 84
RUN = "bench"
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


def bare_server(endpoint: str, shared_memory: bool, end: Connection) -> None:
    """Gather and copy with numpy in two queryables, each in its own thread (Zenoh's callbacks)."""
    ring = np.ones((CAPACITY, FRAME_BYTES), np.uint8)
    keep_freed_memory()
    rng = np.random.default_rng(0)
    picks = rng.integers(0, CAPACITY - ATARI.stack, (1000, BATCH, 1)) + np.arange(ATARI.stack + 1)
    payload = bytearray(FRAMES * FRAME_BYTES)
    out = np.frombuffer(payload, np.uint8).reshape(FRAMES, FRAME_BYTES)
    drawn = inserted = 0

    def sample(query: zenoh.Query) -> None:
        nonlocal drawn
        with query:
            # mode: without it numpy first gathers into a buffer
            np.take(ring, picks[drawn % 1000].reshape(-1), axis=0, out=out, mode="clip")
            drawn += 1
            query.reply("bare/sample", payload)

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


def inserter(endpoints: tuple[str, ...], routed: bool, shared_memory: bool, end: Connection) -> None:
    """Insert on demand; answers each (mode, seconds, rate) with the number of transitions acknowledged per second.

    routed: the endpoints are a router's; such a process has the mode "routed" only.
    """
    incarnation = new_incarnation()
    stream = (msgspec.structs.replace(segment, incarnation=incarnation) for segment in segments(ATARI, STEPS))
    bare = encode_segment(RUN, next(segments(ATARI, STEPS)))
    waiting: deque[Any] = deque()
    if routed:
        session = open_client(endpoints, None, shared_memory, 30.0, Stop())
        assert session is not None
    else:
        session = open_session((), endpoints, shared_memory=shared_memory)
    with Node(session, RUN, "actor", incarnation) as node:
        client = InsertClient(node, Stop(), window=WINDOW)

        def insert_bare() -> None:
            if len(waiting) == WINDOW:
                waiting.popleft().recv()
            waiting.append(node.session.get("bare/insert", handler=zenoh.handlers.FifoChannel(2), payload=bare))

        def insert(mode: str) -> None:
            insert_bare() if mode == "bare" else client.submit(next(stream))

        for mode in ("routed",) if routed else ("coop", "bare"):
            insert(mode)
        end.send("ready")
        while (work := end.recv()) is not None:
            mode, seconds, rate = work
            done, begun = 0, time.monotonic()
            while (now := time.monotonic() - begun) < seconds:
                if done > rate * now:
                    time.sleep(STEPS / rate)
                else:
                    insert(mode)
                    done += STEPS
            client.drain()
            while waiting:
                waiting.popleft().recv()
            end.send(done / (time.monotonic() - begun))


class BareSampler:
    """Keeps `PREFETCH` bare draws in flight."""

    def __init__(self, session: zenoh.Session) -> None:
        self._session = session
        self._waiting = deque(self._ask() for _ in range(PREFETCH))

    def next(self) -> object:
        """The frames of one batch, uint8 [FRAMES, FRAME_BYTES]."""
        reply = self._waiting.popleft().recv()
        self._waiting.append(self._ask())
        assert reply.ok is not None
        return np.frombuffer(reply.ok.payload.to_bytes(), np.uint8).reshape(FRAMES, FRAME_BYTES)

    def _ask(self) -> Any:  # noqa: ANN401 (zenoh's handler)
        return self._session.get("bare/sample", handler=zenoh.handlers.FifoChannel(2), payload=b"x" * 200)


class Bench:
    """All processes of one transport, warmed up.

    folder: for the logs. router: with a router, and two more inserting processes behind it.

    Attributes:
        modes: to be compared.
    """

    def __init__(self, stack: ExitStack, shared_memory: bool, folder: Path, router: bool) -> None:
        keep_freed_memory()
        head, replay, bare, gate = (free_endpoint() for _ in range(4))
        gates = [gate] if router else []
        spawn = multiprocessing.get_context("spawn")

        def start(target: Callable[..., None], *args: object) -> Connection:
            ours, theirs = spawn.Pipe()
            process = spawn.Process(target=target, args=(*args, shared_memory, theirs))
            process.start()
            stack.callback(process.join)
            stack.callback(ours.send, None)
            assert ours.recv() == "ready"
            return ours

        def serve(name: str, *flags: str) -> None:
            service = ChildProcess(name, command(f"coop-{name}", *flags), folder / name)
            service.start()
            stack.callback(service.end, 10)
            stack.callback(service.interrupt)

        start(bare_server, bare)
        incarnation = new_incarnation()
        session = open_session((head,), (bare,), shared_memory=shared_memory)
        node = stack.enter_context(Node(session, RUN, "learner", incarnation))
        JoinService(
            node, CONFIG, ATARI, "", run_id=0, epochs=SharedEpochs([], "benchmark"), roster=Roster(), event=print
        )
        flags = ["--run", RUN, "--connect", head, *gates, "--listen", replay, "--run-dir", str(folder)]
        serve("replay", *flags, *["--shared-memory"] * shared_memory)
        direct = [start(inserter, (head, replay, bare), False) for _ in range(2)]
        sampler = SampleClient(node, Stop(), incarnation, ATARI, BATCH, PREFETCH)
        self._samplers: dict[str, SampleClient | BareSampler] = {"coop": sampler}
        self._inserters = {"coop": direct}
        if router:
            serve("router", "--connect", head, "--listen", gate)
            self._samplers["routed"] = sampler
            self._inserters["routed"] = [start(inserter, (gate,), True) for _ in range(2)]
        else:
            self._samplers["bare"] = BareSampler(session)
            self._inserters["bare"] = direct
        self.modes = tuple(self._samplers)
        for mode in self.modes:
            self.insert(mode, 1.0)
            self.sample(mode, 1.0, 1000.0)

    def insert(self, mode: str, seconds: float) -> float:
        """Transitions/s that both processes insert at full speed."""
        return sum(self._work(mode, seconds, math.inf, lambda: None))

    def sample(self, mode: str, seconds: float, rate: float) -> tuple[float, float]:
        """(batches/s drawn while both insert, transitions/s that they insert)."""
        sampler, batches = self._samplers[mode], 0

        def draw() -> None:
            nonlocal batches
            end = time.monotonic() + seconds
            while time.monotonic() < end:
                batches += sampler.next() is not None

        inserted = sum(self._work(mode, seconds, rate / 2, draw))
        return batches / seconds, inserted

    def _work(self, mode: str, seconds: float, rate: float, meanwhile: Callable[[], None]) -> list[float]:
        inserters = self._inserters[mode]
        for end in inserters:
            end.send((mode, seconds, rate))
        meanwhile()
        return [end.recv() for end in inserters]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=3.0, help="of each measurement")
    parser.add_argument("--insert-rate", type=float, default=5200, help="transitions/s inserted during draws, by both")
    parser.add_argument("--router", action="store_true", help="compare with processes behind a router, over TCP")
    options = parser.parse_args()
    print(f"{options.rounds} rounds of {options.seconds:g} s: median (lowest to highest)")
    for shared_memory in (False,) if options.router else (False, True):
        with tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
            bench = Bench(stack, shared_memory, Path(folder), options.router)
            figures: dict[str, list[float]] = {}
            for _ in range(options.rounds):
                for mode in bench.modes:
                    batches, meanwhile = bench.sample(mode, options.seconds, options.insert_rate)
                    figures.setdefault(f"{mode}: batches of {BATCH}/s", []).append(batches)
                    figures.setdefault(f"{mode}:   transitions/s inserted meanwhile", []).append(meanwhile)
                    inserted = bench.insert(mode, options.seconds)
                    figures.setdefault(f"{mode}: transitions/s inserted alone", []).append(inserted)
        print("\nshared memory" if shared_memory else "\nTCP")
        for name, values in figures.items():
            print(f"  {name:45}{statistics.median(values):9,.0f} ({min(values):,.0f} to {max(values):,.0f})")


if __name__ == "__main__":
    main()
