"""Lockstep runs side by side with their files, each in a directory of its own as `coop-lockstep` would leave it.

    python -m coop.lockstep.compiled.together runs/a runs/b runs/c

goes on with the runs of these directories, which hold a config.toml each. Each fails alone.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

from coop.common.errors import CoopError, RunError, UsageError
from coop.common.process.console import say
from coop.common.process.lifecycle import Stop, run_main
from coop.common.settings.config import RunConfig
from coop.lockstep.compiled.conditions import why_not
from coop.lockstep.compiled.group import play_runs
from coop.lockstep.run import LockstepRun
from coop.records.reading import read_run_config
from coop.records.resumption import Start
from coop.records.sinks import DEFAULT_LOG
from coop.records.summaries import Summary

PROGRAM = "coop-lockstep"


def play_together(
    runs: Sequence[LockstepRun],
    stop: Stop,
    player: int | None = None,
    progress: Callable[[str], None] = lambda line: None,
) -> list[Summary]:
    """Play runs with the files of each; see `play_runs`."""
    with ExitStack() as stack:
        files = {run.run: stack.enter_context(run.files()) for run in runs}
        return play_runs(files, stop, progress, player)


def alike(configs: Sequence[RunConfig]) -> bool:
    """Whether runs differ in nothing but their seeds."""
    return len({replace(config, seed=0) for config in configs}) == 1


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(
        "python -m coop.lockstep.compiled.together", description=(__doc__ or "").split("\n")[0]
    )
    parser.add_argument("directories", nargs="+", type=Path)
    parser.add_argument("--player", type=int, choices=(1, 2), help="the network that always acts")
    parser.add_argument("--log", default=DEFAULT_LOG, help="as of coop-lockstep")
    args = parser.parse_args()
    run_main(PROGRAM, lambda: _run(args))


def _run(args: argparse.Namespace) -> None:
    configs = [read_run_config(path) for path in args.directories]
    if not alike(configs):
        raise UsageError("the runs of these directories differ in more than their seeds")
    if reason := why_not(configs[0]):
        raise UsageError(f"side by side: {reason}")
    stop = Stop()
    stop.on_signals()
    failed = []
    with ExitStack() as stack:
        runs = []
        for config, path in zip(configs, args.directories, strict=True):
            try:
                run = LockstepRun(config, path, PROGRAM, Start(resume=True), log=args.log)
            except CoopError as error:
                failed.append(str(error))
                say(f"{path}: {error}")
                continue
            stack.callback(run.close)
            runs.append(run)
        if runs:
            summaries = play_together(runs, stop, None if args.player is None else args.player - 1, say)
            for run, summary in zip(runs, summaries, strict=False):
                say(f"{run.path}: {summary}")
    if failed:
        raise RunError(f"{len(failed)} of {len(configs)} runs can't go on: {failed[0]}")
    if stop.is_set():
        stop.raise_for_status()


if __name__ == "__main__":
    main()
