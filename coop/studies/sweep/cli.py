"""`coop-sweep`: runs a grid here, as job arrays or on a Dask cluster; the same command continues a sweep."""

from __future__ import annotations

import time
from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Group, RenderableType
from rich.progress_bar import ProgressBar
from rich.table import Table
from tyro.conf import Positional

from coop.common.errors import Interrupted, RunError, UsageError, closest, refusal
from coop.common.imports import check_extra
from coop.common.places import absolute, shown
from coop.common.process.cli import parse
from coop.common.process.console import say
from coop.common.process.lifecycle import Stop, run_main
from coop.common.process.limits import check_processes, cores
from coop.common.settings.starting import settings_line, source_of
from coop.monitor.display import LiveDisplay
from coop.records.sinks import DEFAULT_LOG, chosen_sinks
from coop.studies.sweep import slurm
from coop.studies.sweep.folder import CellFolder, claim_folder, default_folder
from coop.studies.sweep.grid import Grid, GridFile, load_grid
from coop.studies.sweep.local import CELL_BYTES, LocalProcesses
from coop.studies.sweep.runner import Executor, Runner
from coop.studies.sweep.stacking import stacks_of

PLAIN_EVERY = 30.0  # seconds between lines if the output is no terminal


class SweepDisplay(LiveDisplay):
    """Live view of a runner."""

    def __init__(self, runner: Runner) -> None:
        super().__init__(PLAIN_EVERY, refreshes=2)
        self._runner = runner
        self._began = time.monotonic()

    def line(self) -> str:
        """The sweep in one line."""
        runner = self._runner
        runner.look()
        text = f"{runner.finished} of {len(runner.folders)} cells finished"
        if runner.skipped:
            text += f" ({runner.skipped} before)"
        text += f", {len(runner.running)} running, {len(runner.waiting)} waiting"
        if runner.diverged:
            text += f", {len(runner.diverged)} diverged"
        if runner.failed:
            text += f", {len(runner.failed)} FAILED"
        return f"{text}; {self._time_left()}"

    def _time_left(self) -> str:
        """Estimate the time left from this sweep's mean speed, although methods and replay ratios differ in speed."""
        done, left = self._runner.steps_done(), self._runner.steps_left()
        if not left:
            return "no time left"
        if not done:
            return "time left not known yet"
        seconds = round(left * (time.monotonic() - self._began) / done)
        return f"about {seconds // 3600}:{seconds // 60 % 60:02}:{seconds % 60:02} left"

    def picture(self) -> RenderableType:
        """The running cells, above the line."""
        table = Table(box=None, header_style="dim")
        for column in ("cell", "steps", "", "return"):
            table.add_column(column, justify="right" if column in ("steps", "return") else "left")
        for run in self._runner.running:
            total, progress = run.folder.cell.config.total_steps, run.progress
            bar = ProgressBar(total=total, completed=progress.step, width=24)
            table.add_row(run.folder.cell.name, f"{progress.step:,}/{total:,}", bar, f"{progress.mean_return:.1f}")
        return Group(table, self.line())


TICK = 0.2  # seconds


@dataclass(frozen=True)
class SweepOptions:
    """Flags of `coop-sweep`."""

    grid: Annotated[Positional[str], tyro.conf.arg(metavar="GRID")]
    """A grid that comes with the package, or a TOML file."""
    quick: bool = False
    """Use the grid's small version, for two cores."""
    jobs: int | None = None
    """Number of processes to run concurrently; the number of cores, or of the workers' threads, if not given."""
    stack: int | None = None
    """Seeds that one process plays side by side, to the byte as each by itself, where their settings allow that (extra
    `fast`); 1: none; as many as keep all jobs busy if not given."""
    dir: Path | None = None
    """Folder of the sweep; runs/sweeps/GRID if not given."""
    cell: tuple[str, ...] = ()
    """Run only these cells: by name, or by number in the grid, from 0."""
    log: str = DEFAULT_LOG
    """Where the runs' metrics go, as --log of coop-lockstep: a group of Weights & Biases, an experiment of MLflow."""
    slurm: bool = False
    """Submit the cells as Slurm job arrays instead of running them on this machine."""
    per_task: int = 1
    """Cells that each task of --slurm runs at the same time."""
    setup: str = ""
    """What the shell of each task of --slurm runs first, such as "module load cuda"."""
    dask: Annotated[str | None, tyro.conf.arg(metavar="ADDRESS")] = None
    """Run the cells on the workers of this Dask scheduler, such as tcp://head:8786 (extra `dask`)."""


def main() -> None:
    """Entry point."""
    run_main("coop-sweep", _run)


def _run() -> None:
    options = parse(SweepOptions, "coop-sweep", "Run every cell of a grid once.")
    if options.jobs is not None and options.jobs < 1:
        raise UsageError(f"--jobs {options.jobs}: must be at least 1")
    if options.per_task < 1:
        raise UsageError(f"--per-task {options.per_task}: must be at least 1")
    if options.stack is not None and options.stack < 1:
        raise UsageError(f"--stack {options.stack}: must be at least 1")
    chosen_sinks(options.log)  # refuses
    if options.dask is not None:
        if options.slurm:
            raise UsageError("--dask and --slurm: give one of them")
        check_extra("--dask", "dask", "distributed")
    if options.dask is None and not options.slurm:
        check_processes("--jobs", options.jobs or 1, CELL_BYTES)
    grid = load_grid(options.grid, options.quick)
    folder = options.dir or absolute(default_folder(options.grid, options.quick))
    cells = chosen(options, grid, folder)
    claim_folder(grid, cells, folder)
    if (options.slurm or options.dask is not None) and (options.stack or 1) > 1:
        say("--stack: on this machine only; each cell runs by itself")
    if options.slurm:
        left = [cell.cell.name for cell in cells if cell.ending() is None]
        tasks = slurm.Tasks(grid.file, folder, options.jobs, options.log, options.per_task, options.setup)
        submitted = slurm.submit(tasks, left) if left else []
        print(*(submitted or ["every cell is finished"]), sep="\n")
        return
    with _executor(options, grid.file, cells) as executor:
        _work(Runner(cells, executor), folder, settings_of(grid.file, cells))


def settings_of(grid: GridFile, cells: Sequence[CellFolder]) -> str:
    """The settings of a sweep's cells that matter most, in one line."""
    configs = [cell.cell.config for cell in cells]
    return settings_line(*((config, source_of(grid.preset, None, False, config.env.id)) for config in configs))


def _executor(options: SweepOptions, grid: GridFile, folders: Sequence[CellFolder]) -> AbstractContextManager[Executor]:
    if options.dask is None:
        stacks, reasons = stacks_of(grid, folders, options.jobs or cores(), options.stack)
        for line in reasons if (options.stack or 1) > 1 else ():
            say(f"--stack: {line}")
        return nullcontext(LocalProcesses(grid, options.jobs, stacks=stacks))
    from coop.studies.sweep.dask import workers_at  # noqa: PLC0415 - takes a second, and may not be installed

    return workers_at(options.dask, grid, options.jobs)


def chosen(options: SweepOptions, grid: Grid, folder: Path) -> list[CellFolder]:
    """The cells that the options ask for; raises UsageError if there is none of that name or number."""
    known = {asked: cell for n, cell in enumerate(grid.cells) for asked in (str(n), cell.name)}
    for asked in options.cell:
        if asked not in known:
            names = [cell.name for cell in grid.cells]
            near = closest(asked, names)
            raise UsageError(f"--cell {asked}: {refusal('not in the grid', near, f'its first cell is {names[0]}')}")
    there = {known[asked].name: known[asked] for asked in options.cell} if options.cell else {}
    return [CellFolder(folder, cell, options.log) for cell in there.values() or grid.cells]


def _work(runner: Runner, folder: Path, settings: str) -> None:
    """Run until no cell is left or a stop is requested.

    Raises:
        Interrupted: a signal came before the end.
        RunError: cells have failed.
    """
    stop = Stop()
    stop.on_signals()
    with SweepDisplay(runner) as display:
        display.say(settings)
        display.say(f"{len(runner.folders)} cells in {shown(folder)}, {runner.skipped} of them finished before")
        for name, how in runner.diverged.items():
            display.say(f"{name}: {how}")
        try:
            while not runner.done and not stop.wait(TICK):
                for text in runner.tick():
                    display.say(text)
                display.update()
            if not runner.done:
                display.say(f"{stop.reason}: the running cells save their state")
        finally:
            runner.abort()
        line = display.line()
    for name, why in runner.failed.items():
        say(f"failed: {name}: {why}")
    if not runner.done:
        raise Interrupted(f"{stop.reason} with {line}; the same command goes on from here", stop.exit_status or 1)
    if runner.failed:
        count = len(runner.failed)
        raise RunError(f"{count} of {len(runner.folders)} cells failed; the same command tries them again")
    diverged = f", {len(runner.diverged)} of them diverged" if runner.diverged else ""
    say(f"all {len(runner.folders)} cells are finished{diverged}; coop-report {shown(folder)}")
