"""What a seed stands for: the settings of a small run, and the faults that it meets, in bursts."""

from __future__ import annotations

import random
from dataclasses import dataclass

ROLES = ("learner", "replay", "actor 0", "actor 1", "evaluator")
MACHINES = ("learner", "replay", "actors")
KINDS = (
    "kill",
    "freeze",
    "stop",
    "crash",
    "deadly",
    "cut",
    "partition",
    "weather",
    "full",
    "slow",
    "leap",
    "second",
    "second actor",
    "bad flush",
    "second learner",
)
_WEIGHTS = (6, 5, 4, 6, 8, 4, 3, 6, 2, 3, 1, 4, 1, 0, 0)  # the last ones come by themselves


@dataclass(frozen=True)
class Fault:
    """One fault.

    at: seconds from the run's beginning. length: seconds that it lasts, if it does. number: what its kind says.
    """

    at: float
    kind: str
    target: str
    other: str = ""
    length: float = 0.0
    number: float = 0.0

    def __str__(self) -> str:
        words = {
            "kill": f"{self.target} is killed",
            "freeze": f"{self.target} is frozen for {self.length:.2f} s",
            "stop": f"{self.target} is asked to stop, and started again",
            "crash": f"the machine of {self.target} dies; what was not flushed is lost",
            "deadly": f"{self.target} is killed after {self.number:.0f} more calls for its files",
            "cut": f"nothing gets from {self.target} to {self.other} for {self.length:.2f} s",
            "partition": f"nothing gets from {self.target} to {self.other}, nor back, for {self.length:.2f} s",
            "weather": f"for {self.length:.2f} s messages are up to {self.number:.2f} s late, lost or doubled",
            "full": f"the disk of {self.target} is full for {self.length:.2f} s",
            "slow": f"the disk of {self.target} is slow for {self.length:.2f} s: up to {self.number:.1f} s",
            "leap": f"the clock of {self.target} leaps by {self.number:.2f} s",
            "second": f"a second replay service starts, {self.other}",
            "second actor": "another actor joins",
            "bad flush": f"the disk of {self.target} fails the next flush, and loses what it was to write",
            "second learner": f"a second learner starts, {self.other}",
        }
        return f"{self.at:7.3f} s  {words[self.kind]}"


@dataclass(frozen=True)
class Plan:
    """The settings of a run, and its faults."""

    total: int
    capacity: int
    ratio: float
    tolerance: float
    starts: int
    batch: int
    swap: int
    publish: int
    checkpoint: int
    prefetch: int
    window: int
    journal: str
    mirror: str
    sampling: str
    every: float
    actors: int
    evaluator: bool
    faults: tuple[Fault, ...]

    @property
    def strangers(self) -> bool:
        """Whether the learner of another run of the same name appears, where the roles of this one reach it."""
        return any(fault.kind == "second learner" and fault.other == "elsewhere" for fault in self.faults)

    def __str__(self) -> str:
        return (
            f"{self.total} steps, a table of {self.capacity}, ratio {self.ratio}, journal {self.journal}, "
            f"checkpoints every {self.checkpoint} updates, {self.sampling}, mirror {self.mirror}"
        )


def make_plan(seed: int) -> Plan:
    """The plan of a seed."""
    draw = random.Random(f"plan {seed}")
    total, every, actors = draw.choice((48, 64, 96)), draw.choice((0.05, 0.1, 0.2)), draw.choice((1, 2, 2))
    lasts = 0.5 + total / 4 / actors * every  # seconds, if nothing happens
    return Plan(
        total=total,
        capacity=draw.choice((16, 32, total, total)),
        ratio=draw.choice((0.25, 0.5)),
        tolerance=draw.choice((4.0, 16.0)),
        starts=draw.choice((4, 16)),
        batch=4,
        swap=draw.choice((3, 7)),
        publish=draw.choice((1, 2, 5)),
        checkpoint=draw.choice((5, 9, 12)),
        prefetch=draw.choice((1, 2, 4, 8)),
        window=draw.choice((1, 2, 4)),
        journal=draw.choice(("sync", "sync", "async", "async", "async", "off")),
        mirror=draw.choice(("on", "off")),
        sampling=draw.choice(("uniform", "uniform", "prioritized")),
        every=every,
        actors=actors,
        evaluator=draw.random() < 0.3,
        faults=tuple(
            sorted(
                [*_faults(draw, lasts), *_bad_flush(draw, lasts), *_second_learner(seed, lasts)],
                key=lambda fault: fault.at,
            )
        ),
    )


def _faults(draw: random.Random, lasts: float) -> list[Fault]:
    found = []
    for _ in range(draw.choice((0, 1, 1, 2, 2, 3))):
        begins = draw.uniform(0.2, 1.2 * lasts)
        if draw.random() < 0.15:  # one replay service can't be reached while another waits for its place
            kind, other = draw.choice((("freeze", ""), ("partition", "learner"), ("partition", "actors")))
            found.append(Fault(begins, kind, "replay", other, draw.uniform(1.0, 6.0)))
            found.append(Fault(max(0.1, begins + draw.uniform(-1.0, 2.0)), "second", "replay", "elsewhere"))
        for _ in range(draw.randrange(1, 6)):
            at = begins + draw.random() ** 2 * draw.choice((0.3, 2.0))
            kind = draw.choices(KINDS, _WEIGHTS)[0]
            target, other = draw.choice(ROLES), ""
            length, number = draw.choice((draw.uniform(0.05, 1.0), draw.uniform(1.0, 6.0))), 0.0
            if kind in ("crash", "full", "slow", "deadly"):
                target = draw.choice(("learner", "replay", "replay"))
            if kind == "stop":
                target = draw.choice(("replay", "replay", "learner", "actor 0", "evaluator"))
            if kind == "deadly":
                number = draw.randrange(60)
            if kind == "leap":
                target, number = draw.choice(MACHINES), draw.uniform(0.1, 5.0)
            if kind in ("cut", "partition"):
                target, other = draw.sample(MACHINES, 2)
            if kind == "weather":
                number = draw.choice((0.02, 0.3, 2.0))
                target = draw.choice(("late", "lost", "doubled", "all"))
            if kind == "slow":
                number = draw.uniform(0.2, 3.0)
            if kind == "second":
                other = draw.choice(("elsewhere", "elsewhere", "on the same folder"))
            found.append(Fault(at, kind, target, other, length, number))
    return found


def _bad_flush(draw: random.Random, lasts: float) -> list[Fault]:
    """A flush that fails, and often the death of the machine: until then what was lost can still be read."""
    if draw.random() > 0.15:
        return []
    at, target = draw.uniform(0.2, 1.2 * lasts), draw.choice(("learner", "replay", "replay"))
    then = [Fault(at + draw.uniform(0.1, 4.0), "crash", target)] if draw.random() < 0.7 else []
    return [Fault(at, "bad flush", target), *then]


def _second_learner(seed: int, lasts: float) -> list[Fault]:
    """Another learner, often just when the first one is away; drawn apart, so that all else is as without it."""
    draw = random.Random(f"second learner {seed}")
    if draw.random() > 0.25:
        return []
    at, where = draw.uniform(0.2, 1.2 * lasts), draw.choice(("elsewhere", "elsewhere", "on the same folder"))
    stays, told = draw.uniform(0.5, 6.0), float(draw.random() < 0.5)
    found = [Fault(at, "second learner", "learner", where, stays, told)]
    if draw.random() < 0.6:
        kinds = (("kill", ""), ("freeze", ""), ("partition", "replay"), ("partition", "actors"), ("cut", "replay"))
        kind, other = draw.choice(kinds)
        found.append(Fault(max(0.1, at + draw.uniform(-2.0, 0.5)), kind, "learner", other, draw.uniform(1.0, 6.0)))
    return found
