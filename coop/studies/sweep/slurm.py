"""Runs a sweep as Slurm job arrays: each task is a sweep of one cell, or of some, alone."""

from __future__ import annotations

import re
import shlex
import subprocess
from collections import Counter
from dataclasses import dataclass, replace
from itertools import count
from pathlib import Path

from coop.common.errors import RunError
from coop.common.process.files import write_atomic
from coop.common.process.processes import command
from coop.studies.sweep.grid import GridFile


@dataclass(frozen=True)
class Tasks:
    """What the tasks of a sweep are.

    folder: of the sweep, with its sweep.toml. jobs: number of concurrent tasks; arrays then run one after another, and
    without limit if None. log: see `--log`. per_task: cells of a task. setup: shell code that each task begins with.
    """

    grid: GridFile
    folder: Path
    jobs: int | None
    log: str
    per_task: int
    setup: str


def submit(tasks: Tasks, cells: list[str]) -> list[str]:
    """Submit the cells that no job holds yet, in as many arrays as Slurm's limit requires; return lines that say so.

    Each array's script and the names of its cells stay in the sweep's folder: from them a later call knows the cell of
    every task that Slurm still lists.

    Args:
        tasks: what they are.
        cells: names of the cells to run.

    Raises:
        RunError: Slurm is not installed, or refused.
    """
    tasks = replace(tasks, folder=tasks.folder.resolve())
    held = _held(tasks.folder)
    lines = [f"job {job}: {_cells(number)} queued or running" for job, number in Counter(held.values()).items()]
    left = [cell for cell in cells if cell not in held]
    size = _array_size() * tasks.per_task if left else 1
    after: str | None = None
    for start in range(0, len(left), size):
        part = left[start : start + size]
        try:
            after = _submit(_write(tasks, part), after if tasks.jobs else None)
        except RunError as error:
            done = f" after {_cells(start)} submitted; the same command submits the rest" if start else ""
            raise RunError(f"{error}{done}") from error
        lines.append(f"job {after}: {_cells(len(part))} submitted")
    return lines


def _cells(number: int) -> str:
    return f"{number} cell" if number == 1 else f"{number} cells"


def _held(folder: Path) -> dict[str, str]:
    """The cells of this folder's pending or running tasks, with the job ids of their arrays."""
    held: dict[str, str] = {}
    for line in _ask("squeue", "--array", "--noheader", "--format=%F %K %o").splitlines():
        job, task, script = line.split(maxsplit=2)
        names = Path(script.strip()).with_suffix(".cells")
        if names.parent == folder and names.exists():
            held |= dict.fromkeys(names.read_text(encoding="utf-8").splitlines()[int(task)].split("\t"), job)
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


def _write(tasks: Tasks, cells: list[str]) -> Path:
    """Write an array's script and the names of its cells, those of a task in one line, under a new number."""
    script = next(path for n in count(1) if _is_new(path := tasks.folder / f"array-{n}.sh"))
    lines = ["\t".join(cells[n : n + tasks.per_task]) for n in range(0, len(cells), tasks.per_task)]
    write_atomic(script.with_suffix(".cells"), "".join(f"{line}\n" for line in lines).encode())
    write_atomic(script, _script(tasks, script.with_suffix(".cells"), len(lines)).encode())
    return script


def _is_new(path: Path) -> bool:
    """Create a file, unless there is one or a link of that name: of several processes one has each number."""
    try:
        path.open("x").close()
    except FileExistsError:
        return False
    return True


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


def _script(tasks: Tasks, names: Path, number: int) -> str:
    folder, limit = tasks.folder, f"%{tasks.jobs}" if tasks.jobs else ""
    processes = 1 if tasks.grid.mode == "lockstep" else tasks.grid.actors + 2
    (program,) = command("coop-sweep")
    return f"""#!/bin/bash
#SBATCH --job-name=coop-sweep
#SBATCH --array=0-{number - 1}{limit}
#SBATCH --cpus-per-task={processes * tasks.per_task}
#SBATCH --output="{folder}/slurm-%A_%a.log"
#SBATCH --open-mode=append
#SBATCH --requeue
{tasks.setup or ":"}
mapfile -t tasks < {shlex.quote(str(names))}
IFS=$'\\t' read -ra cells <<< "${{tasks[$SLURM_ARRAY_TASK_ID]}}"
exec {shlex.quote(program)} {shlex.quote(str(folder / "sweep.toml"))} --dir {shlex.quote(str(folder))} \\
  --log {shlex.quote(tasks.log)} --jobs {tasks.per_task} --cell "${{cells[@]}}"
"""
