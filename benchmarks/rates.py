"""What a step, an update, an insert and a draw cost: `python benchmarks/rates.py` runs small topologies for coop-plan.

For each preset a real learner, replay service and actor, three times: dqn and coop with the preset's replay ratio, dqn
with a sixteenth of it. Prints each role's processor time, which other load affects less than speed, per environment
step, update, transition and batch; the two ratios tell inserts from draws. `deploy/sizing.py` holds the figures.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

from roles import Roles, replay_stats, running, wait_until

from common.messaging.transport import NoAnswer, Node, new_incarnation, open_session
from common.process.processes import free_endpoint
from common.settings.tables import load_tables, resolve

TICKS = os.sysconf("SC_CLK_TCK")
STARTS = 512  # transitions before the first update
WARM = 20  # batches before the measurement


class Counts(NamedTuple):
    """Counters, and processor seconds by role."""

    inserted: int
    drawn: int
    actor: float
    learner: float
    replay: float


def measure(preset: str, method: str, ratio: float, seconds: float) -> Counts:
    """The differences over so many seconds of a run."""
    learner_at, replay_at = free_endpoint(), free_endpoint()
    flags = ("--preset", preset, "--method", method, "--total-steps=10000000", f"--replay.learning-starts={STARTS}")
    limits = (f"--replay.ratio={ratio}", "--replay.capacity=20000")
    with tempfile.TemporaryDirectory() as folder:
        roles = Roles(Path(folder, "run"), "rates", (learner_at, replay_at), (*flags, *limits), 1)
        with (
            running(roles),
            Node(open_session((), (replay_at,)), "rates", "watch", new_incarnation()) as node,
        ):

            def warm() -> bool:
                roles.check(*roles.processes)
                try:
                    return replay_stats(node).drawn > WARM
                except NoAnswer:
                    return False

            wait_until("the first updates", warm, 900)
            before = _counts(roles, node)
            time.sleep(seconds)
            after = _counts(roles, node)
            roles.finish()
    spent = Counts(*(last - first for first, last in zip(before, after, strict=True)))
    print(f"{preset}, {method}, ratio {ratio:g}: {spent}", flush=True)
    return spent


def _counts(roles: Roles, node: Node) -> Counts:
    stats = replay_stats(node)
    spent = (_processor_seconds(roles.processes[name].pid) for name in ("actor 1", "learner", "replay"))
    return Counts(stats.inserted, stats.drawn, *spent)


def _processor_seconds(pid: int) -> float:
    fields = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / TICKS


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("presets", nargs="*", default=["breakout", "minatar-breakout", "cartpole"])
    parser.add_argument("--seconds", type=float, default=20.0, help="of each measurement")
    options = parser.parse_args()
    for preset in options.presets:
        ratio = resolve(load_tables(preset, None)).replay.ratio
        coop = measure(preset, "coop", ratio, options.seconds)
        many = measure(preset, "dqn", ratio, options.seconds)
        few = measure(preset, "dqn", ratio / 16, options.seconds)
        # replay = insert * inserted + draw * drawn, for both runs
        scale = many.inserted * few.drawn - few.inserted * many.drawn
        insert = (many.replay * few.drawn - few.replay * many.drawn) / scale
        draw = (many.inserted * few.replay - few.inserted * many.replay) / scale
        for name, spent in (
            ("step", few.actor / few.inserted),
            ("update, dqn", many.learner / many.drawn),
            ("update, coop", coop.learner / coop.drawn),
            ("insert", insert),
            ("draw", draw),
        ):
            print(f"  {name:14}{1e3 * spent:8.3f} ms", flush=True)


if __name__ == "__main__":
    main()
