"""`coop-reexecute RUN_DIR`: checks that a run's journal reproduces its parameters, bit for bit."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import tyro

from common.process import cli
from common.process.lifecycle import run_main
from experiments.reexecute import reexecute


@dataclass(frozen=True)
class ReexecuteOptions:
    """Flags of `coop-reexecute`."""

    run_dir: tyro.conf.Positional[Path]
    """Folder of a finished run with a journal (--replay.journal; with --replay.journal-keep from its beginning)."""


def main() -> None:
    """Entry point."""
    run_main("coop-reexecute", _run)


def _run() -> None:
    options = cli.parse(ReexecuteOptions, "coop-reexecute", "Train a run's learner again from the run's journal.")
    outcome = reexecute(options.run_dir)
    print(
        f"updates {outcome.began:,} to {outcome.updates:,} on {outcome.transitions:,} transitions, "
        f"{outcome.repeated:,} of {outcome.held:,} in the closing table equal another, "
        f"{outcome.missing_segments} segments missing: parameters, optimizers and random state equal "
        f"the run's, bit for bit (sha256 {outcome.digest})"
    )
