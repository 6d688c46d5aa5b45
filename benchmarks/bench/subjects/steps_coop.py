"""Lockstep steps, an update every PERIOD of them, with the run's files: steps_coop.py PRESET METHOD PERIOD."""

import sys
import tempfile
from pathlib import Path

from turns import attend, rate
from work import START, step_config

from coop.common.process.limits import use_threads
from coop.lockstep.lockstep import Lockstep
from coop.records.run_directory import RunDirectory

use_threads(1)
preset, method, period = sys.argv[1:]
config = step_config(preset, method, int(period))
run = Lockstep(config)
with tempfile.TemporaryDirectory() as folder:
    directory = RunDirectory(Path(folder) / "run", config)

    def step() -> None:
        for effects in run.play():
            directory.record(effects.episodes, effects.metrics)

    for _ in range(START + 100):
        step()
    attend(lambda seconds: {"steps/s": rate(step, seconds)})
