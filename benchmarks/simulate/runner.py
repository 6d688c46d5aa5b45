"""Runs seeds, one after another, and makes a failing one small."""

from __future__ import annotations

import gc
import json
import os
import time
import traceback
from collections import Counter
from dataclasses import dataclass, field, replace
from pathlib import Path

from benchmarks.simulate.cluster import Cluster
from benchmarks.simulate.plan import Plan, make_plan
from benchmarks.simulate.planted import PLANTED, planted
from benchmarks.simulate.world import Violation

COLLECTED_EVERY = 25  # seeds between collections of garbage, which otherwise come in the middle of one
MEMORY = Path("/dev/shm") if Path("/dev/shm").is_dir() else Path("/tmp")


@dataclass
class Outcome:
    """What became of a seed; problem: empty if all invariants held."""

    seed: int
    plan: Plan
    problem: str = ""
    trace: list[str] = field(default_factory=list)
    events: int = 0
    messages: int = 0
    simulated: float = 0.0
    met: Counter[str] = field(default_factory=Counter)
    checks: Counter[str] = field(default_factory=Counter)
    forgiven: int = 0


def simulate(seed: int, plan: Plan | None = None, *, words: bool = False) -> Outcome:
    """Run one seed. words: with the trace, also if it does not fail."""
    plan = plan or make_plan(seed)
    root = MEMORY / f"coop-simulate-{os.getpid()}"
    cluster = Cluster(seed, plan, root)
    outcome = Outcome(seed, plan)
    try:
        cluster.run()
    except Violation as violation:
        outcome.problem = str(violation)
    except Exception as error:  # a bug that no invariant names
        where = traceback.extract_tb(error.__traceback__)[-1]
        outcome.problem = f"a bug: {type(error).__name__}: {error}, line {where.lineno} of {Path(where.filename).name}"
        if os.environ.get("SIMULATE_TRACEBACK"):
            traceback.print_exception(error)
    world = cluster.world
    if words or outcome.problem:
        told = ((time, " ".join(map(str, said)).replace(str(root), "")) for time, said in world.trace)
        outcome.trace = [f"{time:8.3f}  {line}" for time, line in told]
    outcome.events, outcome.simulated = world.events, world.now
    outcome.messages = cluster.network.delivered
    outcome.met, outcome.checks, outcome.forgiven = cluster.met, cluster.checks.done, cluster.checks.forgiven
    return outcome


def shrink(failed: Outcome) -> Outcome:
    """The failing run with as few faults as may be: each is left out that it fails without."""
    smallest, index = failed, 0
    while index < len(smallest.plan.faults):
        faults = smallest.plan.faults
        fewer = replace(smallest.plan, faults=(*faults[:index], *faults[index + 1 :]))
        again = simulate(failed.seed, fewer)
        if again.problem and again.problem.split(":")[0] == failed.problem.split(":")[0]:
            smallest = again
        else:
            index += 1
    return smallest


def explain(failed: Outcome, bug: str = "") -> str:
    """A failing seed in words: the command, what it takes, what happened, and what does not hold."""
    small = shrink(failed)
    with_bug = f" --planted {bug}" if bug else ""
    lines = [
        f"seed {failed.seed}: {failed.problem}",
        f"again: python -m benchmarks.simulate --seed {failed.seed}{with_bug}",
        f"the run: {small.plan}",
        f"with {len(small.plan.faults)} of {len(failed.plan.faults)} faults it fails as well: {small.problem}",
        *(str(fault) for fault in small.plan.faults),
        "what happened:",
        *small.trace[-60:],
    ]
    return "\n".join(lines)


def report_seed(seed: int, bug: str) -> int:
    """Run one seed, and print its trace."""
    with planted(bug):
        outcome = simulate(seed, words=True)
        if outcome.problem:
            print(explain(outcome, bug))
            return 1
    print("\n".join([f"seed {seed}: {outcome.plan}", *map(str, outcome.plan.faults), *outcome.trace]))
    print(f"holds: {outcome.events} events, {outcome.messages} messages, {outcome.simulated:.1f} simulated seconds")
    return 0


def run_many(first: int, seeds: int, bug: str, out: str) -> int:
    """Run many seeds, and print figures; or find all planted bugs."""
    if bug == "all":
        return _find_all(first, seeds, out)
    total = Figures()
    with planted(bug):
        gc.freeze()  # what is there already stays
        gc.disable()
        for seed in range(first, first + seeds):
            outcome = simulate(seed)
            total.add(outcome)
            if outcome.problem:
                print(f"seed {seed}: {outcome.problem}" if total.failed > 1 else explain(outcome, bug), flush=True)
            if total.seeds % COLLECTED_EVERY == 0:
                gc.collect()
                total.write(out)
        gc.enable()
    print(total.write(out))
    return int(total.failed > 0)


class Figures:
    """The sums of many seeds."""

    def __init__(self) -> None:
        self.seeds = self.failed = self.events = self.messages = 0
        self.simulated = 0.0
        self.met: Counter[str] = Counter()
        self.checks: Counter[str] = Counter()
        self._began = time.perf_counter(), time.process_time()

    def add(self, outcome: Outcome) -> None:
        """Count one."""
        self.seeds += 1
        self.failed += bool(outcome.problem)
        self.events += outcome.events
        self.messages += outcome.messages
        self.simulated += outcome.simulated
        self.met += outcome.met
        self.checks += outcome.checks

    def write(self, out: str) -> str:
        """The figures as JSON, also in a file if one is named."""
        wall, processor = self._began
        text = json.dumps(
            {
                "seeds": self.seeds,
                "failed": self.failed,
                "seconds": round(time.perf_counter() - wall, 1),
                "processor_seconds": round(time.process_time() - processor, 1),
                "events": self.events,
                "messages": self.messages,
                "simulated_seconds": round(self.simulated),
                "faults": dict(self.met.most_common()),
                "checks": dict(self.checks.most_common()),
            },
            indent=1,
        )
        if out:
            Path(out).write_text(text)
        return text


def find(bug: str, first: int, seeds: int) -> tuple[int, Outcome | None]:
    """Look for a planted bug; how many seeds it took, and the one that found it."""
    with planted(bug):
        for count, seed in enumerate(range(first, first + seeds), 1):
            outcome = simulate(seed)
            if outcome.problem:
                return count, outcome
    return seeds, None


def _find_all(first: int, seeds: int, out: str) -> int:
    found = []
    for bug, (said, _) in PLANTED.items():
        began = time.perf_counter()
        count, outcome = find(bug, first, seeds)
        found.append((bug, said, count, outcome and outcome.seed, outcome and outcome.problem))
        how = f"seed {outcome.seed}, after {count}: {outcome.problem}" if outcome else f"not found in {count} seeds"
        print(f"{bug}: {how} ({time.perf_counter() - began:.0f} s)", flush=True)
    if out:
        Path(out).write_text(json.dumps(found, indent=1))
    return int(sum(each[3] is None for each in found) > 1)
