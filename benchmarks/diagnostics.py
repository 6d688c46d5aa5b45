"""What a row of diagnostics costs: `python benchmarks/diagnostics.py [PRESET ...]`.

For each preset and method, the processor time of the diagnostics of a row of metrics.jsonl (`Diagnostics.row`: all that
needs a pass through the networks), and of the 200 updates between two rows, in turns in one process and one thread:
median (lowest..highest) over the rounds, in ms, and of the quotient of each round, in percent.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import replace

from coop.common.numbers import METRICS_EVERY
from coop.common.process.limits import use_threads
from coop.lockstep.lockstep import Lockstep
from coop.records.run_options import base_config

START = 300  # steps before the first update
BATCHES = 20  # drawn before the measurements


def measured(turn: Callable[[], object]) -> float:
    """Milliseconds of processor time."""
    began = time.thread_time()
    turn()
    return 1000 * (time.thread_time() - began)


def spread(values: Sequence[float], digits: int) -> str:
    middle, low, high = statistics.median(values), min(values), max(values)
    return f"{middle:.{digits}f} ({low:.{digits}f}..{high:.{digits}f})"


def costs(preset: str, method: str, rounds: int) -> tuple[list[float], list[float]]:
    """The times of a row's diagnostics and of 200 updates in each round, in ms."""
    config = base_config(["--preset", preset, "--method", method])
    run = Lockstep(replace(config, replay=replace(config.replay, learning_starts=START)))
    while run.step < START + BATCHES:
        for _ in run.play():
            pass
    batches = [run.memory.table.sample(config.learner.batch_size) for _ in range(BATCHES)]
    agent, diagnostics = run.agent, run.trainer.telemetry.diagnostics
    for batch in batches:
        diagnostics.add(batch)

    def update() -> None:
        for number in range(METRICS_EVERY):
            agent.update(batches[number % BATCHES])

    rows, updates = [], []
    diagnostics.row(agent)
    for _ in range(rounds):
        rows.append(measured(lambda: diagnostics.row(agent)))
        updates.append(measured(update))
    run.env.close()
    return rows, updates


def main() -> None:
    """Print a line for each preset and method."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("presets", nargs="*", default=["cartpole", "minatar-breakout"])
    parser.add_argument("--methods", nargs="+", default=["dqn", "edql", "g-coop", "coop"])
    parser.add_argument("--rounds", type=int, default=7)
    options = parser.parse_args()
    use_threads(1)
    print(f"{'preset':18}{'method':8}{'a row, ms':22}{'200 updates, ms':22}%")
    for preset in options.presets:
        for method in options.methods:
            rows, updates = costs(preset, method, options.rounds)
            shares = [100 * row / time for row, time in zip(rows, updates, strict=True)]
            print(f"{preset:18}{method:8}{spread(rows, 2):22}{spread(updates, 0):22}{spread(shares, 2)}", flush=True)


if __name__ == "__main__":
    main()
