"""What every subject of `make bench` does: it waits for its turn, measures, answers.

A subject is a process with the libraries of its own virtual environment; this module needs none. Orders come as lines
of standard input, seconds and the number of the round; answers are lines of JSON on standard output, {measure: value}.
"""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path

Measures = Mapping[str, float]


def attend(turn: Callable[[float], Measures]) -> None:
    """Answer each order with `turn(seconds)`, until standard input ends."""
    _attend(lambda seconds, _: turn(seconds))


def attend_rounds(turn: Callable[[int], Measures]) -> None:
    """Answer each order with `turn(round)`, a whole task that depends on the round."""
    _attend(lambda _, number: turn(number))


def _attend(turn: Callable[[float, int], Measures]) -> None:
    answers = os.fdopen(os.dup(sys.stdout.fileno()), "w")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())  # what libraries print is no answer
    print(json.dumps({}), file=answers, flush=True)  # ready
    for order in sys.stdin:
        seconds, number = order.split()
        print(json.dumps(dict(turn(float(seconds), int(number)))), file=answers, flush=True)


def rate(action: Callable[[], object], seconds: float, amount: float = 1.0, *, on: str = "cpu") -> float:
    """The amount that `action` does a second of this process's processor time, measured for at least so many seconds.

    On a core of one's own that is what the clock says; on a shared one it leaves out the time of others. On a GPU it
    is the clock's.
    """
    return amount / _cost(action, seconds, time.process_time if on == "cpu" else time.perf_counter)


def clocked(action: Callable[[], object], seconds: float) -> float:
    """Seconds that `action` takes by the clock, measured for at least so many seconds."""
    return _cost(action, seconds, time.perf_counter)


def processor_rate(name: str, action: Callable[[], object], seconds: float, amount: float) -> Measures:
    """The amount a second by the clock, under `name`, and a second of processor time."""
    begun, processor = time.perf_counter(), time.process_time()
    rate_by_clock = amount / clocked(action, seconds)
    done = rate_by_clock * (time.perf_counter() - begun)
    return {name: rate_by_clock, f"{name} of processor time": done / (time.process_time() - processor)}


def _cost(action: Callable[[], object], seconds: float, clock: Callable[[], float]) -> float:
    done, begun = 0, clock()
    while (spent := clock() - begun) < seconds or not done:
        action()
        done += 1
    return spent / done


def resident_bytes() -> int:
    """Memory of this process."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
