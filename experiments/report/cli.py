"""`coop-report`: the figures, tables and page of a folder of runs."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from tyro.conf import Positional

from common.errors import UsageError
from common.process.cli import parse
from common.process.lifecycle import run_main


@dataclass(frozen=True)
class ReportOptions:
    """Flags of `coop-report`."""

    runs: Annotated[Positional[Path], tyro.conf.arg(metavar="RUNS")]
    """A sweep's folder, or any folder of run directories."""
    out: Path | None = None
    """Folder of the report; RUNS/report if not given."""


def main() -> None:
    """Entry point."""
    run_main("coop-report", _run)


def _run() -> None:
    options = parse(ReportOptions, "coop-report", "Make one page, figures and tables of a folder of runs.")
    if not options.runs.is_dir():
        raise UsageError(f"{options.runs}: no such folder")
    # Imported once the flags are known to be right: the statistics' libraries take seconds.
    from experiments.report.writer import write_report  # noqa: PLC0415

    index, tables = write_report(options.runs, options.out or options.runs / "report")
    print(tables[0].markdown(), index, sep="\n")
