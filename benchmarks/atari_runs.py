"""Short runs of the Atari presets over the real topology: `python benchmarks/atari_runs.py`.

Each is `coop-local --preset GAME --total-steps 20000 --actors 2`. Prints the run's losses, the drift of the replay
ratio, and a line fitted to the replay process's resident memory against the number of transitions that it held.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from common.process.processes import command
from common.process.summaries import read_summary
from common.settings.tables import load_tables, resolve, shortened
from common.types import Array

FRAME_BYTES = 84 * 84
MIB = 2**20


def replay_memory(parent: int) -> int:
    """Bytes resident of the replay service among the children of a process; 0 while there is none."""
    for pid in Path(f"/proc/{parent}/task/{parent}/children").read_text().split():
        try:
            if b"coop-replay" in Path(f"/proc/{pid}/cmdline").read_bytes():
                return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * 4096
        except OSError:  # it has just ended
            continue
    return 0


def play(preset: str, method: str, steps: int, actors: int, folder: Path) -> tuple[Array, str]:
    """(float [n, 2], the time and the replay process's bytes in memory then; the run's last line)."""
    flags = ["--preset", preset, "--method", method, "--total-steps", str(steps)]
    flags += ["--actors", str(actors), "--run-dir", str(folder)]
    memory = []
    with subprocess.Popen(command("coop-local", *flags), stdout=subprocess.PIPE, text=True) as run:
        while run.poll() is None:
            memory.append((time.time(), replay_memory(run.pid)))
            time.sleep(0.2)
        assert run.stdout is not None
        last = [line for line in run.stdout.read().splitlines() if "updates" in line][-1:]
    if run.returncode:
        sys.exit(f"{preset}: exit status {run.returncode}")
    return np.array(memory), " ".join(last)


def report(preset: str, steps: int, folder: Path, memory: Array) -> None:
    """Print the results of a finished run."""
    summary = read_summary(folder)
    lost, twice = summary["transitions_lost"], summary["duplicates_refused"]
    print(f"  lost {lost}, duplicates refused {twice}, transitions {summary['transitions_accepted']:,}")
    replay = resolve(shortened(load_tables(preset, None), steps)).replay
    rows = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    ahead = [row["env_step"] - replay.learning_starts - row["update"] / replay.ratio for row in rows]
    print(
        f"  steps ahead of updates x {1 / replay.ratio:g}: {min(ahead):+.0f} to {max(ahead):+.0f}, first "
        f"{ahead[0]:+.0f}, last {ahead[-1]:+.0f} in {len(rows)} rows (tolerance {replay.tolerance:g} and a segment)"
    )
    held, times = [row["replay_size"] for row in rows], [row["time"] for row in rows]
    seen = memory[(memory[:, 0] >= times[0]) & (memory[:, 0] <= times[-1])]
    slope, constant = np.polyfit(np.interp(seen[:, 0], times, held), seen[:, 1], 1)
    print(
        f"  replay process: {constant / MIB:.0f} MiB + {slope:,.0f} bytes per transition "
        f"({slope / FRAME_BYTES:.3f} frames), {memory[:, 1].max() / MIB:.0f} MiB at most"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("presets", nargs="*", default=["breakout", "pong", "space-invaders"])
    parser.add_argument("--method", default="coop")
    parser.add_argument("--steps", type=int, default=20_000)
    parser.add_argument("--actors", type=int, default=2)
    options = parser.parse_args()
    for preset in options.presets:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "run"
            memory, last = play(preset, options.method, options.steps, options.actors, path)
            print(f"{preset}, {options.method}: {last}", flush=True)
            report(preset, options.steps, path, memory)


if __name__ == "__main__":
    main()
