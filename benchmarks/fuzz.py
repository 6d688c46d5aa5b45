"""Floods a live replay service and a live learner with broken messages: `python benchmarks/fuzz.py --messages 200000`.

Half of them arrive while an actor plays. Then the actor leaves, everything is written down, the other half arrives, and
everything must be as it was, byte for byte: the table with its books and random state, both networks, the role. Every
broken message must be refused and counted. At last the actor comes back and the run must go on. Exit status 1 if not.

A mutation that leaves a message valid is not sent: no receiver can tell it from a real one.
"""

from __future__ import annotations

import argparse
import random
import socket
import sys
import tempfile
import time
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from mutations import mutate
from roles import Roles, replay_stats, running, wait_until

from common.errors import BadMessage, CoopError, RunError
from common.messaging import wire
from common.messaging.joining import join
from common.messaging.keys import join_key, replay_key
from common.messaging.messages.epoch import Snapshot, Written
from common.messaging.messages.insert import SegmentReader, encode_segment
from common.messaging.messages.join import Join, Joined
from common.messaging.messages.limits import Limit, LimitsQuestion
from common.messaging.messages.sample import DrawRequest
from common.messaging.messages.stats import StatsQuestion
from common.messaging.messages.stop import EndOfRun
from common.messaging.messages.weights import Current
from common.messaging.transport import Node, Pending, Refused, new_incarnation, open_session
from common.messaging.wire import Message
from common.process.lifecycle import Stop
from common.process.processes import free_endpoint
from common.types import EpisodeEnd, Segment

RUN = "fuzz"
WINDOW = 64  # broken messages under way at once
QUIET = 2.0  # seconds without a change that count as rest
RAW_EVERY = 1000  # broken messages between connections that do not even speak Zenoh


@dataclass(frozen=True)
class Target:
    """A key, a valid message for it, who counts what is bad there, and who can tell (raises BadMessage)."""

    key: str
    valid: bytes
    owner: str
    read: Callable[[Message], Any]
    answers: bool = True


class Flood:
    """Sends broken messages and keeps count of them by owner."""

    def __init__(self, node: Node, targets: list[Target], rng: random.Random, ports: list[int]) -> None:
        self.sent: Counter[str] = Counter()
        self.still_valid = 0
        self._node = node
        self._targets = targets
        self._rng = rng
        self._ports = ports
        self._samples = [target.valid for target in targets]
        self._outstanding: deque[Pending] = deque()

    def send(self, count: int) -> None:
        """Send `count` of them; raises RunError where one is not refused."""
        for number in range(count):
            target = self._rng.choice(self._targets)
            payload = bytearray(self._broken(target))
            self.sent[target.owner] += 1
            if target.answers:
                self._outstanding.append(self._node.begin(target.key, payload, timeout=60.0))
            else:
                self._node.announce(target.key, payload)
            if len(self._outstanding) >= WINDOW:
                self._settle()
            if number % RAW_EVERY == 0:
                self._knock()
        while self._outstanding:
            self._settle()

    def _broken(self, target: Target) -> bytes:
        while True:
            payload = mutate(self._rng, target.valid, self._samples)
            try:
                message = wire.decode(payload)
                target.read(message)
            except BadMessage:
                return payload
            if message.run != RUN:
                return payload
            self.still_valid += 1

    def _settle(self) -> None:
        try:
            answer = self._outstanding.popleft().wait()
        except Refused:
            return
        raise RunError(f"a broken message was taken, and answered with {answer.kind}")

    def _knock(self) -> None:
        """Connect to each port and say something that is no Zenoh."""
        for port in self._ports:
            with socket.create_connection(("127.0.0.1", port)) as stranger:
                stranger.sendall(self._rng.randbytes(self._rng.choice((1, 3, 100, 5000))))


def targets(node: Node, joined: Joined) -> list[Target]:
    """Everything that learner and replay service listen to."""
    spec, batch_size = joined.spec, joined.config.learner.batch_size
    steps = 4
    index = np.arange(steps, dtype=np.int32)[:, None] + np.zeros(spec.stack, np.int32)
    segment = Segment(
        incarnation=1,
        stream=0,
        sequence=0,
        frames=np.zeros((steps + 1, *spec.frame_shape), spec.frame_dtype),
        obs_index=index,
        next_index=index + 1,
        actions=np.zeros(steps, np.int32),
        rewards=np.zeros(steps, np.float32),
        terminated=np.zeros(steps, np.bool_),
        param_version=np.zeros(steps, np.int64),
        episodes=(EpisodeEnd(steps - 1, 1.0, steps, 0.1, 0.2, 0.3, 5),),
    )

    def sample(message: Message) -> None:
        if DrawRequest.decode(message).batch_size != batch_size:
            raise BadMessage("fields.batch_size", "not this run's")

    def snapshot(message: Message) -> None:
        (Snapshot.decode if message.kind == "snapshot" else Written.decode)(message)

    def limiting(message: Message) -> None:
        if message.kind == "limit":
            Limit.decode(message)
        else:
            LimitsQuestion.decode(message)

    def joining(role: str, message: Message) -> None:
        if Join.decode(message).role != role:
            raise BadMessage("fields.role", "not this key's")

    draw = DrawRequest(1, 0, 0, batch_size, 0)
    made: list[tuple[str, bytearray, str, Callable[[Message], Any]]] = [
        (replay_key(node, "insert"), encode_segment(RUN, segment), "replay", SegmentReader(spec)),
        (replay_key(node, "sample"), draw.encode(RUN), "replay", sample),
        (replay_key(node, "limits"), Limit(1.0, 64.0).encode(RUN), "replay", limiting),
        (replay_key(node, "limits"), LimitsQuestion().encode(RUN), "replay", limiting),
        (replay_key(node, "stats"), StatsQuestion().encode(RUN), "replay", StatsQuestion.decode),
        (replay_key(node, "snapshot"), Snapshot(7, [3]).encode(RUN), "replay", snapshot),
        (replay_key(node, "snapshot"), Written(7).encode(RUN), "replay", snapshot),
        *(
            (join_key(node, role), Join(role, 5, []).encode(RUN), "learner", partial(joining, role))
            for role in ("actor", "replay")
        ),
        (node.key("weights", "1"), Current().encode(RUN), "learner", Current.decode),
        (node.key("weights", "2"), Current().encode(RUN), "learner", Current.decode),
        (node.key("role"), Current().encode(RUN), "learner", Current.decode),
    ]
    queried = [Target(key, bytes(payload), owner, read) for key, payload, owner, read in made]
    stop = Target(node.key("stop"), bytes(EndOfRun.because("x").encode(RUN)), "replay", EndOfRun.decode, answers=False)
    return [*queried, stop]


class Watch:
    """What the live roles tell of themselves."""

    def __init__(self, node: Node, folder: Path) -> None:
        self._node = node
        self._folder = folder
        self._status = node.latest(node.key("metrics", "learner", "*"))
        self._told: dict[str, Any] = {}

    def steps(self) -> int:
        """Transitions in the books of the replay service."""
        return replay_stats(self._node).inserted

    def learner(self, field: str) -> int:
        """A field of the learner's status."""
        message = self._status.take()
        if message is not None:
            self._told = dict(message.fields)
        return int(self._told.get(field, 0))

    def rest(self) -> None:
        """Wait until table and learner stand still."""
        state, since = None, time.monotonic()
        while time.monotonic() - since < QUIET:
            stats = replay_stats(self._node)
            now = stats.inserted, stats.drawn, self.learner("updates")
            if now != state:
                state, since = now, time.monotonic()
            time.sleep(0.1)

    def everything(self, number: int) -> dict[str, bytes]:
        """The state of both roles, in bytes."""
        key = replay_key(self._node, "snapshot")
        self._node.ask(key, Snapshot(number, []).encode(RUN), 60.0)
        while self._node.ask(key, Written(number).encode(RUN), 60.0).kind == "retry":
            pass
        saved = self._folder / "checkpoints" / str(number) / "replay"
        state = {path.name: path.read_bytes() for path in saved.iterdir()}
        question = Current().encode(RUN)
        for key in (("weights", "1"), ("weights", "2"), ("role",)):
            answer = self._node.ask(self._node.key(*key), question)
            arrays = {name: array.tobytes() for name, array in answer.arrays.items()}
            state["/".join(key)] = repr((answer.fields, arrays)).encode()
        return state


def fuzz(count: int, seed: int, folder: Path) -> None:
    """Raise a CoopError where something is not as it should be."""
    at = free_endpoint(), free_endpoint()
    ports = [int(endpoint.rpartition(":")[2]) for endpoint in at]
    flags = ("--preset=cartpole", "--total-steps=100000000")
    roles = Roles(folder, RUN, at, flags, actors=1)
    actor = roles.processes["actor 1"]
    with running(roles), Node(open_session((), at), RUN, "watch", new_incarnation()) as node:
        joined = join(node, Stop(), Join("actor", new_incarnation(), []), at, 60.0, need_replay=True)
        assert joined is not None
        watch, flood = Watch(node, folder), Flood(node, targets(node, joined), random.Random(seed), ports)
        wait_until("the first updates", lambda: watch.learner("updates") > 0)

        before, began = watch.steps(), time.monotonic()
        flood.send(count // 2)
        busy, seconds = watch.steps() - before, time.monotonic() - began
        print(f"{count // 2:,} broken messages in {seconds:.0f} s, {busy:,} transitions of a live actor meanwhile")
        roles.check(*roles.processes)
        if not busy:
            raise RunError("no valid traffic got through")

        actor.interrupt()
        actor.end(60.0)
        watch.rest()
        state, began = watch.everything(1), time.monotonic()
        flood.send(count - count // 2)
        seconds = time.monotonic() - began
        changed = [name for name, value in watch.everything(2).items() if state[name] != value]
        print(
            f"{count - count // 2:,} broken messages in {seconds:.0f} s at rest; "
            f"changed: {', '.join(changed) or 'nothing'}"
        )
        if changed:
            raise RunError(f"broken messages changed {', '.join(changed)}")
        roles.check("learner", "replay")

        wait_until("the learner's count", lambda: watch.learner("bad_messages") >= flood.sent["learner"])
        counted = {"replay": replay_stats(node).bad_messages, "learner": watch.learner("bad_messages")}
        print(
            f"refused and counted: {counted}, sent: {dict(flood.sent)}; "
            f"{flood.still_valid:,} mutations left out as valid"
        )
        if counted != dict(flood.sent):
            raise RunError("not every broken message was counted")

        actor.start()
        before = watch.steps()
        wait_until("the actor's return", lambda: watch.steps() > before + 1000)
        summary = roles.finish()
    lost, duplicates = summary["transitions_lost"], summary["duplicates_refused"]
    print(f"the run went on to {summary['env_steps']:,} steps: lost {lost}, duplicated {duplicates}")
    if lost or duplicates:
        raise RunError("the books of the run are wrong")


def main() -> None:
    """Parse flags and run."""
    parser = argparse.ArgumentParser(description="Flood a live replay service and learner with broken messages.")
    parser.add_argument("--messages", type=int, default=200_000)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        try:
            fuzz(options.messages, options.seed, Path(folder) / "run")
        except CoopError as error:
            sys.exit(f"fuzz: error: {error}")


if __name__ == "__main__":
    main()
