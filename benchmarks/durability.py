"""What checksums and flushes cost: `python benchmarks/durability.py OLD`, OLD: a checkout of the code to compare with.

Both take turns in processes of their own, so that ratios hold on a busy machine; processor time is what other load
affects less. The steps of a lockstep run of CartPole are timed, and `Lockstep.save` alone, for that run and for one of
Breakout whose table holds 5,000 transitions; steps/s with a checkpoint every 1,000 and every 100,000 steps follow, as
the difference of two runs would be that of their other work. The journal's writer appends segments of 64 Atari steps
as they come from the wire, as it is and without the checksum over each one.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path

HERE = Path(__file__).parents[1]
SAVES, STEPS, PLAYED = 15, 2_000, 20  # PLAYED: steps between two saves that are timed
OFTEN = (1_000, 100_000)  # steps from one checkpoint to the next
INSERTS, PER_SEGMENT = 300, 64
Figures = dict[str, float]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("old", type=Path)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--turn", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.turn:
        with tempfile.TemporaryDirectory(dir=options.old) as folder:
            figures = {**lockstep(Path(folder)), **atari(Path(folder)), **journal(Path(folder))}
        print(json.dumps(figures))
        return
    trees = {"old": options.old.resolve(), "new": HERE}
    taken: dict[str, list[Figures]] = {name: [] for name in trees}
    with tempfile.TemporaryDirectory(dir=HERE) as disk:  # not in memory, as /tmp may be
        for number in range(options.rounds):
            for name in sorted(trees, reverse=bool(number % 2)):
                taken[name].append(turn(trees[name], disk))
    print("| | old | new | new / old |\n| --- | ---: | ---: | ---: |")
    for figure in taken["new"][0]:
        old, new = ([each[figure] for each in taken[name]] for name in trees)
        ratios = [after / before for before, after in zip(old, new, strict=True)]
        print(f"| {figure} | {shown(old)} | {shown(new)} | {shown(ratios)} |")


def turn(tree: Path, disk: str) -> Figures:
    """The figures of a checkout, by a process that imports its code."""
    folders = os.pathsep.join(str(tree / each) for each in ("", "benchmarks"))
    variables = {**os.environ, "PYTHONPATH": folders, "OMP_NUM_THREADS": "1"}
    flags = [sys.executable, __file__, disk, "--turn"]
    done = subprocess.run(flags, env=variables, capture_output=True, text=True, check=False)
    if done.returncode:
        sys.exit(f"{tree}: {done.stderr}")
    figures: Figures = json.loads(done.stdout.splitlines()[-1])
    return figures


def lockstep(folder: Path) -> Figures:
    """What a checkpoint of a run of CartPole takes, and the steps/s that many and few of them leave."""
    from coop.common.settings.tables import load_tables, resolve  # noqa: PLC0415 (of the checkout in turn)
    from coop.lockstep.lockstep import Lockstep  # noqa: PLC0415
    from coop.records.run_directory import RunDirectory  # noqa: PLC0415

    run = Lockstep(resolve({**load_tables("cartpole", None), "total_steps": 10**6}))
    with RunDirectory(folder / "run", run.config) as directory:

        def play(steps: int) -> None:
            for _ in range(steps):
                for effects in run.play():
                    directory.record(effects.episodes, effects.metrics)

        play(1_200)  # until the table is full and each step is an update
        step, step_processor = (each / STEPS for each in timed(lambda: play(STEPS)))
        saves = []
        for _ in range(SAVES):
            play(PLAYED)
            saves.append(timed(lambda: run.save(directory)))
    run.env.close()
    save, save_processor = map(statistics.median, zip(*saves, strict=True))
    return {
        "ms of a checkpoint": 1e3 * save,
        "ms of a checkpoint, processor": 1e3 * save_processor,
        **{f"steps/s, a checkpoint every {n:,} steps": n / (n * step + save) for n in OFTEN},
        **{f"steps/s of processor time, every {n:,}": n / (n * step_processor + save_processor) for n in OFTEN},
        **{f"% of processor time, every {n:,}": 100 * save_processor / (n * step_processor) for n in OFTEN},
    }


def atari(folder: Path) -> Figures:
    """What a checkpoint of a run of Breakout takes whose table holds 5,000 transitions."""
    from coop.common.settings.tables import load_tables, resolve  # noqa: PLC0415
    from coop.lockstep.lockstep import Lockstep  # noqa: PLC0415
    from coop.records.run_directory import RunDirectory  # noqa: PLC0415

    tables = load_tables("breakout", None)
    few = {"replay": {**tables["replay"], "capacity": 5_000, "learning_starts": 4_990}, "actor": {"num_envs": 1}}
    saves = []
    run = Lockstep(resolve({**tables, **few}))
    with RunDirectory(folder / "breakout", run.config) as directory:
        for _ in range(5_050):
            for effects in run.play():
                directory.record(effects.episodes, effects.metrics)
        for _ in range(5):
            saves.append(timed(lambda: run.save(directory)))
    run.env.close()
    save, save_processor = map(statistics.median, zip(*saves, strict=True))
    return {"ms of a checkpoint, Breakout": 1e3 * save, "ms of a checkpoint, Breakout, processor": 1e3 * save_processor}


def journal(folder: Path) -> Figures:
    """Transitions/s that the journal takes, with and without a checksum of each record."""
    from made_up import ATARI, segments  # noqa: PLC0415 (of the checkout in turn)

    from coop.replay.persistence import journal as module  # noqa: PLC0415

    frames = next(segments(ATARI, PER_SEGMENT)).frames.tobytes()
    checksum, taken = module._checksum, {}
    for name, function in (("", checksum), (", without checksums", lambda *arguments: 0)):
        module._checksum = function
        # The former writer is not told how many transitions a segment has.
        counted = () if module.FORMAT < 2 else (PER_SEGMENT,)
        writer = module.Journal(folder / f"journal{len(taken)}", 1, 0, keep=False)
        insert = writer.insert

        def write(insert: Callable[..., None] = insert, counted: tuple[int, ...] = counted) -> None:
            for _ in range(INSERTS):
                insert(frames, *counted)

        write()  # the pages of what is overwritten next are in memory then, as in a run
        for number in (writer.roll(), writer.roll()):
            writer.drop(number)
        wall, processor = timed(write)
        taken[f"transitions/s into the journal{name}"] = INSERTS * PER_SEGMENT / wall
        taken[f"us of processor time of each{name}"] = 1e6 * processor / INSERTS / PER_SEGMENT
    module._checksum = checksum
    return taken


def timed(work: Callable[[], None]) -> tuple[float, float]:
    """Seconds that work takes, and seconds of this process's processor time."""
    began, before = time.monotonic(), time.process_time()
    work()
    return time.monotonic() - began, time.process_time() - before


def shown(values: Sequence[float]) -> str:
    """Median (lowest to highest)."""
    middle, least, most = (
        f"{value:,.0f}" if value >= 100 else f"{value:.3g}"
        for value in (statistics.median(values), min(values), max(values))
    )
    return f"{middle} ({least} to {most})"


if __name__ == "__main__":
    main()
