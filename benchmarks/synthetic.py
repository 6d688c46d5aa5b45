"""Synthetic actors for `fan_in.py`: many in one process, each with the sessions, messages and rhythm of `coop-actor`.

They play nothing: their segments repeat one set of frames, and of the weights they note only that they came.
"""

from __future__ import annotations

import heapq
import math
import time
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import count, islice
from multiprocessing.connection import Connection
from typing import NamedTuple

import msgspec
import zenoh
from table import ATARI, segments
from zenoh.handlers import Callback, FifoChannel

from actors.service import STATUS_EVERY
from actors.weights import GRACE
from common.errors import RunError
from common.messaging import wire
from common.messaging.clients import INSERT_TIMEOUT
from common.messaging.joining import IDLE_ASK_EVERY, RETRY_PAUSE
from common.messaging.keys import join_key, replay_key, role_key, run_key, status_key, weights_key
from common.messaging.messages.answers import Ack
from common.messaging.messages.insert import encode_segment
from common.messaging.messages.join import Join, Leave
from common.messaging.messages.status import ActorStatus
from common.messaging.messages.weights import Current, Role
from common.messaging.transport import new_incarnation, open_session
from common.messaging.wire import Message
from common.process.memory import keep_freed_memory

STEPS, STREAMS = 32, 8  # of a segment; emulators of an actor
WINDOW = 2 * STREAMS  # segments in flight, as many as an actor has by default
AT_ONCE = 16  # actors of a process that join at the same time
AGE_EVERY = 1.0  # seconds
PATIENCE = 120.0  # seconds for an actor to join, and for the last acknowledgements
TEMPLATES = list(islice(segments(ATARI, STEPS, STREAMS), 2 * STREAMS))  # the first segment of each stream, and the next


class Share(NamedTuple):
    """What the actors of one process have done; seconds.

    sent, acked: transitions. ages: of the acting network's parameters since their broadcast, by actor, once a second.
    missing: broadcasts that an actor had to ask for. late: how far the process fell behind its own schedule.
    """

    sent: int
    acked: int
    waits: list[float]
    ages: list[float]
    missing: int
    retries: int
    late: float
    processor: float


class Space(NamedTuple):
    """A run's keys."""

    run: str

    def key(self, *parts: str) -> str:
        """A key of this run."""
        return run_key(self.run, *parts)


class Broadcasts:
    """When the processes' actors first heard of each broadcast, by network and version."""

    def __init__(self) -> None:
        self._named: dict[tuple[int, int], float] = {}

    def named(self, network: int, version: int) -> float:
        """The time at which this version was first named: now, if it is new."""
        return self._named.setdefault((network, version), time.monotonic())


class SyntheticActor:
    """One actor: joins at construction.

    Raises:
        RunError: it could not join within `PATIENCE` seconds.
    """

    def __init__(self, space: Space, learner: str, broadcasts: Broadcasts) -> None:
        self.space = space
        self.sent = 0
        self.acked = 0
        self.missing = 0
        self.retries = 0
        self.waits: list[float] = []
        self.in_flight = 0
        self.again: deque[tuple[bytearray, float]] = deque()
        self._broadcasts = broadcasts
        self._numbers = count()
        self._held = [-1, -1]
        self._received = [False, False]  # parameters whose version the next role will tell
        self._told = [-1, -1]
        self._acting = 0
        self._incarnation = new_incarnation()
        self._request = Join("actor", self._incarnation, [])
        self.session = open_session((), (learner,))
        name = f"{self._incarnation:x}"
        self._token = self.session.liveliness().declare_token(space.key("alive", "actor", name))
        self._status = self.session.declare_publisher(status_key(space, "actor", name))
        self._subscribe(role_key(space), self._on_role)
        for network in (1, 2):
            self._subscribe(weights_key(space, network), lambda _, network=network: self._came(network))
        endpoints = self._join()
        self.fetch()
        self.route = open_session((), endpoints)
        self._route_token = self.route.liveliness().declare_token(space.key("alive", "route", name))

    def send(self) -> None:
        """Send the next segment, unless the window is full; first those whose answer was a refusal."""
        while self.again:
            self._send(*self.again.popleft())
        if self.in_flight >= WINDOW:
            return
        number = next(self._numbers)
        sequence, stream = divmod(number, STREAMS)
        segment = msgspec.structs.replace(
            TEMPLATES[stream + STREAMS * (sequence > 0)],
            incarnation=self._incarnation,
            sequence=sequence,
            acked=self.acked,
        )
        self.in_flight += 1
        self.sent += STEPS
        self._send(encode_segment(self.space.run, segment), time.monotonic())

    def publish_status(self) -> None:
        """Publish the status, as an actor does twice a second."""
        self._status.put(ActorStatus(self.sent, self.acked).encode(self.space.run))

    def ask(self) -> None:
        """Ask the learner for news of the run's members, as an actor does every few seconds."""
        self._get(self.session, join_key(self.space, "actor"), self._request.encode(self.space.run), lambda _: None)

    def age(self) -> float:
        """Seconds since the broadcast of the parameters that act now; asks for newer ones if it missed them."""
        held, told = self._held[self._acting], self._told[self._acting]
        if held < told and time.monotonic() - self._broadcasts.named(self._acting, told) > GRACE:
            self.missing += 1
            self.fetch()
        return time.monotonic() - self._broadcasts.named(self._acting, held)

    def fetch(self) -> None:
        """Ask the learner for both networks."""
        for network in (1, 2):
            question = Current().encode(self.space.run)
            self._get(
                self.session,
                weights_key(self.space, network),
                question,
                lambda _, network=network: self._came(network),
            )

    def leave(self) -> None:
        """Tell the learner that this actor stops; its links go with the process."""
        payload = Leave(self._incarnation).encode(self.space.run)
        for _ in self.session.get(join_key(self.space, "actor"), handler=FifoChannel(2), payload=payload, timeout=5.0):
            pass

    def _join(self) -> Sequence[str]:
        """Ask the learner until it answers with the replay service's endpoints."""
        deadline = time.monotonic() + PATIENCE
        while time.monotonic() < deadline:
            payload = self._request.encode(self.space.run)
            key = join_key(self.space, "actor")
            for reply in self.session.get(key, handler=FifoChannel(2), payload=payload, timeout=5.0):
                if reply.ok is not None and (message := wire.decode(reply.ok.payload.to_bytes())).kind == "joined":
                    endpoints: list[str] = message.fields["replay_endpoints"]
                    self._request = msgspec.structs.replace(self._request, index=message.fields["index"])
                    if endpoints:
                        return endpoints
            time.sleep(RETRY_PAUSE)
        raise RunError(f"an actor could not join within {PATIENCE:g} s")

    def _send(self, payload: bytearray, first: float) -> None:
        answered = False

        def on_answer(message: Message) -> None:
            nonlocal answered
            answered = message.kind == Ack.kind
            if answered:
                self.waits.append(time.monotonic() - first)
                self.acked += STEPS
                self.in_flight -= 1

        def on_end() -> None:
            if not answered:
                self.retries += 1
                self.again.append((payload, first))

        key = replay_key(self.space, "insert")
        self._get(self.route, key, payload, lambda raw: on_answer(wire.decode(raw.to_bytes())), on_end)

    def _get(
        self,
        session: zenoh.Session,
        key: str,
        payload: bytearray,
        on_payload: Callable[[zenoh.ZBytes], None],
        on_end: Callable[[], None] = lambda: None,
    ) -> None:
        """Send a query; the answer is read in Zenoh's threads."""
        session.get(
            key,
            handler=Callback(lambda reply: on_payload(reply.ok.payload) if reply.ok else None, on_end, indirect=False),
            payload=payload,
            timeout=INSERT_TIMEOUT,
            congestion_control=zenoh.CongestionControl.BLOCK,
            consolidation=zenoh.ConsolidationMode.NONE,
        )

    def _subscribe(self, key: str, on_sample: Callable[[zenoh.Sample], None]) -> None:
        self.session.declare_subscriber(key, Callback(on_sample, indirect=False))

    def _on_role(self, sample: zenoh.Sample) -> None:
        """A role follows each broadcast, so it names the parameters that came before it."""
        role = Role.decode(wire.decode(sample.payload.to_bytes()))
        self._acting, self._told = role.acting - 1, list(role.versions)
        for network, version in enumerate(role.versions):
            self._broadcasts.named(network, version)
            if self._received[network]:
                self._received[network], self._held[network] = False, version

    def _came(self, network: int) -> None:
        self._received[network - 1] = True


class Crowd:
    """The actors of one process."""

    def __init__(self, space: Space, learner: str) -> None:
        self.actors: list[SyntheticActor] = []
        self._space = space
        self._learner = learner
        self._broadcasts = Broadcasts()

    def join(self, number: int) -> None:
        """Let so many actors join."""
        with ThreadPoolExecutor(AT_ONCE) as pool:
            joining = [pool.submit(SyntheticActor, self._space, self._learner, self._broadcasts) for _ in range(number)]
            self.actors += [one.result() for one in joining]

    def leave(self) -> None:
        """Let all actors leave."""
        with ThreadPoolExecutor(AT_ONCE) as pool:
            list(pool.map(SyntheticActor.leave, self.actors))

    def play(self, rate: float, seconds: float) -> Share:
        """Insert `rate` transitions per second in all, as evenly as the windows permit, and wait for the answers."""
        began, ages, late = time.monotonic(), [], 0.0
        processor, number = time.process_time(), len(self.actors)
        before = [(one.sent, one.acked, len(one.waits), one.missing, one.retries) for one in self.actors]
        every = {
            "send": number * STEPS / rate,
            "status": STATUS_EVERY,
            "ask": IDLE_ASK_EVERY,
            "age": AGE_EVERY,
        }
        agenda = [
            (began + pause * (index + 0.5) / number, index, what)
            for what, pause in every.items()
            for index in range(number)
        ]
        heapq.heapify(agenda)
        while (now := time.monotonic()) < began + seconds:
            due, index, what = agenda[0]
            if due > now:
                time.sleep(min(due, began + seconds) - now)
                continue
            late = max(late, now - due)
            heapq.heapreplace(agenda, (max(due + every[what], now - 1.0), index, what))
            one = self.actors[index]
            if what == "send":
                one.send()
            elif what == "status":
                one.publish_status()
            elif what == "ask":
                one.ask()
            else:
                ages.append(one.age())
        self._drain()
        done = [
            (one.sent - sent, one.acked - acked, one.waits[waits:], one.missing - missing, one.retries - retries)
            for one, (sent, acked, waits, missing, retries) in zip(self.actors, before, strict=True)
        ]
        sent, acked, waits, missing, retries = zip(*done, strict=True)
        return Share(
            sum(sent),
            sum(acked),
            [wait for many in waits for wait in many],
            ages,
            sum(missing),
            sum(retries),
            late,
            time.process_time() - processor,
        )

    def fill(self, transitions: int) -> None:
        """Let the first actor insert at least so many transitions, as fast as its window permits."""
        one = self.actors[0]
        while one.acked < transitions:
            before = one.sent
            one.send()
            if one.sent == before:
                time.sleep(0.001)
        self._drain()

    def _drain(self) -> None:
        """Wait for all acknowledgements; repeats what was refused."""
        deadline = time.monotonic() + PATIENCE
        while any(one.in_flight for one in self.actors) and time.monotonic() < deadline:
            for one in self.actors:
                while one.again:
                    one._send(*one.again.popleft())
            time.sleep(0.01)


def serve(run: str, learner: str, end: Connection) -> None:
    """Carry out the parent's calls of `Crowd`'s methods, (name, arguments), until it ends."""
    keep_freed_memory()
    crowd = Crowd(Space(run), learner)
    while True:
        name, arguments = end.recv()
        end.send(getattr(crowd, name)(*arguments))


def percentile(values: Sequence[float], share: float) -> float:
    """The value that a share of all values does not exceed; NaN if there are none."""
    if not values:
        return math.nan
    return sorted(values)[min(len(values) - 1, int(share * len(values)))]
