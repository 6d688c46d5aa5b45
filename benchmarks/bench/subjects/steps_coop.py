"""Lockstep steps, an update every PERIOD of them, with the run's files: steps_coop.py PRESET METHOD PERIOD.

They are played as `coop-lockstep` plays a long run: in compiled loops where these fit.
"""

import sys
import tempfile
import time
from pathlib import Path

from turns import attend
from work import START, step_config

from coop.common.process.limits import use_threads
from coop.lockstep.compiled.conditions import why_not
from coop.lockstep.lockstep import Lockstep
from coop.records.run_directory import RunDirectory

use_threads(1)
preset, method, period = sys.argv[1:]
config = step_config(preset, method, int(period))
run = Lockstep(config)


def turn(seconds: float) -> dict[str, float]:
    begun, first = time.process_time(), done()
    while (spent := time.process_time() - begun) < seconds:
        play()
    return {"steps/s": (done() - first) / spent}


with tempfile.TemporaryDirectory() as folder:
    directory = RunDirectory(Path(folder) / "run", config)
    if why_not(config):

        def play() -> None:
            for effects in run.play():
                directory.record(effects.episodes, effects.metrics)

        def done() -> int:
            return run.step

    else:
        from coop.lockstep.compiled.group import Group

        group = Group([run], {run: directory})
        play = group.block

        def done() -> int:
            return group.step

    while done() < START + 100:
        play()
    attend(turn)
