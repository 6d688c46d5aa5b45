"""Lockstep steps, an update in each, with the run's files: steps_coop.py PRESET METHOD."""

import sys
import tempfile
from pathlib import Path

from turns import attend, rate
from work import START, step_config

from common.process.threads import use_threads
from experiments.lockstep import Lockstep
from learner.records.run_directory import RunDirectory

use_threads(1)
preset, method = sys.argv[1:]
config = step_config(preset, method)
run = Lockstep(config)
with tempfile.TemporaryDirectory() as folder:
    directory = RunDirectory(Path(folder) / "run", config)

    def step() -> None:
        for effects in run.play():
            directory.record(effects.episodes, effects.metrics)

    for _ in range(START + 100):
        step()
    attend(lambda seconds: {"steps/s": rate(step, seconds)})
