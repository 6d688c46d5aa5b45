"""What users wait for: start.py torch|edl|local|report. A turn is one process, from its start.

torch, edl: the imports of PyTorch and of `coop.learner.edl`. local: `coop-local` to its first update, which counts as
made when the checkpoint saved after it is complete. report: `coop-report` of the 336 runs of a packed study.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from pathlib import Path

from turns import attend

ROOT = Path(__file__).parents[3]
PACKED = ROOT / "results" / "cartpole" / "small-buffers.parquet"
BIN = Path(sys.executable).parent
LOCAL = ("--preset", "cartpole", "--method", "coop", "--actors", "1", "--total-updates", "1")


def imported(module: str) -> None:
    subprocess.run([sys.executable, "-c", f"import {module}"], check=True)


def local(folder: str) -> float:
    """Seconds to the first update."""
    run, begun = Path(folder) / "run", time.monotonic()
    process = subprocess.Popen([BIN / "coop-local", *LOCAL, "--run-dir", run], stdout=subprocess.DEVNULL)
    while not list(run.glob("checkpoints/*/DONE")):
        assert process.poll() is None
        time.sleep(0.01)
    spent = time.monotonic() - begun
    process.wait()
    return spent


def main(what: str) -> None:
    def turn(_: float) -> dict[str, float]:
        with tempfile.TemporaryDirectory() as folder:
            if what == "local":
                return {"seconds": local(folder)}
            begun = time.monotonic()
            if what == "report":
                command = [BIN / "coop-report", PACKED, "--out", Path(folder) / "report"]
                subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
            else:
                imported({"torch": "torch", "edl": "coop.learner.edl"}[what])
            return {"seconds": time.monotonic() - begun}

    attend(turn)


if __name__ == "__main__":
    main(sys.argv[1])
