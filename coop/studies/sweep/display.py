"""Displays a sweep: a live table on a terminal, otherwise a line for each cell that ends."""

from __future__ import annotations

import time

from rich.console import Group, RenderableType
from rich.progress_bar import ProgressBar
from rich.table import Table

from coop.monitor.display import LiveDisplay
from coop.studies.sweep.runner import Runner

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
