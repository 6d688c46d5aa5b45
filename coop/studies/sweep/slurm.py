"""Runs a sweep as Slurm job arrays: one task per cell, each of which is a sweep of that cell alone."""

from __future__ import annotations

import re
import shlex
import subprocess
from collections import Counter
from itertools import count
from pathlib import Path

from coop.common.errors import RunError
from coop.common.process.processes import command
from coop.studies.sweep.grid import GridFile


def submit(grid: GridFile, folder: Path, cells: list[str], jobs: int | None, log: str) -> list[str]:
    """Submit the cells that no job holds yet, in as many arrays as Slurm's limit requires; return lines that say so.

    Each array's script and the names of its cells stay in the sweep's folder: from them a later call knows the cell of
    every task that Slurm still lists.

    Args:
        folder: of the sweep, with its sweep.toml.
        cells: names of the cells to run.
        jobs: number of concurrent tasks; arrays then run one after another. None: no limit.
        log: see `--log`.

    Raises:
        RunError: Slurm is not installed, or refused.
    """
    folder = folder.resolve()
    held = _held(folder)
    lines = [f"job {job}: {_cells(number)} queued or running" for job, number in Counter(held.values()).items()]
    left = [cell for cell in cells if cell not in held]
    size = _array_size() if left else 1
    after: str | None = None
    for start in range(0, len(left), size):
        part = left[start : start + size]
        try:
            after = _submit(_write(grid, folder, part, jobs, log), after if jobs else None)
        except RunError as error:
            done = f" after {_cells(start)} submitted; the same command submits the rest" if start else ""
            raise RunError(f"{error}{done}") from error
        lines.append(f"job {after}: {_cells(len(part))} submitted")
    return lines


def _cells(number: int) -> str:
    return f"{number} cell" if number == 1 else f"{number} cells"


def _held(folder: Path) -> dict[str, str]:
    """The cells of this folder's pending or running tasks, with the job ids of their arrays."""
    held = {}
    for line in _ask("squeue", "--array", "--noheader", "--format=%F %K %o").splitlines():
        job, task, script = line.split(maxsplit=2)
        names = Path(script.strip()).with_suffix(".cells")
        if names.parent == folder and names.exists():
            held[names.read_text(encoding="utf-8").splitlines()[int(task)]] = job
    return held


def _array_size() -> int:
    """The largest number of tasks in an array."""
    found = re.search(r"^MaxArraySize\s*=\s*(\d+)", _ask("scontrol", "show", "config"), re.MULTILINE)
    if found is None:
        raise RunError("scontrol show config: names no MaxArraySize")
    size = int(found[1])
    if size < 1:
        raise RunError(f"this Slurm takes no job arrays: MaxArraySize is {size}")
    return size


def _write(grid: GridFile, folder: Path, cells: list[str], jobs: int | None, log: str) -> Path:
    """Write an array's script and the names of its cells, one per line, under a new number."""
    script = next(path for n in count(1) if not (path := folder / f"array-{n}.sh").exists())
    script.with_suffix(".cells").write_text("".join(f"{cell}\n" for cell in cells), encoding="utf-8")
    script.write_text(_script(grid, folder, script.with_suffix(".cells"), len(cells), jobs, log), encoding="utf-8")
    return script


def _submit(script: Path, after: str | None) -> str:
    """Submit an array to Slurm, to begin once job `after` has ended; return its job id."""
    wait = [] if after is None else [f"--dependency=afterany:{after}"]
    try:
        return _ask("sbatch", "--parsable", *wait, str(script)).strip().partition(";")[0]
    except RunError:
        for path in (script, script.with_suffix(".cells")):
            path.unlink()
        raise


def _ask(program: str, *arguments: str) -> str:
    """The output of one of Slurm's programs; raises RunError if it is missing or fails."""
    try:
        done = subprocess.run([program, *arguments], capture_output=True, text=True, check=False)
    except FileNotFoundError as error:
        raise RunError(f"{program}: not found here; give the same command where Slurm is") from error
    if done.returncode:
        # The text begins with the program's name.
        raise RunError(" ".join(done.stderr.split()) or f"{program}: exit status {done.returncode}")
    return done.stdout


def _script(grid: GridFile, folder: Path, names: Path, tasks: int, jobs: int | None, log: str) -> str:
    limit = f"%{jobs}" if jobs else ""
    processes = 1 if grid.mode == "lockstep" else grid.actors + 2
    (program,) = command("coop-sweep")
    return f"""#!/bin/bash
#SBATCH --job-name=coop-sweep
#SBATCH --array=0-{tasks - 1}{limit}
#SBATCH --cpus-per-task={processes}
#SBATCH --output="{folder}/slurm-%A_%a.log"
#SBATCH --open-mode=append
#SBATCH --requeue
mapfile -t cells < {shlex.quote(str(names))}
exec {shlex.quote(program)} {shlex.quote(str(folder / "sweep.toml"))} --dir {shlex.quote(str(folder))} \\
  --log {shlex.quote(log)} --cell "${{cells[$SLURM_ARRAY_TASK_ID]}}"
"""
