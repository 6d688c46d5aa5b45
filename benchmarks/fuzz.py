"""Floods a live replay service and a live learner with hostile messages: `python benchmarks/fuzz.py --messages 200000`.

Half of the messages arrive while an actor plays. Then the actor leaves, the state is recorded, the other half arrives,
and the state must be unchanged, byte for byte: the table with its counters and random state, both networks, the role.
Every broken message must be refused and counted. Then the actor returns and the run must go on, with nothing lost.

Finally come valid messages that an actor's certificate may send: with every number at its largest allowed value, and
mutations that left a message valid. They may waste the run's time and spoil its learning, but the run must go on, its
actor must be served, and another actor must be able to join. Otherwise the exit status is 1.
"""

from __future__ import annotations

import argparse
import contextlib
import random
import socket
import sys
import tempfile
import time
from collections import Counter, deque
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from mutations import mutate
from roles import Roles, RunWatch, replay_stats, running, wait_until
from targets import RUN, Target, extremes, targets

from coop.common.errors import BadMessage, CoopError, RunError
from coop.common.messaging import wire
from coop.common.messaging.joining import join
from coop.common.messaging.keys import replay_key
from coop.common.messaging.messages.control import Join, Snapshot, Written
from coop.common.messaging.messages.weights import Current
from coop.common.messaging.session import open_session
from coop.common.messaging.transport import Node, Pending, Refused, new_incarnation
from coop.common.process.lifecycle import Stop
from coop.common.process.processes import free_endpoint

CHECKPOINT = 1  # the same number in the snapshots before and after
WINDOW = 64  # broken messages in flight
QUIET = 2.0  # seconds without a change that count as idle
VALID_EVERY = 15  # broken messages for each valid one
RAW_EVERY = 1000  # broken messages between connections that send other data than Zenoh's


class Flood:
    """Sends broken messages, and counts them by the role that must refuse them."""

    def __init__(self, node: Node, targets: list[Target], rng: random.Random, ports: list[int]) -> None:
        self.sent: Counter[str] = Counter()
        self._node = node
        self._targets = targets
        self._rng = rng
        self._ports = ports
        self._samples = [target.valid for target in targets]
        self._outstanding: deque[Pending] = deque()

    def send(self, count: int) -> None:
        """Send `count` broken messages; raises RunError if one is not refused."""
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
            if not self._is_valid(target, payload):
                return payload

    @staticmethod
    def _is_valid(target: Target, payload: bytes) -> bool:
        try:
            message = wire.decode(payload)
            target.read(message)
        except BadMessage:
            return False
        return message.run == RUN

    def still_valid(self, count: int) -> Iterator[tuple[str, bytes]]:
        """Yield key and payload of `count` mutations that leave a public message valid."""
        public = [target for target in self._targets if target.public]
        while count:
            target = self._rng.choice(public)
            payload = mutate(self._rng, target.valid, self._samples)
            if payload != target.valid and self._is_valid(target, payload):
                count -= 1
                yield target.key, payload

    def send_valid(self, messages: list[tuple[str, bytes]]) -> None:
        """Send valid messages, and wait for any answers."""
        for key, payload in messages:
            self._outstanding.append(self._node.begin(key, bytearray(payload), timeout=60.0))
            if len(self._outstanding) >= WINDOW:
                self._settle_valid()
        while self._outstanding:
            self._settle_valid()

    def _settle_valid(self) -> None:
        with contextlib.suppress(Refused):  # for example, an actor number that was never given
            self._outstanding.popleft().wait()

    def _settle(self) -> None:
        try:
            answer = self._outstanding.popleft().wait()
        except Refused:
            return
        raise RunError(f"a broken message was taken, and answered with {answer.kind}")

    def _knock(self) -> None:
        """Connect to each port and send data that are not Zenoh's."""
        for port in self._ports:
            with socket.create_connection(("127.0.0.1", port)) as stranger:
                stranger.sendall(self._rng.randbytes(self._rng.choice((1, 3, 100, 5000))))


class Watch:
    """The state of the live roles, by their own account."""

    def __init__(self, node: Node, folder: Path) -> None:
        self.node = node
        self._folder = folder
        self._status = node.latest(node.key("metrics", "learner", "*"))
        self._newest: dict[str, Any] = {}
        self._asked = 0  # how often the replay service was asked for its state

    def steps(self) -> int:
        """The replay service's count of transitions."""
        return replay_stats(self.node).inserted

    def learner(self, field: str) -> int:
        """A field of the learner's status."""
        message = self._status.poll()
        if message is not None:
            self._newest = dict(message.fields)
        return int(self._newest.get(field, 0))

    def rest(self) -> None:
        """Wait until table and learner are idle."""
        state, since = None, time.monotonic()
        while time.monotonic() - since < QUIET:
            stats = replay_stats(self.node)
            now = stats.inserted, stats.drawn, self.learner("updates")
            if now != state:
                state, since = now, time.monotonic()
            time.sleep(0.1)

    def everything(self) -> dict[str, bytes]:
        """The states of both roles, as bytes."""
        key = replay_key(self.node, "snapshot")
        self._asked += 1
        self.node.ask(key, Snapshot(CHECKPOINT, [], 1, self._asked).encode(RUN), 60.0)
        while self.node.ask(key, Written(CHECKPOINT).encode(RUN), 60.0).kind == "retry":
            pass
        saved = self._folder / "checkpoints" / str(CHECKPOINT) / "replay"
        state = {path.name: path.read_bytes() for path in saved.iterdir()}
        question = Current().encode(RUN)
        for key in (("weights", "1"), ("weights", "2"), ("role",)):
            answer = self.node.ask(self.node.key(*key), question)
            arrays = {name: array.tobytes() for name, array in answer.arrays.items()}
            state["/".join(key)] = repr((answer.fields, arrays)).encode()
        return state


def fuzz(count: int, seed: int, folder: Path) -> None:
    """Raise a CoopError if a check fails."""
    at = free_endpoint(), free_endpoint()
    ports = [int(endpoint.rpartition(":")[2]) for endpoint in at]
    flags = ("--preset=cartpole", "--learner.mirror=on", "--total-steps=100000000", "--replay.ratio=0.1")
    roles = Roles.of_run(folder, RUN, at, flags, actors=2)
    actor = roles.processes["actor 1"]
    with running(roles, "actor 2"), Node(open_session((), at), RUN, "watch", new_incarnation()) as node:
        reply = join(node, Stop(), Join("actor", new_incarnation(), []), at, 60.0, need_replay=True)
        assert reply is not None
        watch, flood = Watch(node, folder), Flood(node, targets(node, reply), random.Random(seed), ports)
        wait_until("the first updates", lambda: watch.learner("updates") > 0)

        before, began = watch.steps(), time.monotonic()
        flood.send(count // 2)
        busy, seconds = watch.steps() - before, time.monotonic() - began
        print(f"{count // 2:,} broken messages in {seconds:.0f} s, {busy:,} transitions of a live actor meanwhile")
        roles.check("learner", "replay", "actor 1")
        if not busy:
            raise RunError("no valid traffic got through")

        actor.interrupt()
        actor.end(60.0)
        watch.rest()
        state, began = watch.everything(), time.monotonic()
        flood.send(count - count // 2)
        seconds = time.monotonic() - began
        changed = [name for name, value in watch.everything().items() if state[name] != value]
        print(
            f"{count - count // 2:,} broken messages in {seconds:.0f} s at rest; "
            f"changed: {', '.join(changed) or 'nothing'}"
        )
        if changed:
            raise RunError(f"broken messages changed {', '.join(changed)}")
        roles.check("learner", "replay")

        wait_until("the learner's count", lambda: watch.learner("bad_messages") >= flood.sent["learner"])
        counted = {"replay": replay_stats(node).bad_messages, "learner": watch.learner("bad_messages")}
        print(f"refused and counted: {counted}, sent: {dict(flood.sent)}")
        if counted != dict(flood.sent):
            raise RunError("not every broken message was counted")

        actor.start()
        before = watch.steps()
        wait_until("the actor's return", lambda: watch.steps() > before + 1000)
        stats = replay_stats(node)
        print(f"the run went on to {stats.inserted:,} steps: lost {stats.lost}, duplicated {stats.duplicates}")
        if stats.lost or stats.duplicates:
            raise RunError("the counters of the run are wrong")
        survive(roles, watch, flood, [*extremes(node, reply.spec), *flood.still_valid(count // VALID_EVERY)], at[0])


def survive(roles: Roles, watch: Watch, flood: Flood, messages: list[tuple[str, bytes]], learner_at: str) -> None:
    """Raise a CoopError if valid messages stop the run, its actor, or another actor that joins."""
    with RunWatch(RUN, learner_at) as actors:
        wait_until("the actor's status", lambda: bool(actors.acked()))
        flood.send_valid(messages)
        roles.check("learner", "replay", "actor 1")
        updates, acked = watch.learner("updates"), max(actors.acked().values())
        wait_until("updates after valid messages", lambda: watch.learner("updates") > updates + 50)
        wait_until("receipts after valid messages", lambda: max(actors.acked().values()) > acked + 500)
        known = set(actors.acked())
        roles.processes["actor 2"].start()
        wait_until("another actor", lambda: any(actors.acked()[name] for name in set(actors.acked()) - known))
        roles.check(*roles.processes)
        faults = replay_stats(watch.node).faults + watch.learner("faults")
    summary = roles.finish()
    print(f"{len(messages):,} valid messages: the run went on to {summary['env_steps']:,} steps, faults {faults}")
    if faults:
        raise RunError("valid messages led to errors of this program")


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
