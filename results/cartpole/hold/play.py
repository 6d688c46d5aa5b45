"""The study of results/cartpole/hold/plan.md: why two networks hold on CartPole.

    python -m results.cartpole.hold.play runs/hold     # plays what is not there yet, and goes on where it stopped
    python -m results.cartpole.hold.play runs/hold --pack results/cartpole/hold/hold.parquet     # adds what is complete

Several processes may play at once. The seeds of a cell are played side by side, each in a run directory as
`coop-lockstep` leaves it; once all are over, they become one file of the cell. A packed row is a run, with all its
returns; a return of CartPole is the length of its episode. The schema's metadata hold the SHA-256 of the plan, and of
the grid.
"""

from __future__ import annotations

import math
import tomllib
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from coop.common.errors import UsageError
from coop.common.process.lifecycle import Stop
from coop.common.settings.config import RunConfig
from coop.common.settings.overrides import merged
from coop.common.settings.tables import load_tables, resolve
from coop.lockstep.compiled.together import play_together
from coop.lockstep.run import LockstepRun
from coop.records.reading import read_csv, read_jsonl
from coop.records.summaries import read_summary
from results.cartpole.edl.packed import summary
from results.cells import Packed, Progress, claimed, command, play_cell, remove_runs

HERE = Path("results/cartpole/hold")
PLAN, GRID, FILE = HERE / "plan.md", HERE / "grid.toml", HERE / "hold.parquet"
PACKED = Packed(b"hold", PLAN, GRID)
PROGRAM = "results.cartpole.hold.play"
SIZES = (100, 300, 1000, 5000)  # with double targets: what the plan's changes leave of the grid
_KEPT = ("update", "policy_churn", "q_abs_mean", "q_bound")  # of metrics.jsonl


def cell_name(variant: str, eviction: str, capacity: int, double: bool) -> str:
    """Of a cell's files, and of its rows."""
    return f"{variant}-{eviction}-{capacity}-{'double' if double else 'single'}"


@dataclass(frozen=True)
class HoldCell:
    """A cell of the plan; player: index of the network that always acts, None: the one that is trained."""

    variant: str
    double: bool
    eviction: str
    capacity: int
    config: RunConfig
    player: int | None

    @property
    def name(self) -> str:
        """Of its files."""
        return cell_name(self.variant, self.eviction, self.capacity, self.double)

    @property
    def kept(self) -> bool:
        """Whether the plan's changes leave it."""
        return self.double and self.capacity in SIZES


@dataclass(frozen=True)
class HoldGrid:
    """The cells in the plan's order, each once, and the seeds."""

    cells: tuple[HoldCell, ...]
    seeds: tuple[int, ...]


def read_grid(path: Path = GRID) -> HoldGrid:
    """Read a grid's file."""
    tables = tomllib.loads(path.read_text(encoding="utf-8"))
    preset, first_last = load_tables(tables["preset"], None), tables["seeds"]
    cells: dict[str, HoldCell] = {}
    for block in tables["blocks"]:
        axes = (block[name] for name in ("double", "eviction", "capacity", "variants"))
        for double, eviction, capacity, variant in product(*axes):
            own: Mapping[str, Any] = tables["variants"][variant]
            settings = {name: value for name, value in own.items() if name not in ("method", "player")}
            cell = {"learner": {"double": double}, "replay": {"eviction": eviction, "capacity": capacity}}
            config = resolve(merged(merged(merged(preset, tables["fixed"]), cell), settings), own["method"])
            player = own["player"] - 1 if "player" in own else None
            found = HoldCell(variant, double, eviction, capacity, config, player)
            cells.setdefault(found.name, found)
    return HoldGrid(tuple(cells.values()), tuple(range(first_last[0], first_last[1] + 1)))


def play(grid: HoldGrid, out: Path, stop: Stop, steps: int | None = None, packed: Collection[str] = ()) -> None:
    """Play every cell that has no file yet, is not packed, and that no other process plays.

    steps: of each run, in place of the grid's.
    """
    for cell in grid.cells:
        if stop.is_set():
            return
        file = out / f"{cell.name}.npz"
        if cell.name in packed or file.exists():
            continue
        config = cell.config if steps is None else replace(cell.config, total_steps=steps)
        configs = {seed: replace(config, seed=seed) for seed in grid.seeds}
        player = partial(_together, cell.player)
        with claimed(out, cell.name) as mine:
            if mine and not file.exists() and play_cell(cell.name, configs, out, stop, player, PROGRAM):
                _write(file, [_kept(seed, out / cell.name / f"seed-{seed}") for seed in grid.seeds])
                remove_runs(out, cell.name)


def _together(player: int | None, runs: Sequence[LockstepRun], stop: Stop, progress: Progress) -> None:
    play_together(runs, stop, player, progress)


def _kept(seed: int, path: Path) -> dict[str, Any]:
    """What is kept of a run."""
    returns = [int(float(row["return"])) for row in read_csv(path / "episodes.csv")]
    rows = [[row.get(name, np.nan) for name in _KEPT] for row in read_jsonl(path / "metrics.jsonl")]
    about = read_summary(path)
    finite, steps = str(about["exit"]).startswith("complete"), int(about["env_steps"])
    return {"seed": seed, "finite": finite, "steps": steps, "returns": returns, "rows": rows}


def _write(path: Path, runs: list[dict[str, Any]]) -> None:
    part = path.with_suffix(".part.npz")
    each: dict[str, Any] = {name: np.array([run[name] for run in runs]) for name in ("seed", "finite", "steps")}
    np.savez_compressed(
        part,
        **each,
        episodes=np.array([len(run["returns"]) for run in runs]),
        returns=np.concatenate([run["returns"] for run in runs]).astype(np.int16),
        counts=np.array([len(run["rows"]) for run in runs]),
        rows=np.concatenate([np.array(run["rows"], np.float32).reshape(-1, len(_KEPT)) for run in runs]),
    )
    part.replace(path)


def rows_of(cell: HoldCell, path: Path) -> Iterator[dict[str, Any]]:
    """A row for each run of a cell's file.

    churn: share of states whose greedy action changes, for each 100 updates of a network, mean over the run; q_share:
    the greatest mean |Q| as a share of its bound.
    """
    with np.load(path) as held:
        data = {name: held[name] for name in held.files}
    each = 100 if cell.config.two_networks else 200  # updates of a network between two rows
    returns = np.split(data["returns"], np.cumsum(data["episodes"])[:-1])
    rows = np.split(data["rows"], np.cumsum(data["counts"])[:-1])
    for k, seed in enumerate(data["seed"].tolist()):
        values = returns[k].astype(float)
        finite, steps = bool(data["finite"][k]), int(data["steps"][k])
        found = summary(np.cumsum(values), values, cell.config.total_steps, None if finite else steps)
        churn, size, bound = rows[k].T[1:]
        yield {
            "variant": cell.variant, "double": cell.double, "eviction": cell.eviction, "capacity": cell.capacity,
            "seed": seed, "finite": finite, "area": found["area"], "last": found["last"],
            "collapses": found["collapses"], "churn": _of(np.mean, churn) * 100 / each,
            "q_share": _of(np.max, size / bound), "returns": returns[k],
        }  # fmt: skip


def _of(statistic: Callable[[Any], Any], values: NDArray[np.float32]) -> float:
    """A statistic of the values that are finite; nan if there are none, as in a run that diverged at once."""
    found = values[np.isfinite(values)]
    return float(statistic(found)) if len(found) else math.nan


def pack(grid: HoldGrid, out: Path, path: Path) -> int:
    """Add the complete cells of the folder `out` to a Parquet file; return the number that it then holds.

    Raises:
        UsageError: there is none, or the file is of another plan or grid.
    """
    before = packed_rows(path)
    done = [cell for cell in grid.cells if (out / f"{cell.name}.npz").exists() and cell.name not in before]
    if not done and not before:
        raise UsageError(f"{out}: no cell is complete")
    rows = before | {cell.name: list(rows_of(cell, out / f"{cell.name}.npz")) for cell in done}
    frame = pd.DataFrame([row for cell in grid.cells for row in rows.get(cell.name, ())])
    frame = frame.astype(dict.fromkeys(("area", "last", "churn", "q_share"), np.float32))
    PACKED.write(path, frame)
    return len(rows)


def packed_rows(path: Path = FILE) -> dict[str, list[dict[str, Any]]]:
    """The rows of a packed file by the name of their cell; none if there is no file.

    Raises UsageError if it is of another plan or grid.
    """
    found: dict[str, list[dict[str, Any]]] = {}
    for row in PACKED.rows(path):
        name = cell_name(*(row[axis] for axis in ("variant", "eviction", "capacity", "double")))
        found.setdefault(name, []).append(row)
    return found


def main() -> None:
    """Entry point."""
    grid = read_grid()
    kept = replace(grid, cells=tuple(cell for cell in grid.cells if cell.kept))
    command(
        PROGRAM,
        __doc__,
        lambda out, stop: play(kept, out, stop, packed=packed_rows()),
        lambda out, path: f"{pack(grid, out, path)} of {len(grid.cells)} cells",
    )


if __name__ == "__main__":
    main()
