"""A synthetic actor for `fan_in.py`, with the sessions and messages of `coop-actor`.

It plays nothing: its segments repeat one set of frames, and of the weights it notes only that they came. It has the
links of a real one, but not its threads.
"""

from __future__ import annotations

import contextlib
import time
from collections import deque
from collections.abc import Sequence
from itertools import count, islice
from typing import Any, NamedTuple

import msgspec
import zenoh
from made_up import ATARI, segments
from zenoh.handlers import FifoChannel, RingChannel

from coop.common.errors import RunError
from coop.common.messaging import wire
from coop.common.messaging.keys import join_key, replay_key, role_key, run_key, status_key, weights_key
from coop.common.messaging.members import ROUTE
from coop.common.messaging.messages.answers import Ack
from coop.common.messaging.messages.control import Join, Leave
from coop.common.messaging.messages.insert import encode_segment
from coop.common.messaging.messages.status import ActorStatus
from coop.common.messaging.messages.weights import Current, Role
from coop.common.messaging.session import open_session
from coop.common.messaging.timing import GRACE, INSERT_TIMEOUT, RETRY_PAUSE
from coop.common.messaging.transport import NoAnswer, Pending, new_incarnation

STEPS, STREAMS = 32, 8  # of a segment; emulators of an actor
WINDOW = 2 * STREAMS  # segments in flight, as many as an actor has by default
REPEAT_AFTER = 0.2  # seconds
PATIENCE = 120.0  # seconds for an actor to join, and for the last acknowledgements
REFUSED = wire.decode(bytes(wire.encode("retry", "", {})))
TEMPLATES = list(islice(segments(ATARI, STEPS, STREAMS), 2 * STREAMS))  # the first segment of each stream, and the next


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


class _Sent(NamedTuple):
    """A segment in flight, and when it was first sent."""

    payload: bytearray
    first: float
    pending: Pending


class SyntheticActor:
    """One actor: joins at construction. Its owner polls it: callbacks of many sessions would wait for each other.

    Raises:
        RunError: it could not join within `PATIENCE` seconds.
    """

    def __init__(self, space: Space, learner: str, broadcasts: Broadcasts) -> None:
        self.sent = 0
        self.acked = 0
        self.missing = 0
        self.retries = 0
        self.waits: list[float] = []
        self._space = space
        self._broadcasts = broadcasts
        self._numbers = count()
        self._permitted = 1
        self._in_flight: deque[_Sent] = deque()
        self._again_at = 0.0
        self._asked: list[Pending] = []  # answers that nobody reads
        self._fetched = False
        self._held, self._named, self._acting = [-1, -1], [-1, -1], 0
        self._incarnation = new_incarnation()
        self._request = Join("actor", self._incarnation, [])
        self._session = open_session((), (learner,))
        name = f"{self._incarnation:x}"
        self._token = self._session.liveliness().declare_token(space.key("alive", "actor", name))
        self._status = self._session.declare_publisher(status_key(space, "actor", name))
        self._role = self._subscribe(role_key(space))
        self._weights = [self._subscribe(weights_key(space, network)) for network in (1, 2)]
        endpoints = self._join()
        self._route = open_session((), endpoints)
        self._route_token = self._route.liveliness().declare_token(space.key("alive", ROUTE, name))
        self._fetch()

    @property
    def is_idle(self) -> bool:
        """True if all segments have been acknowledged."""
        return not self._in_flight

    def send(self) -> bool:
        """Send the next segment; return False if the window is full."""
        if len(self._in_flight) >= self._permitted:
            return False
        sequence, stream = divmod(next(self._numbers), STREAMS)
        segment = msgspec.structs.replace(
            TEMPLATES[stream + STREAMS * (sequence > 0)],
            incarnation=self._incarnation,
            sequence=sequence,
            acked=self.acked,
        )
        payload = encode_segment(self._space.run, segment)
        self._in_flight.append(_Sent(payload, time.monotonic(), self._insert(payload)))
        self.sent += STEPS
        return True

    def collect(self) -> None:
        """Take the acknowledgements that have come; repeat what was refused or not answered, a moment later."""
        while self._in_flight and time.monotonic() >= self._again_at:
            sent = self._in_flight[0]
            try:
                message = sent.pending.ready()
            except NoAnswer:
                message = REFUSED
            if message is None:
                return
            if message.kind == Ack.kind:
                self.waits.append(time.monotonic() - sent.first)
                self._permitted = min(WINDOW, Ack.decode(message).window or WINDOW)
                self.acked += STEPS
                self._in_flight.popleft()
            else:
                self.retries += 1
                self._again_at = time.monotonic() + REPEAT_AFTER
                self._in_flight[0] = sent._replace(pending=self._insert(sent.payload))

    def publish_status(self) -> None:
        """Publish the status, as an actor does twice a second."""
        self._status.put(ActorStatus(self.sent, self.acked).encode(self._space.run))

    def ask(self) -> None:
        """Ask the learner for news of the run's members, as an actor does every few seconds."""
        self._asked = [
            _begin(
                self._session, join_key(self._space, "actor"), self._request.encode(self._space.run), self._space.run
            )
        ]

    def age(self) -> float:
        """Seconds since the broadcast of the parameters that act now; asks for newer ones if it missed them."""
        came = [subscriber.try_recv() is not None for subscriber in self._weights]
        sample = self._role.try_recv()
        if sample is not None:
            role = Role.decode(wire.decode(sample.payload.to_bytes()))
            self._acting, self._named = role.acting - 1, list(role.versions)
        for network, version in enumerate(self._named):
            self._broadcasts.named(network, version)
            # A role follows each broadcast, so it tells the version of what came before it.
            if came[network] or self._fetched:
                self._held[network] = version
        self._fetched = self._fetched and sample is None
        held, named = self._held[self._acting], self._named[self._acting]
        if held < named and time.monotonic() - self._broadcasts.named(self._acting, named) > GRACE:
            self.missing += 1
            self._fetch()
        return time.monotonic() - self._broadcasts.named(self._acting, held)

    def leave(self) -> None:
        """Tell the learner that this actor stops; its links go with the process."""
        with contextlib.suppress(NoAnswer):
            payload = Leave(self._incarnation).encode(self._space.run)
            _begin(self._session, join_key(self._space, "actor"), payload, self._space.run).wait()

    def _join(self) -> Sequence[str]:
        """Ask the learner until it answers with the replay service's endpoints."""
        deadline, key = time.monotonic() + PATIENCE, join_key(self._space, "actor")
        while time.monotonic() < deadline:
            with contextlib.suppress(NoAnswer):
                answer = _begin(self._session, key, self._request.encode(self._space.run), self._space.run).wait()
                endpoints: list[str] = answer.fields["replay_endpoints"]
                self._request = msgspec.structs.replace(self._request, index=answer.fields["index"])
                if endpoints:
                    return endpoints
            time.sleep(RETRY_PAUSE)
        raise RunError(f"an actor could not join within {PATIENCE:g} s")

    def _fetch(self) -> None:
        """Ask the learner for both networks; the next role will tell their versions."""
        question = Current().encode(self._space.run)
        self._asked = [
            _begin(self._session, weights_key(self._space, network), question, self._space.run) for network in (1, 2)
        ]
        self._fetched = True

    def _insert(self, payload: bytearray) -> Pending:
        return _begin(self._route, replay_key(self._space, "insert"), payload, self._space.run)

    def _subscribe(self, key: str) -> Any:  # noqa: ANN401 (zenoh's subscriber)
        return self._session.declare_subscriber(key, RingChannel(1))


def _begin(session: zenoh.Session, key: str, payload: bytearray, run: str) -> Pending:
    """Send a query as a `Node` does; an actor's node would have threads of its own."""
    handler = session.get(
        key,
        handler=FifoChannel(2),
        payload=payload,
        timeout=INSERT_TIMEOUT,
        congestion_control=zenoh.CongestionControl.BLOCK,
        consolidation=zenoh.ConsolidationMode.NONE,
    )
    return Pending(handler, key, run)
