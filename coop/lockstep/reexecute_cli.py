"""`coop-reexecute RUN_DIR`: checks that a run's journal reproduces its parameters, bit for bit."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from tyro.conf import Positional

from coop.common.imports import permit
from coop.common.process import cli
from coop.common.process.lifecycle import raise_on_signals, run_main
from coop.common.process.output import out


@dataclass(frozen=True)
class ReexecuteOptions:
    """Flags of `coop-reexecute`."""

    run_dir: Annotated[Positional[Path], tyro.conf.arg(metavar="RUN_DIR")]
    """Folder of a finished run with a journal (--replay.journal; with --replay.journal-keep from its beginning)."""
    allow_import: tuple[str, ...] = ()
    """Modules, such as my_envs, that may be imported even if they lie in the run's folder or beside it."""


def main() -> None:
    """Entry point."""
    raise_on_signals()
    run_main("coop-reexecute", _run)


def _run() -> None:
    options = cli.parse(ReexecuteOptions, "coop-reexecute", "Train a run's learner again from the run's journal.")
    from coop.lockstep.reexecute import reexecute  # noqa: PLC0415 (torch takes seconds; wrong flags should not)

    permit(options.allow_import)
    outcome = reexecute(options.run_dir)
    begin = f"from checkpoint {outcome.began:,}" if outcome.began else "from the beginning of the run"
    print(
        f"updates {begin} to checkpoint {outcome.updates:,} on {outcome.transitions:,} transitions, "
        f"{outcome.repeated:,} of {outcome.held:,} in the closing table equal another, "
        f"{outcome.missing_segments} segments missing: parameters, optimizers and random state equal "
        f"those of the checkpoint, bit for bit (sha256 {outcome.digest})",
        file=out(),
    )
    for line in outcome.not_checked:
        print(f"not checked: {line}", file=out())
