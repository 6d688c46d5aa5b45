"""What each feedback does to Adam's steps on Pong, by coop at the settings of results/pong/feedback.toml.

`python -m results.pong.steps [--steps N] > results/pong/steps.csv` plays N environment steps with each and prints, by
layer from the first to the last: the cosine of the step with the one that plain gradients of the same batches would
have made, and its length relative to that, medians over the later half of the updates; and whether the feedback is on
there by the rule of the second MinAtar study.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import tomllib
from pathlib import Path

import pandas as pd

from coop.common.process.lifecycle import Stop
from coop.common.settings.overrides import merged
from coop.common.settings.tables import load_tables, resolve
from coop.learner.agent import Agent
from coop.lockstep.run import LockstepRun
from coop.records.resumption import Start
from results.minatar.edl.plain_steps import PlainSteps
from results.minatar.edl.rules import driven

GRID = Path(__file__).with_name("feedback.toml")
EVERY = 100  # updates of a network between two measurements


def measure(feedback: str, steps: int) -> pd.DataFrame:
    """A row for each layer: the median cosine and ratio, and whether the feedback is on by the rule of `driven`."""
    grid = tomllib.loads(GRID.read_text())
    settings = merged(load_tables(grid["preset"], None), grid["fixed"])
    config = resolve(merged(settings, {"total_steps": steps, "edl": {"feedback": feedback}}), "coop")
    with tempfile.TemporaryDirectory() as folder:
        run = LockstepRun(config, Path(folder), "steps", Start())
        try:
            assert isinstance(run.run.agent, Agent)
            followed = PlainSteps(run.run.agent, EVERY)
            run.play(Stop(), _show)
        finally:
            run.close()
    return driven(pd.DataFrame({"phase": ["pilot"], "feedback": [feedback], "measures": [followed.rows]}))


def _show(line: str) -> None:
    print(line, file=sys.stderr)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--steps", type=int, default=20_000)
    steps = parser.parse_args().steps
    table = pd.concat([measure(feedback, steps) for feedback in ("transform", "weight-gradient")])
    print(table.to_csv(index=False, float_format="%.4f"), end="")


if __name__ == "__main__":
    main()
