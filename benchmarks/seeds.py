"""Runs a core-hour: seeds side by side, a run by itself in compiled loops, and one without these, in turns, one thread.

    OMP_NUM_THREADS=1 python benchmarks/seeds.py

Preset cartpole, an update a step. All go on from turn to turn. The seconds are those of the processor, which other
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
    """Print a line of JSON for each method: steps/s by turn, and ratios: median, least, most."""
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
        plain, first = Lockstep(config), config.replay.learning_starts + 50
        one, many = (Seeds([Lockstep(replace(config, seed=k)) for k in range(n)]) for n in (1, args.seeds))
        alone(plain, first)
        together(one, first)
        together(many, first)
        each = max(20, 2 * args.steps // args.seeds)

        def played(seeds: Seeds, number: int) -> int:
            before = seeds.step
            together(seeds, number)
            return (seeds.step - before) * len(seeds.runs)

        works = {
            "plain": lambda: alone(plain, args.steps) or args.steps,  # noqa: B023 (called in this turn)
            "alone": lambda: played(one, 2 * args.steps),  # noqa: B023
            "together": lambda: played(many, each),  # noqa: B023
        }
        turns = [{name: rate(work, clock) for name, work in works.items()} for _ in range(args.turns)]
        measured = "wall" if args.wall else "processor"
        found: dict[str, object] = {"method": method, "seeds": args.seeds, "clock": measured}
        found |= {name: [round(turn[name]) for turn in turns] for name in works}
        for name in ("alone", "together"):
            ratios = [turn[name] / turn["plain"] for turn in turns]
            found[f"{name} / plain"] = [round(f(ratios), 2) for f in (statistics.median, min, max)]
        print(json.dumps(found), flush=True)


if __name__ == "__main__":
    main()
