"""The cells of a registered plan: the seeds of each are lockstep runs, and become one file once all are over."""

from __future__ import annotations

import argparse
import fcntl
import hashlib
import json
import shutil
import tomllib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from coop.common.errors import RunError, UsageError
from coop.common.process.console import say
from coop.common.process.lifecycle import Stop, run_main
from coop.common.settings.config import RunConfig
from coop.lockstep.run import LockstepRun
from coop.records.resumption import Start
from coop.records.summaries import read_summary
from results.cartpole.edl.packed import registered

Progress = Callable[[str], None]
Player = Callable[[Sequence[LockstepRun], Stop, Progress], object]


def play_cell(name: str, configs: Mapping[int, RunConfig], out: Path, stop: Stop, player: Player, program: str) -> bool:
    """Play a cell's seeds in the folder `out`/name, and go on with those that have begun; True once all are over."""
    paths = {seed: out / name / f"seed-{seed}" for seed in configs}
    with ExitStack() as stack:
        runs = []
        for seed, path in paths.items():
            if not over(path):
                path.mkdir(parents=True, exist_ok=True)
                run = LockstepRun(configs[seed], path, program, Start(resume=True))
                stack.callback(run.close)
                runs.append(run)
        if runs:
            player(runs, stop, lambda line: say(f"{name}: {line}"))
    if not all(map(over, paths.values())):
        say(f"{name}: stopped; the same command goes on")
        return False
    return True


def over(path: Path) -> bool:
    """Whether a run has ended for good."""
    try:
        return str(read_summary(path).get("exit", "")).startswith(("complete", "diverged"))
    except RunError:
        return False


def remove_runs(out: Path, name: str) -> None:
    """Delete the runs of a cell whose file is there."""
    shutil.rmtree(out / name)
    _lock(out, name).unlink()
    say(f"{name}: done")


@contextmanager
def claimed(out: Path, name: str) -> Iterator[bool]:
    """Whether this process alone plays the cell while within: several may play the cells of one folder."""
    out.mkdir(parents=True, exist_ok=True)
    with _lock(out, name).open("w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            yield False
            return
        yield True


def command(
    program: str, about: str | None, play: Callable[[Path, Stop], None], pack: Callable[[Path, Path], str]
) -> None:
    """A study's command: plays into a folder until a signal, or packs what is complete there; `pack` says what."""
    parser = argparse.ArgumentParser(f"python -m {program}", description=(about or "").split("\n")[0])
    parser.add_argument("out", type=Path, help="folder of the cells")
    parser.add_argument("--pack", type=Path, metavar="FILE", help="write the complete cells as Parquet, and play none")
    args = parser.parse_args()

    def run() -> None:
        if args.pack is not None:
            say(f"{pack(args.out, args.pack)} in {args.pack}")
            return
        stop = Stop()
        stop.on_signals()
        play(args.out, stop)
        if stop.is_set():
            stop.raise_for_status()

    run_main(program, run)


@dataclass(frozen=True)
class Packed:
    """The packed file of a study, sealed with its plan and grid; key: of the seal in the schema's metadata."""

    key: bytes
    plan: Path
    grid: Path

    def table(self, path: Path) -> pa.Table:
        """The file; raises UsageError if it is of another plan or grid."""
        found = pq.read_table(path)
        if json.loads((found.schema.metadata or {}).get(self.key, b"{}")) != sealed(self.plan, self.grid):
            raise UsageError(f"{path}: of another plan or grid; changes of the plan go below its last heading")
        return found

    def rows(self, path: Path) -> list[dict[str, Any]]:
        """The file's rows, none if there is no file; raises as `table`."""
        return list(self.table(path).to_pylist()) if path.exists() else []

    def write(self, path: Path, frame: pd.DataFrame) -> None:
        """Write the rows."""
        seal = {self.key: json.dumps(sealed(self.plan, self.grid))}
        table = pa.Table.from_pandas(frame, preserve_index=False).replace_schema_metadata(seal)
        pq.write_table(table, path, compression="zstd", compression_level=22)


def _lock(out: Path, name: str) -> Path:
    return out / f".{name}.lock"


def sealed(plan: Path, grid: Path) -> dict[str, str]:
    """The SHA-256 of a plan as it began, and of its grid's tables."""
    tables = json.dumps(tomllib.loads(grid.read_text(encoding="utf-8")), sort_keys=True)
    return {"plan": registered(plan), "grid": hashlib.sha256(tables.encode()).hexdigest()}
