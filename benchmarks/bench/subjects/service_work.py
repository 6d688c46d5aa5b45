"""The work of a replay service, whichever it is: two processes insert, this one draws. Needs no other library."""

from __future__ import annotations

import math
import multiprocessing
import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from itertools import chain
from multiprocessing.connection import Connection

from turns import attend

INSERTERS = 2
BATCH, STEPS = 32, 32  # transitions of a draw, and of a segment
CAPACITY = 100_000
INSERT_RATE = 5200.0  # transitions/s inserted while batches are drawn, by all

# Inserts a segment, perhaps without waiting for its answer; waits for all answers.
Insert = tuple[Callable[[], object], Callable[[], object]]


def insert_on_demand(end: Connection, insert: Insert) -> None:
    """Answer each (seconds, rate, one at a time) with the transitions a second that were inserted and acknowledged.

    One at a time, a segment waits for the acknowledgement of the last one; the answer has the seconds of each, too.
    """
    submit, drain = insert
    submit()
    drain()
    end.send("ready")
    while (work := end.recv()) is not None:
        seconds, rate, singly = work
        done, waits, begun = 0, [], time.monotonic()
        while (now := time.monotonic() - begun) < seconds:
            if done > rate * now:
                time.sleep(STEPS / rate)
                continue
            asked = time.perf_counter()
            submit()
            if singly:
                drain()
                waits.append(time.perf_counter() - asked)
            done += STEPS
        drain()
        end.send((done / (time.monotonic() - begun), waits))


class Inserters:
    """Processes that insert when they are told; each runs target(*arguments, end), which calls `insert_on_demand`."""

    def __init__(self, stack: ExitStack, target: Callable[..., None], *arguments: object) -> None:
        spawn = multiprocessing.get_context("spawn")
        self._ends: list[Connection] = []
        for _ in range(INSERTERS):
            ours, theirs = spawn.Pipe()
            process = spawn.Process(target=target, args=(*arguments, theirs))
            process.start()
            stack.callback(process.join)
            stack.callback(ours.send, None)
            assert ours.recv() == "ready"
            self._ends.append(ours)

    def insert(
        self,
        seconds: float,
        rate: float = math.inf,
        meanwhile: Callable[[], object] = lambda: None,
        singly: bool = False,
    ) -> tuple[float, list[float]]:
        """Transitions/s of all; if one at a time, the seconds until each segment was acknowledged."""
        for end in self._ends:
            end.send((seconds, rate / INSERTERS, singly))
        meanwhile()
        rates, waits = zip(*(end.recv() for end in self._ends), strict=True)
        return sum(rates), list(chain(*waits))


def attend_service(inserters: Inserters, draw: Callable[[], object], settle: int = 0) -> None:
    """Take turns: inserts alone, draws alone, then draws beside inserts at `INSERT_RATE`, as they come and singly.

    settle: draws that are not measured after the inserts alone, which replace the table, and with it what a learner
        that keeps copies of its frames has of it.
    """

    def draws(seconds: float, name: str) -> dict[str, float]:
        waits, begun = [], time.perf_counter()
        last = begun
        while last - begun < seconds:
            draw()
            waits.append(-last + (last := time.perf_counter()))
        return {f"batches/s {name}": len(waits) / (last - begun), f"p99 of a batch {name}, ms": _p99(waits)}

    def turn(seconds: float) -> Mapping[str, float]:
        alone, _ = inserters.insert(seconds)
        for _ in range(settle):
            draw()
        found = {"inserted/s alone": alone} | draws(seconds, "alone")
        both: dict[str, float] = {}
        beside, _ = inserters.insert(seconds, INSERT_RATE, lambda: both.update(draws(seconds, "beside inserts")))
        _, waits = inserters.insert(seconds, INSERT_RATE, lambda: draws(seconds, ""), singly=True)
        return found | both | {"inserted/s beside draws": beside, "p99 of an insert beside draws, ms": _p99(waits)}

    attend(turn)


def _p99(seconds: list[float]) -> float:
    """In milliseconds."""
    return 1e3 * sorted(seconds)[int(0.99 * len(seconds))]
