"""Crowds of synthetic actors for `fan_in.py`: many in one process, in the rhythm of `coop-actor`."""

from __future__ import annotations

import heapq
import math
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from multiprocessing.connection import Connection
from typing import NamedTuple

from synthetic import PATIENCE, STEPS, Broadcasts, Space, SyntheticActor

from coop.common.messaging.timing import IDLE_ASK_EVERY, STATUS_EVERY
from coop.common.process.memory import keep_freed_memory

AT_ONCE = 16  # actors of a process that join at the same time
AGE_EVERY = 4.0  # seconds
LOOK_AT_LEAST = 0.02  # seconds between looks for acknowledgements at most, also where sending is late
LOOK_EVERY = 0.001  # seconds between them otherwise, and
LOOK_PAUSE = 2e-5  # more for each actor of the process, so that many leave the processor to those they ask


class Share(NamedTuple):
    """What the actors of one process have done; seconds.

    sent, acked: transitions. ages: of the acting network's parameters since their broadcast, by actor, now and then.
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
            until = now + LOOK_AT_LEAST
            while agenda[0][0] <= now < until:
                due, index, what = agenda[0]
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
                now = time.monotonic()
            self._collect()
            time.sleep(LOOK_EVERY + LOOK_PAUSE * number)
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
            if not one.send():
                time.sleep(LOOK_EVERY)
            one.collect()
        self._drain()

    def _collect(self) -> None:
        for one in self.actors:
            if not one.is_idle:
                one.collect()

    def _drain(self) -> None:
        """Wait for all acknowledgements."""
        deadline = time.monotonic() + PATIENCE
        while not all(one.is_idle for one in self.actors) and time.monotonic() < deadline:
            self._collect()
            time.sleep(LOOK_EVERY)


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
