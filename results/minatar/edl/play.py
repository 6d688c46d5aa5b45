"""The second MinAtar study, results/minatar/edl/plan.md: plays its phases, each with what the one before decided.

    python -m results.minatar.edl.play runs/edl     # plays what is not there yet, and goes on where it stopped
    python -m results.minatar.edl.play runs/edl --pack results/minatar/edl/edl.parquet     # adds what is complete

Several processes may play at once. A cell is a game, a capacity and a method with its settings; once its seeds are
over, it is a file of JSON, a row for each run. The schema's metadata hold the SHA-256 of the plan, and of the grid.
"""

from __future__ import annotations

import json
import shutil
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from coop.common.errors import UsageError
from coop.common.numbers import strict_json
from coop.common.process.files import write_atomic
from coop.common.process.lifecycle import Stop
from coop.common.settings.config import RunConfig
from coop.common.settings.overrides import merged
from coop.common.settings.tables import load_tables, resolve
from coop.learner.agent import Agent
from coop.lockstep.compiled.conditions import why_not
from coop.lockstep.run import LockstepRun
from coop.records.following import Callbacks
from coop.records.reading import read_csv
from coop.records.summaries import read_summary
from results.cartpole.edl.packed import curve_of
from results.cells import Packed, Progress, claimed, command, over, play_cell, remove_runs
from results.minatar.edl import rules
from results.minatar.edl.plain_steps import PlainSteps

HERE = Path("results/minatar/edl")
PLAN, GRID, FILE = HERE / "plan.md", HERE / "grid.toml", HERE / "edl.parquet"
PACKED, PROGRAM = Packed(b"edl", PLAN, GRID), "results.minatar.edl.play"
MEASURES = "measures.json"  # of a run of the pilot
CURVE, LAST = 40, 100  # moments of the running mean; episodes
WAIT = 20.0  # seconds until the next look at the cells of other processes


@dataclass(frozen=True)
class EdlCell:
    """A cell: runs that differ in their seeds."""

    phase: str
    game: str
    capacity: int
    variant: str
    feedback: str
    double: bool
    rate: float
    seeds: tuple[int, ...]
    config: RunConfig

    @property
    def name(self) -> str:
        """Of its file, and of its rows."""
        targets = "double" if self.double else "single"
        return f"{self.phase}-{self.game}-{self.capacity}-{self.variant}-{self.feedback}-{targets}-{self.rate:g}"


class EdlGrid:
    """The grid of a file: the cells of each phase, as far as the rows of earlier phases decide them."""

    def __init__(self, path: Path = GRID) -> None:
        self._tables = tomllib.loads(path.read_text(encoding="utf-8"))
        self._preset = load_tables(self._tables["preset"], None)
        self._usual = resolve(self._preset, "dqn").learner.learning_rate

    def pilot(self, feedback: str) -> list[EdlCell]:
        """The cells in which it is measured whether a feedback is on."""
        return list(self._cells("pilot", (feedback,)))

    def double(self, feedback: str) -> list[EdlCell]:
        """The cells that decide between single and double targets."""
        return [cell for both in (False, True) for cell in self._cells("double", (feedback,), both)]

    def rates(self, feedback: str, double: bool) -> list[EdlCell]:
        """The cells that decide on learning rates."""
        tried = self._tables["phases"]["rates"]["learning_rate"]
        return [cell for rate in tried for cell in self._cells("rates", (feedback,), double, rate)]

    def study(self, feedback: str, double: bool, chosen: Mapping[tuple[str, int], float]) -> list[EdlCell]:
        """The cells of the study; chosen: the learning rate by variant and capacity."""
        return list(self._cells("study", (feedback,), double, chosen))

    def _cells(
        self,
        phase: str,
        feedbacks: Sequence[str],
        double: bool = False,
        rate: float | Mapping[tuple[str, int], float] | None = None,
    ) -> Iterator[EdlCell]:
        tables, this = self._tables, self._tables["phases"][phase]
        first, last = this["seeds"]
        order = product(this["variants"], tables["games"], tables["capacity"])
        for variant, game, capacity in order:
            own: dict[str, Any] = tables["variants"][variant]
            driven = own["method"] in ("edql", "coop")
            for feedback in feedbacks if driven else ("none",):
                used = rate[variant, capacity] if isinstance(rate, Mapping) else rate or self._usual
                cell = {
                    "env": {"id": f"MinAtar/{game}-v1"}, "total_steps": this["total_steps"],
                    "learner": {"double": double, "learning_rate": used}, "replay": {"capacity": capacity},
                    **({"edl": {"feedback": feedback}} if driven else {}),
                }  # fmt: skip
                settings = {name: value for name, value in own.items() if name != "method"}
                found = merged(merged(merged(self._preset, tables["fixed"]), cell), settings)
                yield EdlCell(
                    phase, game, capacity, variant, feedback, double, used, tuple(range(first, last + 1)),
                    resolve(found, own["method"]),
                )  # fmt: skip


def due(grid: EdlGrid, rows: pd.DataFrame) -> list[EdlCell]:
    """The cells that the plan plays next, given the rows of those that are over; none if all are."""
    there = set(rows["cell"]) if len(rows) else set()

    def left(cells: Sequence[EdlCell]) -> list[EdlCell]:
        return [cell for cell in cells if cell.name not in there]

    feedback = ""
    for feedback in rules.FEEDBACKS:
        if cells := left(grid.pilot(feedback)):
            return cells
        if feedback in rules.feedbacks_on(rows):
            break
    else:
        raise UsageError(f"{PLAN}: no feedback is on, for which the plan has a case of its own")
    if cells := left(grid.double(feedback)):
        return cells
    table = rules.targets(rows)
    double = bool(table.loc[table["chosen"], "double"].iloc[0])
    if cells := left(grid.rates(feedback, double)):
        return cells
    best = rules.rates(rows)
    best = best[best["chosen"]]
    chosen = {(row.variant, row.capacity): row.rate for row in best.itertuples()}
    return left(grid.study(feedback, double, chosen))


def play(grid: EdlGrid, out: Path, stop: Stop, packed: Path = FILE, steps: int | None = None) -> None:
    """Play all that is not there; steps: of each run, in place of the grid's."""
    while not stop.is_set() and (cells := due(grid, rows_of(out, packed))):
        played = 0
        for cell in cells:
            file = out / f"{cell.name}.json"
            with claimed(out, cell.name) as mine:
                if not mine or stop.is_set() or file.exists():
                    continue
                played += 1
                config = cell.config if steps is None else replace(cell.config, total_steps=steps)
                configs = {seed: replace(config, seed=seed) for seed in cell.seeds}
                player = _side_by_side
                if cell.phase == "pilot":
                    _forget(out / cell.name)
                    player = _measured
                if play_cell(cell.name, configs, out, stop, player, PROGRAM):
                    rows = [kept(cell, seed, out / cell.name / f"seed-{seed}") for seed in cell.seeds]
                    write_atomic(file, strict_json(rows).encode())
                    remove_runs(out, cell.name)
        if not played:
            stop.wait(WAIT)


def _side_by_side(runs: Sequence[LockstepRun], stop: Stop, progress: Progress) -> None:
    """Play runs, in compiled loops where these can."""
    config = runs[0].run.config
    if not why_not(config):
        from coop.lockstep.compiled.together import play_together  # noqa: PLC0415 (numba may be missing)

        play_together(runs, stop, None, progress)
        return
    for run in runs:
        run.play(stop, lambda line, run=run: progress(f"{run.path.name}: {line}"))  # type: ignore[misc]


def _measured(runs: Sequence[LockstepRun], stop: Stop, progress: Progress) -> None:
    """Play runs that have not begun, with the steps that plain gradients would have made beside."""
    for run in runs:
        agent = run.run.agent
        assert isinstance(agent, Agent)
        steps = PlainSteps(agent)
        one_by_one = Callbacks({"on_metrics": lambda row: None})  # updates that compiled loops make can't be followed
        run.play(stop, lambda line, run=run: progress(f"{run.path.name}: {line}"), one_by_one)  # type: ignore[misc]
        write_atomic(run.path / MEASURES, strict_json(steps.rows).encode())


def _forget(folder: Path) -> None:
    """Remove the runs of a pilot's cell that are not over: running means beside a run are not in its checkpoints."""
    for path in folder.glob("seed-*"):
        if not over(path) or not (path / MEASURES).exists():
            shutil.rmtree(path)


def kept(cell: EdlCell, seed: int, path: Path) -> dict[str, Any]:
    """The row of a run that is over.

    area: mean over the steps of the running mean of 100 episodes, as `coop-report` has it, up to the last episode's
    end; of a run that diverged, held at its last value. last: mean return of the last 100 episodes. curve: the running
    mean at CURVE moments. measures: of the pilot, see `PlainSteps`.
    """
    about, episodes = read_summary(path), read_csv(path / "episodes.csv")
    finite = str(about["exit"]).startswith("complete")
    env_step, returns = (np.array([float(row[name]) for row in episodes]) for name in ("env_step", "return"))
    steps = int(about["env_steps"]) if finite else cell.config.total_steps
    curve = curve_of(env_step, returns, steps) if len(returns) else np.zeros(steps)
    end = int(env_step[-1]) if finite and len(returns) else steps
    every = max(1, steps // CURVE)
    return {
        "cell": cell.name, "phase": cell.phase, "game": cell.game, "capacity": cell.capacity, "variant": cell.variant,
        "feedback": cell.feedback, "double": cell.double, "rate": cell.rate, "seed": seed, "finite": finite,
        "area": float(curve[:end].mean()), "last": float(returns[-LAST:].mean()) if len(returns) else 0.0,
        "curve": [float(f"{value:.4g}") for value in curve[every - 1 :: every]],
        "measures": json.loads((path / MEASURES).read_text()) if cell.phase == "pilot" else None,
    }  # fmt: skip


def rows_of(out: Path | None, packed: Path = FILE) -> pd.DataFrame:
    """The rows of the complete cells of a folder, and of a packed file, if there is one.

    Raises UsageError if the file is of another plan or grid.
    """
    rows = PACKED.rows(packed)
    there = {row["cell"] for row in rows}
    for file in sorted(out.glob("*.json")) if out is not None else ():
        if file.stem not in there:
            rows += json.loads(file.read_text())
    return pd.DataFrame(rows)


def pack(out: Path, path: Path) -> int:
    """Write the rows of a folder's complete cells, and those that the file holds, as Parquet; return their number."""
    rows = rows_of(out, path)
    if not len(rows):
        raise UsageError(f"{out}: no cell is complete")
    PACKED.write(path, rows.astype({"area": np.float32, "last": np.float32}))
    return len(rows)


def main() -> None:
    """Entry point."""
    command(PROGRAM, __doc__, lambda out, stop: play(EdlGrid(), out, stop), lambda out, path: f"{pack(out, path)} runs")


if __name__ == "__main__":
    main()
