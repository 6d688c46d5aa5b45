"""Runs a core-hour: seeds side by side against runs by themselves, in turns, one thread.

    OMP_NUM_THREADS=1 python benchmarks/seeds.py

Preset cartpole, an update a step. Both go on from turn to turn. The seconds are those of the processor, which other
processes of the machine disturb less; --wall takes the clock's.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from collections.abc import Callable
from dataclasses import replace

from coop.common.process.limits import use_threads
from coop.common.settings.tables import load_tables, resolve
from coop.lockstep.compiled.seeds import Seeds
from coop.lockstep.lockstep import Lockstep


def alone(run: Lockstep, steps: int) -> None:
    end = run.step + steps
    while run.step < end:
        for _ in run.play():
            pass


def together(seeds: Seeds, steps: int) -> None:
    end = seeds.step + steps
    while seeds.step < end:
        seeds.play(end - seeds.step)


def rate(work: Callable[[], int], clock: Callable[[], float]) -> float:
    """Steps of all runs a second."""
    began = clock()
    steps = work()
    return steps / (clock() - began)


def main() -> None:
    """Print a line of JSON for each method: steps/s of both, and their ratio, by turn."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", maxsplit=1)[0])
    parser.add_argument("--methods", nargs="+", default=["dqn", "coop"])
    parser.add_argument("--seeds", type=int, default=30)
    parser.add_argument("--turns", type=int, default=5)
    parser.add_argument("--steps", type=int, default=600, help="of the run by itself in a turn")
    parser.add_argument("--wall", action="store_true")
    args = parser.parse_args()
    use_threads(1)
    clock = time.perf_counter if args.wall else time.process_time
    for method in args.methods:
        config = resolve(load_tables("cartpole", None), method)
        own = Lockstep(config)
        seeds = Seeds([Lockstep(replace(config, seed=seed)) for seed in range(args.seeds)])
        alone(own, config.replay.learning_starts + 50)
        together(seeds, config.replay.learning_starts + 50)
        each = max(20, 2 * args.steps // args.seeds)

        def played(number: int = each) -> int:
            before = seeds.step  # noqa: B023 (called in this turn)
            together(seeds, number)  # noqa: B023
            return (seeds.step - before) * args.seeds  # noqa: B023

        turns = []
        for _ in range(args.turns):
            one = rate(lambda: alone(own, args.steps) or args.steps, clock)  # noqa: B023
            turns.append((one, rate(played, clock)))
        ratios = [many / one for one, many in turns]
        found = {
            "method": method, "seeds": args.seeds, "clock": "wall" if args.wall else "processor",
            "alone": [round(one) for one, _ in turns], "together": [round(many) for _, many in turns],
            "ratio": round(statistics.median(ratios), 2), "range": [round(f(ratios), 2) for f in (min, max)],
        }  # fmt: skip
        print(json.dumps(found), flush=True)


if __name__ == "__main__":
    main()
