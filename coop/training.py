"""Training from Python: starts a run in the background, in this process or as a topology of processes."""

from __future__ import annotations

import atexit
import sys
import threading
import warnings
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from contextlib import closing
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

from coop.common.arguments import check_flag, check_seconds, check_whole, texts
from coop.common.errors import CoopError, RunError, UsageError, place
from coop.common.imports import describe, permit
from coop.common.places import absolute
from coop.common.process.console import say
from coop.common.process.files import make_folder
from coop.common.process.lifecycle import Stop
from coop.common.process.processes import ChildProcess, command
from coop.common.settings.config import MAY_NAME_MODULES, RunConfig, check_distributed
from coop.common.settings.effects import without_effect
from coop.common.settings.overrides import leaves, merged
from coop.common.settings.reading import with_numbers
from coop.common.settings.resuming import settings_digest
from coop.common.settings.starting import env_id_of, stated
from coop.common.settings.tables import to_tables, to_toml, validated
from coop.evaluation.buffer import Buffer, ask_and_wait
from coop.evaluation.notebook import table_html
from coop.evaluation.saved import load
from coop.lockstep.run import LockstepRun
from coop.records.following import Callback, Callbacks, MetricsFollowing
from coop.records.locks import RunLock
from coop.records.resumption import Start
from coop.records.run_options import RunOptions, chosen_config
from coop.records.sinks import DEFAULT_LOG, chosen_sinks
from coop.records.summaries import read_summary

POLL = 0.1  # seconds
GRACE = 90.0  # seconds for a topology's clean stop


class TrainingRun:
    """A run in the background. When the interpreter ends normally, it waits for the run; otherwise the run is stopped.

    Attributes:
        directory: the run directory.
        config: of the run.
    """

    def __init__(self, config: RunConfig, directory: Path, work: Callable[[Stop], None]) -> None:
        """Start the run; work: plays it to its end or to the stop, and raises CoopError if it fails."""
        self.config = config
        self.directory = directory
        self._stop = Stop()
        self._failure: BaseException | None = None
        self._work = work
        self._thread = threading.Thread(target=self._run, name=f"run in {directory}", daemon=True)
        self._thread.start()
        atexit.register(self._at_exit)

    def __repr__(self) -> str:
        state = "running" if self.running else "failed" if self._failure else "ended"
        return f"<run {str(self.directory)!r}: {self.config.env.id}, {self.config.method}, {state}>"

    def _repr_html_(self) -> str:
        if not (self.directory / "config.toml").exists():  # its process has not begun
            return table_html({"run": repr(self).strip("<>")})
        return load(self.directory)._repr_html_()

    @property
    def running(self) -> bool:
        """True until the run has ended and its files are complete."""
        return self._thread.is_alive()

    @property
    def summary(self) -> dict[str, Any] | None:
        """The contents of summary.json; None while the run goes on, or if it failed before it wrote one."""
        return None if self.running else read_summary(self.directory) or None

    def metrics(self) -> Iterator[dict[str, Any]]:
        """Yield the rows of metrics.jsonl, from the first one on, as they are written; ends with the run.

        Each has as well, of what was before it, or None: `return_mean_100`, the mean return of the last 100 episodes,
        and `eval_return_mean` and `eval_env_step` of the newest evaluation.

        Raises:
            RunError: as `wait`, after the last row.
        """
        following = MetricsFollowing(self.directory)
        while True:
            running = self.running  # read before the file, so that its last lines are not missed
            yield from following.rows()
            if not running:
                break
            self._thread.join(POLL)
        self.wait()

    def buffer(self, timeout: float = 60.0) -> Buffer:
        """The transitions that the replay table holds now: the run saves a checkpoint for it, and goes on.

        Raises:
            UsageError: the run has no table, or has ended without a checkpoint.
            RunError: it saved none within `timeout` seconds, for instance because it waits before its first update.
        """
        check_seconds("timeout", timeout)
        if self.running and not self.config.streaming:
            ask_and_wait(self.directory, timeout, lambda: self.running)
        return load(self.directory).buffer()

    def stop(self) -> dict[str, Any] | None:
        """Stop the run cleanly, with a closing checkpoint from which `resume=True` goes on; returns as `wait`."""
        self._stop.set("stopped")
        return self.wait()

    def wait(self, timeout: float | None = None) -> dict[str, Any] | None:
        """Wait for the run's end, for at most `timeout` seconds; return its summary, None if it still goes on.

        Raises:
            RunError: the run has failed or diverged.
        """
        if timeout is not None:
            check_seconds("timeout", timeout)
        self._thread.join(timeout)
        failure = self._failure
        if failure is None:
            return self.summary
        if isinstance(failure, RunError):
            raise failure
        text = str(failure) if isinstance(failure, CoopError) else describe(failure) + place(failure)
        raise RunError(text) from failure

    def _run(self) -> None:
        try:
            self._work(self._stop)
        except SystemExit as error:  # which would end the program of the thread that waits, in silence
            self._failure = RunError(f"the run's own code has called sys.exit({error.code!r})")
        except BaseException as error:  # the thread that waits for the run raises it
            self._failure = error
        atexit.unregister(self._at_exit)

    def _at_exit(self) -> None:
        if hasattr(sys, "last_value"):  # an exception ends the interpreter
            self._stop.set("stopped")
        try:
            self._thread.join()
        except KeyboardInterrupt:
            self._stop.set("interrupted")
            self._thread.join()


def train(
    preset: str | None = None,
    method: str | None = None,
    *,
    config: str | Path | None = None,
    run_dir: str | Path | None = None,
    distributed: bool = False,
    actors: int = 1,
    resume: bool = False,
    resume_from: int | None = None,
    overwrite: bool = False,
    allow_import: Collection[str] = (),
    log: str | Iterable[str] = DEFAULT_LOG,
    on_metrics: Callback | None = None,
    on_episode: Callback | None = None,
    on_evaluation: Callback | None = None,
    **settings: Any,  # noqa: ANN401 (the fields of a run, each checked)
) -> TrainingRun:
    """Start a run and return at once.

    Args:
        preset: settings that come with the package; that of the environment if neither it nor `config` is given,
            neutral ones if it has none.
        method: the training method.
        config: a TOML file with the fields of a run, in place of a preset.
        run_dir: folder for the run's files; runs/ENV-METHOD-sSEED-TIME if not given.
        distributed: run a learner, a replay service and `actors` actors as processes of this machine; otherwise the
            run is one of `coop-lockstep`, in a thread of this process.
        actors: actor processes of a distributed run; 0 for a run that learns from the data set `replay.preload` alone,
            of either kind (`replay.offline`).
        resume: continue the run in `run_dir`, from its newest whole checkpoint; start it if there is none yet.
        resume_from: as `resume`, but go back to the checkpoint with this number first.
        overwrite: start over where `run_dir` holds a run, which is moved to its folder aside/.
        allow_import: modules of a resumed run's environment or network that may be imported even if they lie in its
            folder or beside it; those that `settings` name need not be listed.
        log: where metrics go beside the run's own files: names of sinks in a list, or in a text with commas:
            "tensorboard", "wandb", "mlflow" (extras of these names); "none" for nowhere.
        on_metrics, on_episode, on_evaluation: called, in the thread of the run, with each new row as a dictionary: as
            `TrainingRun.metrics` yields it, and of episodes.csv and evaluations.csv. One that returns a true value
            stops the run cleanly, as `TrainingRun.stop` does; one that raises an exception fails it.
        settings: fields of a run; a table as a mapping: `seed=1, total_steps=20_000, replay={"capacity": 500}`.

    Raises:
        UsageError: a setting is invalid, `run_dir` holds a run already, or one that can't be resumed.
        RunError: `run_dir` is in use.
    """
    callbacks = Callbacks({"on_metrics": on_metrics, "on_episode": on_episode, "on_evaluation": on_evaluation})
    named, names = [*texts("allow_import", allow_import), *_named({"method": method, **settings})], chosen_sinks(log)
    permit(named)
    check_whole("actors", actors, 0)
    for name, flag in (("distributed", distributed), ("resume", resume), ("overwrite", overwrite)):
        check_flag(name, flag)
    if resume_from is not None:
        check_whole("resume_from", resume_from, 0)
    replay = settings.get("replay", {})
    if actors == 0 and isinstance(replay, Mapping) and replay.get("preload"):
        settings["replay"] = {**replay, "offline": True}
    given = stated(settings)
    start = Start(resume, resume_from, overwrite)
    options = _options(preset, method, config, run_dir, start, settings, given, lockstep=not distributed)
    run_config = options.run_config()
    for line in without_effect(run_config, given, lockstep=not distributed):
        warnings.warn(line, stacklevel=2)
    say(options.settings)
    if not distributed:
        if actors != 1 and not run_config.replay.offline:
            raise UsageError(f"actors = {actors}: in distributed runs only; a lockstep run is one process")
        directory = options.directory()
        run = LockstepRun(run_config, directory, "coop.train", options.start, log=names)
        for line in run.notices:
            say(line)
        return TrainingRun(run_config, directory, lambda stop: _play(run, stop, callbacks))
    if actors < (0 if run_config.replay.offline else 1):
        raise UsageError(f"actors = {actors}: must be at least 1, or 0 with replay.preload")
    check_distributed(run_config)
    topology = _topology(run_config, options.directory(), actors, options.start, named, names)
    return TrainingRun(run_config, topology.directory, lambda stop: topology.play(stop, callbacks))


def _options(
    preset: str | None,
    method: str | None,
    file: str | Path | None,
    run_dir: str | Path | None,
    start: Start,
    settings: Mapping[str, Any],
    given: Collection[str],
    *,
    lockstep: bool,
) -> RunOptions:
    """The options that the same flags give on a command line."""
    if preset is not None and file is not None:
        raise UsageError("preset and config: give one of them")
    directory = None if run_dir is None else absolute(run_dir, "run_dir")
    settings = with_numbers(RunConfig, settings)
    steps = settings.get("total_steps")
    path = None if file is None else absolute(file, "config")
    base = chosen_config(
        preset,
        path,
        method,
        steps if isinstance(steps, int) else None,
        directory if start.goes_on else None,
        env_id_of(settings),
    )
    chosen = validated(merged(to_tables(base), settings), given, lockstep=lockstep)
    values = {field.name: getattr(chosen, field.name) for field in fields(RunConfig)}
    return RunOptions(**values, preset=preset, config=path, run_dir=directory, **asdict(start))


def _play(run: LockstepRun, stop: Stop, callbacks: Callbacks) -> None:
    with closing(run):
        run.play(stop, callbacks=callbacks)
        if run.diverged:
            raise RunError(run.diverged)


class _Topology:
    """A run of `coop-local` as a child process.

    directory: the run directory.
    """

    def __init__(self, process: ChildProcess, directory: Path) -> None:
        self.directory = directory
        self._process = process

    def play(self, stop: Stop, callbacks: Callbacks) -> None:
        """Run it to its end; raises RunError if it, or a callback, fails."""
        callbacks.follow(self.directory, stop)
        self._process.start()
        while self._process.exit_status() is None and not stop.wait(POLL):
            callbacks.look()
        self._process.interrupt()
        self._process.end(GRACE)
        if self._process.exit_status() and not (stop.is_set() and self._process.was_interrupted()):
            raise RunError(self._process.why())
        callbacks.finish()


def _named(settings: Mapping[str, Any]) -> list[str]:
    """The modules that the settings of a call name."""
    values = [value for path, value in leaves(settings) if ".".join(path) in MAY_NAME_MODULES]
    return [value.partition(":")[0] for value in values if isinstance(value, str) and ":" in value]


def _topology(
    config: RunConfig, directory: Path, actors: int, start: Start, named: list[str], log: tuple[str, ...]
) -> _Topology:
    with RunLock(directory, "coop.train", ("learner", "replay")):  # the process takes it after this one
        start.prepare(directory, replay=True, settings=settings_digest(config))
    logs = directory / "logs"
    try:
        make_folder(logs)
        file = logs / "coop-local.toml"
        file.write_text(to_toml(config), encoding="utf-8")
    except OSError as error:
        raise RunError(f"run directory {directory}: {error.strerror or error}") from error
    flags = [
        f"--config={file}",
        f"--run-dir={directory}",
        f"--actors={actors}",
        f"--log={','.join(log) or 'none'}",
        *(["--resume"] if start.goes_on else []),
        *(["--allow-import", *named] if named else []),
    ]
    return _Topology(ChildProcess("coop-local", command("coop-local", *flags), logs / "coop-local.log"), directory)
