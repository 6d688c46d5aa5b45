"""`coop-report`: makes the figures, tables and page of a study; packs a study into one file."""

from __future__ import annotations

from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated

import tyro
from tyro.conf import Positional

from coop.common.errors import RunError, UsageError
from coop.common.places import shown
from coop.common.process.cli import parse
from coop.common.process.lifecycle import raise_on_signals, run_main
from coop.common.process.untrusted import refuse_links


@dataclass(frozen=True)
class ReportOptions:
    """Flags of `coop-report`."""

    runs: Annotated[Positional[Path], tyro.conf.arg(metavar="RUNS")]
    """A sweep's folder, any folder of run directories, or a file made with --pack."""
    out: Path | None = None
    """Folder of the report; RUNS/report if not given, without the suffix if RUNS is a file."""
    baseline: str | None = None
    """Report the differences from this method, or from the method and setting of this run, over the same seeds."""
    pack: Path | None = None
    """Instead of a report: write the folder's runs into this Parquet file."""
    rows: Annotated[int | None, tyro.conf.arg(metavar="INT")] = None
    """With --pack: keep about this many rows of each run's metrics, without times and histograms."""
    curves: Path | None = None
    """Instead of a report: draw the learning curve of every run, finished or not, into a subfolder of this folder."""


def main() -> None:
    """Entry point."""
    raise_on_signals()
    run_main("coop-report", _run)


def _run() -> None:
    options = parse(ReportOptions, "coop-report", "Make one page, figures and tables of a study, or pack its runs.")
    runs = options.runs
    if not runs.exists():
        raise UsageError(f"{runs}: no such folder or file")
    if options.rows is not None and (options.pack is None or options.rows < 1):
        problem = "at least 1" if options.pack else "only with --pack"
        raise UsageError(f"--rows {options.rows}: {problem}")
    if find_spec("pyarrow") is None:
        raise RunError("pyarrow is not installed; it comes with the extra report: pip install 'coop-rl[report]'")
    # Imported only after the flags have been checked: the statistics' libraries take seconds.
    if options.pack is not None:
        from coop.studies.report.packing import pack  # noqa: PLC0415

        print(pack(runs, options.pack, options.rows))
    elif options.curves is not None:
        from coop.studies.report.writer import draw_curves  # noqa: PLC0415

        print(*map(shown, draw_curves(runs, options.curves)), sep="\n")
    else:
        from coop.studies.report.writer import write_report  # noqa: PLC0415

        base = runs if runs.is_dir() else runs.with_suffix("")
        if options.out is None:
            if base.is_file():
                raise UsageError(f"{runs}: a file without a suffix, so that its report has no place; give --out")
            refuse_links(base / "report")
        out, own = options.out or base / "report", options.out is None
        print(shown(write_report(runs, out, options.baseline, own=own)))
