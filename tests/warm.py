"""What the server of forked commands does before it forks the first: their imports, and the texts of their flags."""

import gc
import importlib

from coop.actors.cli import ActorOptions
from coop.common.process.cli import parse
from coop.common.process.flags import sections
from coop.deploy.local import LocalOptions
from coop.evaluation.cli import EvalOptions
from coop.learner.cli import LearnerOptions
from coop.records.run_options import RunOptions
from coop.replay.cli import ReplayOptions
from coop.studies.sweep.cli import SweepOptions

MODULES = [
    *("coop.actors.process", "coop.common.envs.gymnasium_env", "coop.deploy.commands", "coop.evaluation.evaluate"),
    *("coop.evaluation.evaluator", "coop.learner.process", "coop.lockstep.cli", "coop.lockstep.run"),
    *("coop.records.sinks.tensorboard", "coop.replay.service", "coop.studies.report.writer"),
    *("encodings.idna", "gymnasium.envs.classic_control.cartpole", "torch.utils.serialization.config", "typeguard"),
    *("matplotlib.backends.backend_agg", "matplotlib.figure", "matplotlib.style"),
    *("PIL.BmpImagePlugin", "PIL.GifImagePlugin", "PIL.JpegImagePlugin", "PIL.PpmImagePlugin"),
]
for name in MODULES:
    importlib.import_module(name)
for options in (ActorOptions, EvalOptions, LearnerOptions, LocalOptions, ReplayOptions, RunOptions, SweepOptions):
    sections(options)
parse(RunOptions, "", "", args=[])
gc.collect()
gc.freeze()  # a collection in a fork would write to every page, of which it would get a copy
