"""Shows a sweep: a live table on a terminal, a line for each cell that ends elsewhere."""

from __future__ import annotations

import time

from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table

from experiments.sweep.runner import Runner

PLAIN_EVERY = 30.0  # seconds between lines where the output is no terminal


class SweepDisplay:
    """Live view of a runner."""

    def __init__(self, runner: Runner) -> None:
        self._runner = runner
        self._console = Console()
        self._live = Live(console=self._console, refresh_per_second=2, transient=True)
        self._began = time.monotonic()
        self._due = self._began + PLAIN_EVERY

    def __enter__(self) -> SweepDisplay:
        if self._console.is_terminal:
            self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._live.stop()

    def update(self) -> None:
        """Show how far the cells are."""
        if self._console.is_terminal:
            self._live.update(self._table())
        elif time.monotonic() >= self._due:
            self._due = time.monotonic() + PLAIN_EVERY
            self.say(self.line())

    def say(self, text: str) -> None:
        """Print a line that stays."""
        self._console.print(text, highlight=False, markup=False, soft_wrap=True)

    def line(self) -> str:
        """The sweep in one line."""
        runner, tally = self._runner, self._runner.tally
        over = tally.skipped + tally.finished + tally.elsewhere
        text = f"{over} of {len(runner.folders)} cells finished"
        if tally.skipped:
            text += f" ({tally.skipped} before)"
        text += f", {len(runner.running)} running, {len(runner.waiting)} waiting"
        if tally.failed:
            text += f", {len(tally.failed)} FAILED"
        return f"{text}; {self._time_left()}"

    def _time_left(self) -> str:
        """From the steps per second of this sweep so far; methods and replay ratios differ, so it is a guess."""
        done, left = self._runner.steps_done(), self._runner.steps_left()
        if not left:
            return "no time left"
        if not done:
            return "time left not known yet"
        seconds = round(left * (time.monotonic() - self._began) / done)
        return f"about {seconds // 3600}:{seconds // 60 % 60:02}:{seconds % 60:02} left"

    def _table(self) -> RenderableType:
        table = Table(box=None, header_style="dim")
        for column in ("cell", "steps", "", "return"):
            table.add_column(column, justify="right" if column in ("steps", "return") else "left")
        for run in self._runner.running:
            total, progress = run.folder.cell.config.total_steps, run.progress
            bar = ProgressBar(total=total, completed=progress.step, width=24)
            table.add_row(run.folder.cell.name, f"{progress.step:,}/{total:,}", bar, f"{progress.mean_return:.1f}")
        return Group(table, self.line())
