"""A sweep as a Slurm job array: one task a cell, each one a sweep of that cell alone."""

from __future__ import annotations

import shlex
import subprocess
from pathlib import Path

from common.errors import RunError
from common.process.processes import command
from experiments.sweep.grid import GridFile


def submit(grid: GridFile, folder: Path, cells: list[str], jobs: int | None) -> str:
    """Write the job script into the sweep's folder and hand it to sbatch; what sbatch answered.

    Args:
        folder: of the sweep, with its sweep.toml.
        cells: names of the cells to run.
        jobs: tasks at once; None leaves that to the cluster.

    Raises:
        RunError: there is no sbatch here, or it refused.
    """
    script = folder.resolve() / "array.sh"
    script.write_text(_script(grid, folder.resolve(), cells, jobs), encoding="utf-8")
    try:
        done = subprocess.run(["sbatch", str(script)], capture_output=True, text=True, check=False)
    except FileNotFoundError as error:
        raise RunError(f"sbatch: not found here; submit {script} where it is") from error
    if done.returncode:
        answer = " ".join(done.stderr.split()) or f"exit status {done.returncode}"
        raise RunError(f"sbatch {script}: {answer}")
    return done.stdout.strip()


def _script(grid: GridFile, folder: Path, cells: list[str], jobs: int | None) -> str:
    limit = f"%{jobs}" if jobs else ""
    processes = 1 if grid.mode == "lockstep" else grid.actors + 2
    (program,) = command("coop-sweep")
    names = "\n".join(f"  {shlex.quote(name)}" for name in cells)
    return f"""#!/bin/bash
#SBATCH --job-name=coop-sweep
#SBATCH --array=0-{len(cells) - 1}{limit}
#SBATCH --cpus-per-task={processes}
#SBATCH --output="{folder}/slurm-%A_%a.log"
#SBATCH --requeue
cells=(
{names}
)
exec {shlex.quote(program)} {shlex.quote(str(folder / "sweep.toml"))} --dir {shlex.quote(str(folder))} \\
  --cell "${{cells[$SLURM_ARRAY_TASK_ID]}}"
"""
