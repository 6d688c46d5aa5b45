"""Sweeps from Python: the cells of a grid, run to the end on this machine."""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd

from coop.common.arguments import check_flag, check_whole
from coop.common.errors import UsageError
from coop.common.places import absolute
from coop.common.process.limits import check_processes, cores
from coop.common.settings.config import value_of
from coop.evaluation.notebook import table_html
from coop.records.sinks import DEFAULT_LOG, chosen_sinks
from coop.records.summaries import read_summary
from coop.studies.sweep.folder import CellFolder, claim_folder, default_folder
from coop.studies.sweep.grid import grid_text, load_grid, parse_grid
from coop.studies.sweep.local import CELL_BYTES, LocalProcesses
from coop.studies.sweep.runner import Runner
from coop.studies.sweep.stacking import stacks_of

TICK = 0.2  # seconds


@dataclass(frozen=True)
class SweepResult:
    """The outcome of a sweep.

    Attributes:
        folder: of its runs, which `coop-report` reads.
        runs: a row for each cell that has ended, by the cell's name: the fields that the grid varies, then those of
            summary.json.
        failed: why a cell could not be run, by its name.
    """

    folder: Path
    runs: pd.DataFrame
    failed: dict[str, str]

    def _repr_html_(self) -> str:
        told = {"sweep": str(self.folder), "cells": f"{len(self.runs)} ended, {len(self.failed)} failed"}
        return table_html(told) + str(self.runs.to_html(max_rows=60))


def sweep(
    grid: str | Path | Mapping[str, Any],
    folder: str | Path | None = None,
    *,
    jobs: int | None = None,
    quick: bool = False,
    stack: int | None = None,
    log: str | Iterable[str] = DEFAULT_LOG,
) -> SweepResult:
    """Run every cell of a grid once, and wait; cells that were finished before are not repeated.

    Args:
        grid: name of a grid that comes with the package, path of a TOML file, or the contents of one.
        folder: of the sweep; runs/sweeps/GRID if not given.
        jobs: processes to run concurrently; the number of cores if None.
        stack: seeds that a process plays side by side, where their settings allow that; see `coop-sweep --stack`.
        quick: use the grid's small version.
        log: where the runs' metrics go beside their files, as of `coop.train`.

    Raises:
        UsageError: the grid or a setting is invalid, or the folder holds other runs.
    """
    check_flag("quick", quick)
    for name, value in (("jobs", jobs), ("stack", stack)):
        if value is not None:
            check_whole(name, value, 1)
    check_processes("jobs", jobs or 1, CELL_BYTES)
    names = ",".join(chosen_sinks(log)) or "none"
    if isinstance(grid, Mapping):
        if folder is None:
            raise UsageError("folder: a grid without a name needs one")
        checked, path = parse_grid(grid_text(grid), str(folder), quick), absolute(folder, "folder")
    else:
        checked = load_grid(str(grid), quick)
        path = absolute(default_folder(grid, quick) if folder is None else folder, "folder")
    cells = [CellFolder(path, cell, names) for cell in checked.cells]
    claim_folder(checked, cells, path)
    stacks, _ = stacks_of(checked.file, cells, jobs or cores(), stack)
    runner = Runner(cells, LocalProcesses(checked.file, jobs, stacks=stacks))
    try:
        while not runner.done:
            runner.tick()
            time.sleep(TICK)
    finally:
        runner.abort()
    rows = {cell.cell.name: _row(cell, checked.varied) for cell in cells if cell.outcome()}
    return SweepResult(path, pd.DataFrame.from_dict(rows, orient="index"), runner.failed)


def _row(cell: CellFolder, varied: tuple[str, ...]) -> dict[str, Any]:
    return {**{name: value_of(cell.cell.config, name) for name in varied}, **read_summary(cell.path)}
