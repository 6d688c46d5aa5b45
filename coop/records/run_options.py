"""The flags of a run, the config that they start from (a preset, a file, or a run to be resumed), and its directory."""

from __future__ import annotations

import argparse
import re
import sys
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field, fields, make_dataclass, replace
from pathlib import Path
from typing import Annotated, Any, TypeVar

import tyro
from tyro.constructors import PrimitiveConstructorSpec

from coop.common.errors import RunError, UsageError
from coop.common.imports import check_extra, hand_over, permit
from coop.common.numbers import whole_number
from coop.common.places import absolute, shown
from coop.common.process import cli
from coop.common.process.flags import HttpAddress
from coop.common.process.output import warn
from coop.common.process.untrusted import check_links
from coop.common.settings.config import RunConfig
from coop.common.settings.effects import without_effect
from coop.common.settings.methods import METHODS, table_of
from coop.common.settings.resuming import check_resumed
from coop.common.settings.rules import fitted
from coop.common.settings.starting import settings_line, source_of, starting_tables
from coop.common.settings.tables import CONFIG, load_tables, preset_names, resolve, shortened, validated
from coop.records.checkpoints import LEARNER, RECORDS, checkpoint_numbers
from coop.records.reading import read_run_config
from coop.records.resumption import Start
from coop.records.run_ids import has_run_id, read_run_id
from coop.records.sinks import DEFAULT_LOG, chosen_sinks

# What --help shows of a run's flags, in this order.
COMMON = (
    *("--preset", "--config", "--method", "--seed", "--total-steps", "--run-dir", "--resume"),
    *("--run", "--actors", "--listen", "--env.id", "--replay.capacity", "--replay.ratio", "--replay.eviction"),
    *("--learner.batch-size", "--learner.swap-every", "--learner.target-update-every", "--learner.learning-rate"),
    *("--edl.rate", "--actor.num-envs"),
)

_OF_RUNS = ("run-id", "checkpoints", "episodes.csv")  # beside a config.toml
_PRESET: PrimitiveConstructorSpec[str | None] = PrimitiveConstructorSpec(
    nargs=1,
    metavar=f"{{{','.join(preset_names())}}}",
    instance_from_str=lambda words: words[0],
    is_instance=lambda value: value is None or isinstance(value, str),
    str_from_instance=lambda value: [str(value)],
    choices=tuple(preset_names()),
)


@dataclass(frozen=True)
class RunOptions(RunConfig):
    """The fields of a run's config, their source, and the run directory."""

    preset: Annotated[str | None, _PRESET] = None
    """Settings that come with the package; that of env.id if neither --config nor a resumed run gives any."""
    config: Path | None = None
    """A TOML file with the fields of a run, for example the config.toml of another run."""
    run_dir: Path | None = None
    """Folder for the run's files; runs/ENV-METHOD-sSEED-TIME if not given."""
    resume: bool = False
    """Continue the run in --run-dir, with its config, from its newest whole checkpoint, which survives
    the death of process and machine; start it if none has begun."""
    resume_from: int | None = None
    """As --resume, but go back to the checkpoint with this number (folder checkpoints/NUMBER), even if records are
    damaged; what is younger is moved to aside/."""
    overwrite: bool = False
    """Start over in a folder that holds a run, which is moved to aside/ in that folder."""
    zenoh_config: Path | None = None
    """A Zenoh configuration file (TLS, access control); the endpoints given as flags still apply."""
    shared_memory: bool = False
    """Use shared memory between processes on one machine: the learner reads frames in the replay service's."""
    allow_import: tuple[str, ...] = ()
    """Modules, such as my_envs, that may be imported even if they lie in the folder of a resumed run or beside it."""
    log: str = DEFAULT_LOG
    """Where metrics go beside the run's own tables, with commas: tensorboard; wandb and mlflow (extras), whose own
    variables apply (WANDB_MODE, WANDB_PROJECT, MLFLOW_TRACKING_URI); none for nowhere."""

    def run_config(self) -> RunConfig:
        """The checked config of the run; raises UsageError."""
        return validated(RunConfig(**{each.name: getattr(self, each.name) for each in fields(RunConfig)}))

    @property
    def settings(self) -> str:
        """The settings that matter most, and where they come from, in one line."""
        resumed = self.start.goes_on and self.run_dir is not None and (self.run_dir / CONFIG).exists()
        return settings_line((self, source_of(self.preset, self.config and shown(self.config), resumed, self.env.id)))

    @property
    def start(self) -> Start:
        """How the run begins in its directory."""
        return Start(self.resume, self.resume_from, self.overwrite)

    def directory(self) -> Path:
        """The run directory.

        Raises:
            UsageError: it already holds a run; or, with --resume, flags contradict the run's config.
            RunError: it belongs to another run.
        """
        if self.start.goes_on and self.overwrite:
            raise UsageError("--overwrite: starts over; --resume and --resume-from go on: give one of them")
        if self.start.goes_on:
            return self._resumed()
        game = re.sub(r"[^A-Za-z0-9]+", "-", self.env.id).lower()
        named = f"{game}-{self.method.replace(':', '.')}-s{self.seed}-{time.strftime('%Y%m%d-%H%M%S')}"
        path = self.run_dir or absolute(Path("runs") / named)
        self.start.check_free(path)
        return path

    def _resumed(self) -> Path:
        path = self.run_dir
        if path is None:
            raise UsageError("--resume: give the run's folder too, --run-dir")
        file = path / "config.toml"
        if file.exists():
            check_resumed(self.run_config(), read_run_config(path), file)
        elif checkpoint_numbers(path, LEARNER) or any((path / name).exists() for name in RECORDS):
            raise UsageError(f"run directory {path}: holds a run, but its config.toml is missing; nothing was changed")
        elif has_run_id(path):
            raise RunError(f"run directory {path}: a replay service's, of the run with id {read_run_id(path)}")
        return path


@dataclass(frozen=True)
class LearnerRunOptions(RunOptions):
    """The flags of commands that start a learner's process."""

    restart: bool = False
    """With --resume: start training from the beginning if learner and replay service have no checkpoint in common."""
    prometheus: HttpAddress = ""
    """Serve the learner's status to Prometheus at PORT, on loopback, or at HOST:PORT."""


OptionsT = TypeVar("OptionsT", bound=RunOptions)


def parse_run(kind: type[OptionsT], program: str, description: str, *, lockstep: bool = False) -> OptionsT:
    """Parse flags over the config that `--preset`, `--config` or `--resume` names; warn of flags without effect.

    lockstep: the run will be a single process.

    Raises:
        UsageError: the flags are invalid; the text, one line, says how.
    """
    args = sys.argv[1:]
    base = base_config(args)
    extended = with_methods(kind, base.method)
    of_method = {} if base.method_settings is None else {table_of(base.method): base.method_settings}
    default = extended(**{each.name: getattr(base, each.name) for each in fields(RunConfig)}, **of_method)
    parsed = cli.parse(extended, program, description, default, args, COMMON)
    given = cli.given_flags(args)
    parsed = fitted(parsed, given, lockstep=lockstep)
    options: OptionsT = replace(parsed, method_settings=getattr(parsed, table_of(parsed.method), None))
    permit([*options.allow_import, *(value for name, value in options.imports.items() if name in given)])
    if (
        "learner.swap_every" in given
        and not options.two_networks
        and not (options.learner.target_update_every or options.soft_targets)
    ):
        warn(f"--learner.swap-every: of {options.method}, the flag is --learner.target-update-every")
    for line in without_effect(options, given, lockstep=lockstep):
        warn(line)
    chosen_sinks(options.log)  # refuses
    if isinstance(options, LearnerRunOptions) and options.prometheus:
        check_extra("--prometheus", "prometheus", "prometheus_client")
    return options


def with_methods(kind: type[OptionsT], method: str | None = None) -> type[OptionsT]:
    """The options with a field for each method's own settings, and with every method in the help.

    method: the one that the command line names, which may be a user's own.
    A method that can't be imported is refused if it is chosen, and otherwise left out.
    """
    added: list[tuple[str, Any, Any]] = []
    summaries = []
    for name in dict.fromkeys((*METHODS.names(), *([method] if method else []))):
        with suppress(UsageError):
            found = METHODS.get(name)
            summaries.append(f"{name}: {found.summary}")
            if found.settings is not None and not hasattr(kind, found.table):
                added.append((found.table, found.settings, field(default_factory=found.settings)))
    shown = tyro.conf.arg(metavar=f"{{{','.join(METHODS.names())}}}", help=f"Training method; {'; '.join(summaries)}.")
    added.append(("method", Annotated[str, shown], RunConfig.method))
    return make_dataclass(kind.__name__, added, bases=(kind,), frozen=True)


def base_config(args: Sequence[str] | None = None) -> RunConfig:
    """The config given by `--preset`, `--config`, `--method` and `--total-steps`; the other flags override it.

    With `--resume` or `--resume-from` and neither a preset nor a file, it is the config of the run in `--run-dir`.

    Raises:
        UsageError: an unknown preset, a bad file, or both given.
    """
    early = argparse.ArgumentParser(add_help=False, allow_abbrev=False, exit_on_error=False)
    early.add_argument("--preset")
    early.add_argument("--config", type=_path)
    early.add_argument("--method")
    early.add_argument("--env.id", dest="env_id")
    early.add_argument("--total-steps", "--total_steps", type=whole_number)
    early.add_argument("--run-dir", "--run_dir", type=_path)
    early.add_argument("--allow-import", "--allow_import", nargs="*", default=[])
    early.add_argument("--resume", action="store_true")
    early.add_argument("--resume-from", "--resume_from")
    try:
        known, _ = early.parse_known_args(sys.argv[1:] if args is None else args)
    except argparse.ArgumentError as error:
        raise UsageError(str(error)) from error
    if known.preset and known.config:
        raise UsageError("--preset and --config: give one of them")
    permit([*known.allow_import, *([known.method] if known.method else [])])
    resumed = known.run_dir if known.resume or known.resume_from else None
    return chosen_config(known.preset, known.config, known.method, known.total_steps, resumed, known.env_id)


def chosen_config(
    preset: str | None,
    file: Path | None,
    method: str | None,
    total_steps: int | None,
    resumed: Path | None,
    env_id: str | None = None,
) -> RunConfig:
    """The config of a preset or a file; of neither, that of the run in the folder `resumed`, or of an environment.

    Raises:
        UsageError: an unknown preset or method, or a bad file.
    """
    if resumed:
        check_links(resumed)
        if (resumed / "config.toml").exists():
            hand_over(resumed)
    if file and any((file.parent / name).exists() for name in _OF_RUNS):
        hand_over(file.parent)
    saved = resumed and not (preset or file) and resumed / "config.toml"
    if resumed and saved and saved.exists():
        read_run_config(resumed)
        file = saved
    tables = load_tables(preset, file) if preset or file else starting_tables(env_id)
    if total_steps is not None:
        tables = shortened(tables, total_steps) if file is None else {**tables, "total_steps": total_steps}
    if file and method and "methods" not in tables and method != tables.get("method", method):
        warn(f"{file} has no settings for single methods: {method} gets those of {tables['method']}")
    return resolve(tables, method)


def _path(text: str) -> Path:
    """As `user_path`, which will refuse an empty one with its flag."""
    return Path(text).expanduser()
