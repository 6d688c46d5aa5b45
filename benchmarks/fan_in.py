"""Many actors against one replay service and one learner: `python benchmarks/fan_in.py --actors 1 10 100 1000`.

Learner and replay service are the real commands, started anew for each measurement, with the preset breakout and so few
updates per step that the learner limits nobody; `--network small` makes the parameters 0.45 MB instead of 6.7, for
broadcasting them to many actors is a wall of its own. The actors are synthetic (`synthetic.py`): many Zenoh sessions in
few processes, each with an actor's messages, segments of 32 Atari steps and a window of 16 of them. They join at once,
and insert `--rate` transitions per second in all: a few seconds of warm-up, in which each link makes its buffers, and
then those that are measured. At the end every transition sent must have been accepted once.

Raises the limit of open descriptors to what the system permits. Prints a table, and writes it to `--out`.
"""

from __future__ import annotations

import argparse
import math
import multiprocessing
import os
import resource
import statistics
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, NamedTuple

from crowd import Share, percentile, serve
from roles import Roles, replay_stats, running

from coop.common.errors import RunError
from coop.common.messaging.session import open_session
from coop.common.messaging.transport import Node, new_incarnation
from coop.common.process.processes import free_endpoint

RUN = "fan-in"
CAPACITY = 20_000  # transitions; the table is full before the actors join, so its growth is not theirs
UPDATES_PER_STEP = 0.0001  # two updates a second at 20,000 transitions
SETTLE = 3.0  # seconds between joining and measuring
WARM_UP = 5.0  # seconds of playing before measuring
EVERY = 0.25  # seconds between looks at the roles' processes
FLAGS = (
    *("--preset=breakout", f"--total-steps={10**12}", f"--replay.capacity={CAPACITY}", "--replay.learning-starts=1000"),
    *(f"--replay.ratio={UPDATES_PER_STEP}", "--replay.tolerance=200000"),
)
NETWORKS = {"small": ("--network.kind=mlp", "--network.hidden=4"), "nature": ()}
MIB = 2**20


class Usage(NamedTuple):
    """What a process occupies: bytes resident, threads, descriptors, and seconds of processor time so far."""

    memory: int
    threads: int
    descriptors: int
    processor: float


def usage(pid: int) -> Usage:
    """The usage of a process of this machine."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    pages, ticks = int(fields[21]), int(fields[11]) + int(fields[12])
    return Usage(
        pages * resource.getpagesize(),
        int(fields[17]),
        sum(1 for _ in Path(f"/proc/{pid}/fd").iterdir()),
        ticks / os.sysconf("SC_CLK_TCK"),
    )


class Watch:
    """The most that each role has occupied since the beginning."""

    def __init__(self, pids: dict[str, int]) -> None:
        self._pids = pids
        self.first = {name: usage(pid) for name, pid in pids.items()}
        self.most = dict(self.first)

    def look(self) -> None:
        """Compare with the present."""
        for name, pid in self._pids.items():
            self.most[name] = Usage(*map(max, self.most[name], usage(pid)))

    @contextmanager
    def looking(self) -> Iterator[None]:
        """Look all the time."""
        over = threading.Event()

        def run() -> None:
            while not over.wait(EVERY):
                self.look()

        thread = threading.Thread(target=run)
        thread.start()
        try:
            yield
        finally:
            over.set()
            thread.join()


class Clients:
    """Processes of synthetic actors."""

    def __init__(self, stack: ExitStack, number: int, learner: str) -> None:
        spawn = multiprocessing.get_context("spawn")
        self._ends = []
        self._processes = []
        stack.callback(self.kill)
        for _ in range(number):
            ours, theirs = spawn.Pipe()
            process = spawn.Process(target=serve, args=(RUN, learner, theirs), daemon=True)
            process.start()
            self._processes.append(process)
            self._ends.append(ours)

    def call(self, name: str, *arguments: list[Any]) -> list[Any]:
        """Call a method of each process's `Crowd`, with its own arguments."""
        for number, end in enumerate(self._ends):
            end.send((name, [argument[number] for argument in arguments]))
        return [end.recv() for end in self._ends]

    def call_first(self, name: str, *arguments: object) -> None:
        """Call a method of the first one."""
        self._ends[0].send((name, arguments))
        self._ends[0].recv()

    def kill(self) -> None:
        """End them without closing their sessions, which would take Zenoh long."""
        for process in self._processes:
            process.kill()
            process.join()

    def shares(self, number: int) -> list[int]:
        """How many of so many actors each process gets."""
        return [number // len(self._ends) + (place < number % len(self._ends)) for place in range(len(self._ends))]


class Row(NamedTuple):
    """One measurement; `COLUMNS` says what is shown."""

    figures: dict[str, float]
    problems: list[str]


def measure(number: int, options: argparse.Namespace) -> Row:
    """Let so many actors join and play."""
    head, replay = free_endpoint(), free_endpoint()
    processes = min(number, options.processes)
    with tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
        flags = (*FLAGS, *NETWORKS[options.network], f"--learner.publish-every={options.publish_every}")
        roles = stack.enter_context(running(Roles.of_run(Path(folder), RUN, (head, replay), flags, 0)))
        clients = Clients(stack, processes, head)
        clients.call_first("join", 1)
        clients.call_first("fill", CAPACITY + 1000)
        pids = {name: roles.processes[name].pid for name in ("learner", "replay")}
        watch = Watch(pids)
        shares = clients.shares(number)
        shares[0] -= 1
        with watch.looking():
            began = time.monotonic()
            clients.call("join", shares)
            joining = time.monotonic() - began
            print(f"{number:,} actors joined in {joining:.1f} s", flush=True)
            time.sleep(SETTLE)
            parts = clients.shares(number)
            rates = [options.rate * part / number for part in parts]
            first: list[Share] = clients.call("play", rates, [WARM_UP] * processes)
            roles.check(*pids)
            before, began = {name: usage(pid) for name, pid in pids.items()}, time.monotonic()
            done: list[Share] = clients.call("play", rates, [options.seconds] * processes)
            seconds = time.monotonic() - began
            print(f"{sum(one.acked for one in done):,} transitions acknowledged in {seconds:.1f} s", flush=True)
            after = {name: usage(pid) for name, pid in pids.items()}
        clients.call("leave")
        clients.kill()
        roles.check(*pids)
        with Node(open_session((), (replay,)), RUN, "watch", new_incarnation()) as node:
            time.sleep(1.0)
            stats = replay_stats(node)
        summary = roles.finish()
    early, waits = ([wait for one in shares for wait in one.waits] for shares in (first, done))
    ages = [age for one in done for age in one.ages]
    sent, acked = (sum(getattr(one, what) for one in (*first, *done)) for what in ("sent", "acked"))
    figures = {
        "actors": number,
        "joins/s": (number - 1) / joining if number > 1 else math.nan,
        "warm-up: ack p99, ms": 1000 * percentile(early, 0.99),
        "inserts/s": sum(one.acked for one in done) / seconds,
        "ack p50, ms": 1000 * percentile(waits, 0.5),
        "ack p99, ms": 1000 * percentile(waits, 0.99),
        "age p50, s": percentile(ages, 0.5),
        "age p99, s": percentile(ages, 0.99),
        "asked for": sum(one.missing for one in done),
    }
    for name in pids:
        most, growth = watch.most[name], watch.most[name].memory - watch.first[name].memory
        figures |= {
            f"{name}: MiB": most.memory / MIB,
            f"{name}: MiB an actor": growth / MIB / (number - 1) if number > 1 else math.nan,
            f"{name}: threads": most.threads,
            f"{name}: descriptors": most.descriptors,
            f"{name}: cores": (after[name].processor - before[name].processor) / seconds,
        }
    figures |= {
        "clients: cores": sum(one.processor for one in done) / seconds,
        "clients: late, s": max(one.late for one in done),
        "retries": sum(one.retries for one in (*first, *done)),
        "lost": stats.lost + sent - acked,
        "duplicates": stats.duplicates,
    }
    problems = []
    if sent != acked or stats.lost or stats.duplicates or summary["transitions_lost"]:
        problems.append(f"{sent} sent, {acked} acknowledged, {stats}")
    return Row(figures, problems)


def table(rows: list[list[Row]]) -> str:
    """A markdown table: a line for each figure, a column for each number of actors, median (lowest to highest)."""
    names = list(rows[0][0].figures)[1:]
    lines = [
        "| actors | " + " | ".join(f"{row[0].figures['actors']:,}" for row in rows) + " |",
        "| --- |" + " --- |" * len(rows),
    ]
    for name in names:
        cells = [_cell([one.figures[name] for one in row]) for row in rows]
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _cell(values: list[float]) -> str:
    if any(map(math.isnan, values)):
        return "-"
    middle, least, most = (_text(value) for value in (statistics.median(values), min(values), max(values)))
    return middle if least == most else f"{middle} ({least} to {most})"


def _text(value: float) -> str:
    return f"{value:,.0f}" if value >= 100 or value == int(value) else f"{value:.2g}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--actors", type=int, nargs="+", default=[1, 10, 100, 1000, 2000])
    parser.add_argument("--repetitions", type=int, default=1)
    parser.add_argument("--seconds", type=float, default=20.0, help="of playing")
    parser.add_argument("--rate", type=float, default=20_000, help="transitions/s of all actors together")
    parser.add_argument("--publish-every", type=int, default=10, help="updates between broadcasts of the parameters")
    parser.add_argument("--network", choices=NETWORKS, default="small")
    parser.add_argument("--processes", type=int, default=2, help="that hold the synthetic actors")
    parser.add_argument("--out", type=Path, default=Path("fan_in.md"))
    options = parser.parse_args()
    _, most = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (most, most))
    print(f"descriptors of each process: up to {most:,}", flush=True)
    rows: list[list[Row]] = []
    try:
        for number in options.actors:
            rows.append([])
            for _ in range(options.repetitions):
                rows[-1].append(measure(number, options))
                print(f"{table([rows[-1][-1:]])}\n", flush=True)
    except RunError as error:
        sys.exit(str(error))
    text = table(rows)
    options.out.write_text(f"{text}\n", encoding="utf-8")
    print(text)
    problems = [problem for row in rows for one in row for problem in one.problems]
    sys.exit("\n".join(problems) or 0)


if __name__ == "__main__":
    main()
