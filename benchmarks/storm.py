"""Many faults of all kinds in one run, every ten seconds: `python benchmarks/storm.py --kills 200` (root).

Learner, replay service and two actors run on hosts of their own, which are network namespaces. Faults come at random
moments, ten seconds apart in the mean, whatever the run is doing: one of them is killed, frozen for 1 to 30 s, or its
host is cut off for as long. Meanwhile another actor joins again and again, and is killed or told to stop. At the end
everything heals. The table must hold every acknowledged transition once; between faults, the learner must make at
least 0.8 of the updates/s that it makes undisturbed; threads, descriptors, roster and files must not become more.
Otherwise the exit status is 1.
"""

from __future__ import annotations

import argparse
import math
import os
import random
import signal
import sys
import tempfile
import time
from collections import Counter, defaultdict
from pathlib import Path
from statistics import median

from audit import audit
from hosts import Host, inside_the_first
from roles import Roles, RunWatch, running, wait_until
from soak import measure

from coop.common.errors import CoopError, RunError
from coop.common.process.processes import ChildProcess, command
from coop.records.checkpoints import checkpoint_numbers

RUN = "storm"
PLACES = {"learner": "head", "replay": "rep", "actor 1": "act1", "actor 2": "act2"}
FLAPPING = "flap"  # the host of the actor that comes and goes
STEPS = 2_000_000  # of a run, more than it will come to: the table holds all of them
BETWEEN = 10.0  # seconds between two faults, in the mean
SHORTEST, LONGEST = 1.0, 30.0  # seconds of a freeze or a cut
CALM = 30.0  # seconds without faults, at the beginning and at the end
SETTLED = 2.0  # seconds after everybody's return from which on the learner's rate counts
KINDS = ("kill", "kill", "freeze", "cut")
RATE, GROWTH = 0.8, {"threads": 1.0, "descriptors": 1.0}
APART = ("journal", "aside", "tb")  # folders of a run that grow: TensorBoard has a file of each start
TICK = 0.1


class Storm:
    """A run on the hosts, and what happens to it.

    chance: draws the faults and their moments. faults: number of each kind. joins: of the flapping actor. between:
    seconds and updates of the time between faults in which everybody works.
    """

    def __init__(self, folder: Path, hosts: dict[str, Host], seed: int) -> None:
        self._hosts, self.chance, self._folder = hosts, random.Random(seed), folder
        learner_at, replay_at = (f"tcp/{hosts[host].address(4)}:7447" for host in ("head", "rep"))
        joining = (f"--run={RUN}", "--connect", learner_at, "--join-timeout=300", "--patience=300")
        settings = (f"--total-steps={STEPS}", f"--replay.capacity={STEPS}", "--replay.ratio=2", "--replay.journal")
        self._flags = {
            "learner": (
                *(f"--run={RUN}", f"--run-dir={folder}", "--listen", learner_at, "--preset=cartpole"),
                *("--learner.mirror=on", "--checkpoint-every=2000", *settings),
            ),
            "replay": (*joining, f"--run-dir={folder}", "--listen", replay_at),
            "actor 1": joining,
            "actor 2": joining,
        }
        self.roles = Roles(folder, self._flags, lambda name: hosts[PLACES[name]].inside)
        own = [*hosts[FLAPPING].inside, *command("coop-actor", *joining)]
        self._flapping = ChildProcess("flapping actor", own, folder / "logs" / "flapping.log")
        self._flap_until: float | None = None
        self._heals: dict[str, tuple[float, str]] = {}  # by role: when, and from what
        self._seen: dict[str, int] = {}
        self._whole_since: float | None = None
        self.faults: Counter[str] = Counter()
        self.by_themselves: list[str] = []
        self.joins = 0
        self.between = [0.0, 0.0]
        self.samples: dict[str, list[dict[str, float]]] = defaultdict(list)
        self.files: list[int] = []

    def strike(self) -> None:
        """Let a fault happen to a role that has none now."""
        free = [name for name in PLACES if name not in self._heals]
        if not free:
            return
        name, kind, now = self.chance.choice(free), self.chance.choice(KINDS), time.monotonic()
        until = now + SHORTEST * (LONGEST / SHORTEST) ** self.chance.random()
        process = self.roles.processes[name]
        if kind == "kill":
            os.kill(process.pid, signal.SIGKILL)
            until = now + self.chance.random()
        elif kind == "freeze":
            os.kill(process.pid, signal.SIGSTOP)
        else:
            self._hosts[PLACES[name]].down()
        self._heals[name] = until, kind
        self.faults[f"{kind} {name.split()[0]}"] += 1
        self._whole_since = None

    def turn(self, watch: RunWatch, *, flaps: bool) -> None:
        """Heal what is to be healed, start what has ended, and look at the run."""
        now = time.monotonic()
        for name, (until, kind) in list(self._heals.items()):
            if now >= until:
                self._heal(name, kind)
        for name, process in self.roles.processes.items():
            if name not in self._heals and process.exit_status() is not None:
                self.by_themselves.append(process.why())
                self._start(name)
        if flaps:
            self._flap(now)
        self._look(watch, now)

    def heal(self) -> None:
        """Heal everything."""
        for name, (_, kind) in list(self._heals.items()):
            self._heal(name, kind)

    def settle(self) -> None:
        """End the actor that comes and goes."""
        self._flapping.interrupt()
        self._flapping.end(30)

    def _heal(self, name: str, kind: str) -> None:
        del self._heals[name]
        if kind == "kill":
            self._start(name)
        elif kind == "freeze":
            os.kill(self.roles.processes[name].pid, signal.SIGCONT)
        else:
            self._hosts[PLACES[name]].up()

    def _start(self, name: str) -> None:
        self.roles.processes[name].end(10)
        self.roles.start_again(name, (*self._flags[name], *(() if "actor" in name else ("--resume",))))

    def _flap(self, now: float) -> None:
        """Let the flapping actor join, live for some seconds, and go."""
        process = self._flapping
        if process.exit_status() is not None or not process.pid:
            if process.pid and self._flap_until != math.inf:
                self.by_themselves.append(process.why())
            process.start()
            self._flap_until = None
        elif self._flap_until is None:
            if process.has_said("joined"):  # with a fault, its next line comes at once
                self.joins += 1
                self._flap_until = now + self.chance.uniform(0, 3)
        elif now > self._flap_until:
            os.kill(process.pid, self.chance.choice((signal.SIGKILL, signal.SIGTERM)))
            self._flap_until = math.inf

    def _look(self, watch: RunWatch, now: float) -> None:
        """Count the updates of the time in which everybody works."""
        updates, acked = watch.updates(), watch.acked()
        if self._heals:
            self._seen = {**acked, "updates": updates}
            return
        if self._whole_since is None:
            moved = [key for key, value in {**acked, "updates": updates}.items() if value != self._seen.get(key)]
            if "updates" in moved and len(moved) > 2:
                self._whole_since, self._counted = now + SETTLED, (now, updates)
        elif now >= self._whole_since:
            began, before = self._counted
            if began >= self._whole_since and updates >= before:
                self.between[0] += now - began
                self.between[1] += updates - before
            self._counted = now, updates

    def sample(self) -> None:
        """Note what every role takes, and the files of the run, while everybody works."""
        if self._whole_since is None or time.monotonic() < self._whole_since:
            return
        for name, process in self.roles.processes.items():
            if name not in self._heals and process.exit_status() is None:
                try:
                    self.samples[name].append(measure(process.pid))
                except (OSError, KeyError):
                    continue
        self.files.append(sum(1 for path in self._folder.rglob("*") if not {*APART} & {*path.parts}))


def ride(storm: Storm, kills: int, joins: int, give_up: float) -> None:
    """Let a run meet its faults, and print what was seen; raises a CoopError."""
    began, roles, chance = time.monotonic(), storm.roles, storm.chance
    with running(roles), RunWatch(RUN, "tcp/198.18.0.1:7447") as watch:

        def calm() -> float:
            """Updates/s of some time without faults; the other actor, whose starts take time of this machine, flaps."""
            start, before = time.monotonic(), watch.updates()
            while time.monotonic() < start + CALM:
                storm.turn(watch, flaps=True)
                time.sleep(TICK)
            return (watch.updates() - before) / (time.monotonic() - start)

        def begun() -> bool:
            roles.check(*roles.processes)
            return len(watch.acked()) == 2 and min(watch.acked().values()) > 0 and watch.updates() > 0

        wait_until("everybody at work", begun, 120)
        undisturbed = [calm()]
        storm.between[:] = 0.0, 0.0
        strikes, looks = time.monotonic() + chance.expovariate(1 / BETWEEN), 0.0
        while (killed := sum(n for kind, n in storm.faults.items() if kind.startswith("kill"))) < kills or (
            storm.joins < joins
        ):
            now = time.monotonic()
            if now >= strikes and killed < kills:
                storm.strike()
                strikes = now + chance.expovariate(1 / BETWEEN)
            storm.turn(watch, flaps=True)
            if now >= looks:
                storm.sample()
                looks = now + 5
                if killed and killed % 10 == 0:
                    print(f"\r{killed} kills, {storm.joins} joins, {now - began:.0f} s", end="", file=sys.stderr)
            if now > began + give_up:
                raise RunError(f"the faults have not ended after {give_up:g} s")
            time.sleep(TICK)
        storm.heal()
        before, (seconds, updates) = watch.updates(), storm.between
        back = wait_until("everybody's return", lambda: watch.updates() > before, 120)
        undisturbed.append(calm())
        storm.settle()
        summary = roles.finish()
    gaps, twice = audit(roles.folder)
    rate, usual = updates / max(seconds, 1e-9), sum(undisturbed) / 2
    problems = report(storm, time.monotonic() - began)
    lost = gaps + summary["transitions_lost"]
    for name, value in {
        "transitions accepted": f"{summary['transitions_accepted']:,}",
        "lost": lost,
        "duplicated": f"{twice} ({summary['duplicates_refused']} second deliveries refused)",
        "updates/s": f"{rate:.0f} in {seconds:.0f} s between faults, {usual:.0f} undisturbed: {rate / usual:.2f}",
        "back": f"{back:.1f} s after the last fault",
    }.items():
        print(f"{name:22}{value}")
    if lost or twice:
        problems.append("not every acknowledged transition is there once")
    if rate < RATE * usual:
        problems.append(f"less than {RATE} of the undisturbed updates/s between faults")
    if problems:
        raise RunError("; ".join(problems))


def report(storm: Storm, seconds: float) -> list[str]:
    """Print faults and resources; return what has grown, and what has ended by itself."""
    problems = [f"ended by itself: {why}" for why in storm.by_themselves]
    print(f"{'faults':22}{', '.join(f'{count} x {kind}' for kind, count in sorted(storm.faults.items()))}")
    print(f"{'joins':22}{storm.joins} of an actor that comes and goes; {seconds:.0f} s in all")
    for name, taken in storm.samples.items():
        quarter, cells = -(-len(taken) // 4), []
        for what in ("MiB", "threads", "descriptors"):
            first, last = (median(each[what] for each in part) for part in (taken[:quarter], taken[-quarter:]))
            cells.append(f"{what} {first:.0f} -> {last:.0f}")
            if what in GROWTH and last > first + GROWTH[what]:
                problems.append(f"{what} of {name} grow")
        print(f"{name:22}{', '.join(cells)}")
    quarter = -(-len(storm.files) // 4)
    first, last = median(storm.files[:quarter]), median(storm.files[-quarter:])
    folder = storm.roles.folder
    roster, kept = (folder / "roster.json").stat().st_size, len(checkpoint_numbers(folder))
    print(
        f"{'run directory':22}{first:.0f} -> {last:.0f} files but for {'/, '.join(APART)}/, roster.json {roster} bytes"
    )
    if last > first + 5 or kept > 3:
        problems.append("the run's files become more")
    return problems


def main() -> None:
    """Make the hosts, and run this script inside the first one."""
    parser = argparse.ArgumentParser(description="Kill, freeze and cut off roles of a run, again and again.")
    parser.add_argument("--kills", type=int, default=200, help="freezes and cuts, half as many each, come on top")
    parser.add_argument("--joins", type=int, help="of the actor that comes and goes; as many as kills if not given")
    parser.add_argument("--seed", type=int, default=0, help="of the faults, and of their moments")
    parser.add_argument("--give-up", type=float, default=4 * 3600.0, help="seconds")
    options = parser.parse_args()

    def meet(hosts: dict[str, Host]) -> None:
        with tempfile.TemporaryDirectory() as folder:
            joins = options.kills if options.joins is None else options.joins
            ride(Storm(Path(folder) / "run", hosts, options.seed), options.kills, joins, options.give_up)

    try:
        inside_the_first([*PLACES.values(), FLAPPING], meet)
    except CoopError as error:
        sys.exit(f"storm: error: {error}")


if __name__ == "__main__":
    main()
