"""A lockstep run with its files: starts or goes on in a run directory, plays to the end, and completes the files."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from pathlib import Path

from coop.common.envs.make import check_filmed
from coop.common.errors import CoopError, RunError, first_line, place
from coop.common.process.console import say
from coop.common.process.lifecycle import Stop
from coop.common.process.limits import use_threads
from coop.common.settings.config import RunConfig
from coop.common.settings.resuming import settings_digest
from coop.evaluation.episodes import Evaluator
from coop.learner.initial_networks import load_initial_networks
from coop.learner.summary import summarise
from coop.lockstep.compiled.conditions import why_not
from coop.lockstep.lockstep import LOOK_EVERY, PROGRESS_EVERY, Lockstep, Replaying
from coop.records.checkpoints import take_request
from coop.records.following import Callbacks
from coop.records.learner_checkpoints import load_learner
from coop.records.locks import RunLock
from coop.records.resumption import Start
from coop.records.run_directory import RunDirectory
from coop.records.sinks import DEFAULT_LOG
from coop.records.summaries import Summary

WORTH_COMPILING = 5000  # steps: loading compiled loops takes as long as they save in 2,000


class LockstepRun:
    """A run that holds its directory's locks until `close`.

    run: where it is. notices: lines that say what it goes on from, and what was passed over or moved aside.
    """

    def __init__(
        self,
        config: RunConfig,
        path: Path,
        program: str,
        start: Start,
        *,
        log: str | Sequence[str] = DEFAULT_LOG,
        replaying: Replaying = lambda played, actions: None,
    ) -> None:
        """Prepare the run; program: named to other processes that want the directory. log: see `chosen_sinks`.

        start: how it begins there. replaying: see `Lockstep.restore`; what it raises leaves the run as it was.

        Raises:
            UsageError: the config does not fit the environment, or the directory's checkpoint a lockstep run.
            RunError: another process uses the directory, or it cannot be read.
        """
        use_threads(config.learner.threads)
        self.path = path
        self._log = log
        if config.video_every:
            check_filmed(config.env)
        self.run = Lockstep(config)
        try:
            self._lock = RunLock(path, program, ("learner", "replay"))
        except RunError:
            self.run.env.close()
            raise
        try:
            settings = settings_digest(config)
            begun = [] if start.goes_on else self.run.memory.preload(config)  # before an older run is moved
            self._found, self.notices = start.prepare(
                path, replay=not config.streaming, settings=settings, load=load_learner
            )
            self._lock.sign()
            if self._found.newest is None:
                load_initial_networks(self.run.agent)
                self.notices += begun or self.run.memory.preload(config)
            else:
                self.run.restore(self._found.newest, replaying)
                self._found.newest.state.clear()  # only its memory
        except BaseException:
            self.close()
            raise

    def play(
        self,
        stop: Stop,
        progress: Callable[[str], None] = lambda line: None,
        callbacks: Callbacks | None = None,
    ) -> Summary:
        """Play until the run is over or stopped; progress: called with a line every few seconds.

        callbacks: called after each step with what it has recorded; one that fails stops the run. Without any, a long
        run of what `why_not` allows is played by compiled loops, which leave the same files.

        Raises:
            RunError: there is no space for the closing checkpoint or the summary.
            UsageError: a sink refuses.
        """
        with self.files() as directory:
            if directory.aside:
                progress(directory.aside)
            if not callbacks and (play_runs := self._compiled()):
                return play_runs({self.run: directory}, stop, progress)[0]
            callbacks = callbacks or Callbacks()
            callbacks.follow(self.path, stop)
            summary = play_lockstep(self.run, directory, stop, progress, callbacks.look)
            callbacks.finish()
            return summary

    def _compiled(self) -> Callable[..., list[Summary]] | None:
        """`play_runs`, if compiled loops can play the run, and pay."""
        config = self.run.config
        if config.total_steps - self.run.step < WORTH_COMPILING or why_not(config):
            return None
        try:
            from coop.lockstep.compiled.group import play_runs  # noqa: PLC0415 (numba takes a second)
        except ImportError as error:  # a numba that does not fit the other packages
            say(f"plays without compiled loops: {first_line(error)}")
            return None
        return play_runs

    def files(self) -> RunDirectory:
        """Open the run's files, to go on from where it is; raises as `RunDirectory`."""
        run, newest = self.run, self._found.newest
        number = None if newest is None else newest.number
        return RunDirectory(self.path, run.config, self._found, number, run.step, log=self._log)

    @property
    def diverged(self) -> str:
        """How the run has diverged; empty if it has not."""
        return self.run.trainer.diverged

    def close(self) -> None:
        """Free the emulator and the locks."""
        self.run.env.close()
        self._lock.release()


def play_lockstep(
    run: Lockstep,
    directory: RunDirectory,
    stop: Stop,
    progress: Callable[[str], None] = lambda line: None,
    recorded: Callable[[], None] = lambda: None,
) -> Summary:
    """Play until the run is over or stopped, and complete its files; recorded: called after each step.

    Raises:
        RunError: there is no space for the closing checkpoint or the summary.
    """
    trainer, due, looked = run.trainer, time.monotonic() + PROGRESS_EVERY, 0.0
    evaluator = Evaluator(run.config, stop.is_set)
    _evaluate(run, directory, evaluator)  # what a stop has abandoned
    outcome = ""
    try:
        while not (outcome := stop.reason if stop.is_set() else trainer.outcome()):
            for effects in run.play():
                directory.record(effects.episodes, effects.metrics)
            _evaluate(run, directory, evaluator)
            recorded()
            if time.monotonic() >= looked:
                looked = time.monotonic() + LOOK_EVERY
                if take_request(directory.path):
                    trainer.ask_checkpoint()
            if trainer.checkpoint_due() and not trainer.outcome():
                run.save_on_the_way(directory)
            if time.monotonic() >= due:
                due = time.monotonic() + PROGRESS_EVERY
                progress(run.progress())
        outcome = trainer.diverged or outcome
        if trainer.saveable():
            run.save(directory)
    except CoopError as error:
        outcome = f"failed: {error}"
        raise
    except (Exception, SystemExit) as error:  # users' code may raise anything
        outcome = f"failed: {first_line(error)}{place(error)}"
        raise
    finally:
        summary = summarise(trainer, outcome or "interrupted", time.monotonic(), run.step)
        directory.conclude(summary, f"{summary.title}, lockstep")
    return summary


def _evaluate(run: Lockstep, directory: RunDirectory, evaluator: Evaluator) -> None:
    """Evaluate and film the acting network if it is time."""
    config, agent, step = run.config, run.agent, run.step
    network = agent.networks[agent.acting]
    if run.trainer.diverged or not step:
        return
    if config.eval_every and step % config.eval_every == 0 and step > directory.evaluated:
        result = evaluator.evaluate(network, agent.acting + 1, agent.updates, step)
        if result is not None:
            directory.evaluation(result)
    if config.video_every and step % config.video_every == 0:
        gif = evaluator.film(network, step)
        if gif is not None:
            directory.film(gif, step)
