"""A search for settings by Optuna (extra `optuna`): each trial is a run, or one for each seed, in a process."""

from __future__ import annotations

import sqlite3
import time
from collections import deque
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from coop.common.arguments import check_whole
from coop.common.errors import CoopError, RunError, UsageError, first_line
from coop.common.imports import check_extra
from coop.common.numbers import RETURN_WINDOW
from coop.common.places import absolute
from coop.common.process.files import make_folder
from coop.common.process.limits import cores
from coop.common.process.untrusted import refuse_links
from coop.records.following import EPISODES, Following
from coop.records.sinks import DEFAULT_LOG
from coop.records.summaries import read_summary
from coop.studies.space import Space
from coop.studies.sweep.folder import CellFolder, check_no_run
from coop.studies.sweep.local import LocalProcesses

if TYPE_CHECKING:
    import optuna

STORAGE = "optuna.db"
TICK = 0.2  # seconds
TRIES = 25  # to make a storage's tables while others do
MOST_SEED = 2**31  # of the sampler, to which the number of trials is added; numpy takes 32 bits
REPORTS = 20  # of a run, to the pruner, at equal distances in environment steps
GRACE = 60.0  # seconds for the runs to save their state


def tune(
    grid: str | Path | Mapping[str, Any],
    folder: str | Path,
    *,
    trials: int = 20,
    workers: int | None = None,
    seed: int = 0,
    sampler: optuna.samplers.BaseSampler | None = None,
    pruner: optuna.pruners.BasePruner | None = None,
    storage: str | None = None,
) -> optuna.Study:
    """Search for the settings with the largest mean return of the last 100 episodes, over a grid's seeds; wait.

    The same call goes on with a search that was interrupted, its runs from their newest checkpoints. Several processes
    may share a folder. A trial whose run fails, diverges or is refused is a failed trial, with the reason in its
    attribute `why`; its attributes `seeds` and `settings` say what was run.

    Args:
        grid: as of `coop.sweep`, the contents or the path of a TOML file. Of a field in `vary`, a list is chosen from,
            and a table `{low, high}`, with `log = true` or a `step`, is a range.
        folder: for the runs, `trial-0000` and so on, and Optuna's storage.
        trials: number of trials that are to have been run in the end, earlier ones included.
        workers: processes to run concurrently; the number of cores if None.
        seed: of the sampler, if none is given.
        sampler, pruner: Optuna's; TPE, and the median rule, if None. The pruner is told the mean return of the last 100
            episodes after each twentieth of a run.
        storage: URL of Optuna's storage; SQLite in the folder if None.

    Raises:
        UsageError: Optuna is not installed, the grid is invalid, or the folder holds a run or a search of another kind.
        RunError: the storage can't be read or written.
    """
    check_extra("coop.tune", "optuna", "optuna")
    import optuna  # noqa: PLC0415 (an extra, which may be missing)

    check_whole("trials", trials, 1)
    check_whole("workers", cores() if workers is None else workers, 1)
    check_whole("seed", seed, 0, MOST_SEED)
    path = absolute(folder, "folder")
    for name, given, kind in (
        ("sampler", sampler, optuna.samplers.BaseSampler),
        ("pruner", pruner, optuna.pruners.BasePruner),
        ("storage", storage, str),
    ):
        if not isinstance(given, kind | None):
            raise UsageError(f"{name} = {given!r}: must be a {kind.__name__}, or None")
    space = Space(grid)
    file = _file_in(path)
    with _storing(storage or str(file)):
        try:
            study = _study(storage or file, path.name, pruner)
        except (ImportError, ValueError) as error:  # no such database here
            raise UsageError(f"storage {storage}: {first_line(error)}") from error
        space.check(study)
        # Another seed after each interruption: the same one would draw the same settings again.
        study.sampler = sampler or optuna.samplers.TPESampler(seed=seed + len(study.trials))
        search = _Search(study, space, path, workers or cores())
        try:
            while search.advance(trials):
                time.sleep(TICK)
        finally:
            search.executor.stop(GRACE)
    return study


def _file_in(folder: Path) -> Path:
    """The file of Optuna's storage in a folder, which it creates; raises UsageError where none can be."""
    file = folder / STORAGE
    refuse_links(file)
    check_no_run(folder, "folder")
    try:
        make_folder(folder)
    except OSError as error:
        raise UsageError(f"folder {folder}: {error.strerror}") from error
    return file


def _study(storage: str | Path, name: str, pruner: optuna.pruners.BasePruner | None) -> optuna.Study:
    """The study of this name, which it creates in a storage, by its URL or file, that may be new as well.

    Of several processes that make a storage's tables at once, Optuna fails in all but one.
    """
    import optuna  # noqa: PLC0415 (an extra)
    from sqlalchemy.exc import IntegrityError, SQLAlchemyError  # noqa: PLC0415

    for left in reversed(range(TRIES)):
        try:
            return optuna.create_study(
                storage=_storage(storage), study_name=name, direction="maximize", load_if_exists=True, pruner=pruner
            )
        except SQLAlchemyError as error:
            if not left or not (isinstance(error, IntegrityError) or "already exists" in str(error)):
                raise
            time.sleep(TICK)
    raise AssertionError


class _Connection(sqlite3.Connection):
    """Is closed with its last user: Optuna leaves that to Python, which warns of it from 3.13 on."""

    def __del__(self) -> None:
        with suppress(sqlite3.ProgrammingError):  # it could not be opened
            self.close()


def _storage(place: str | Path) -> str | optuna.storages.RDBStorage:
    """Optuna's storage at a URL, or in a file: by its path, as a URL with a ? or # in it would be another file's."""
    import optuna  # noqa: PLC0415 (an extra)

    if isinstance(place, Path):
        connect = partial(sqlite3.connect, place, check_same_thread=False, factory=_Connection)
        return optuna.storages.RDBStorage(f"sqlite:///{STORAGE}", engine_kwargs={"creator": connect})
    if place.startswith("sqlite:///"):
        return optuna.storages.RDBStorage(place, engine_kwargs={"connect_args": {"factory": _Connection}})
    return place


@contextmanager
def _storing(storage: str) -> Iterator[None]:
    """Within it, what a storage fails of is a RunError in one line."""
    from optuna.exceptions import StorageInternalError  # noqa: PLC0415 (an extra)
    from sqlalchemy.exc import SQLAlchemyError  # noqa: PLC0415

    try:
        yield
    except (SQLAlchemyError, StorageInternalError) as error:
        why = next((each for each in (error.__cause__, getattr(error, "orig", None)) if each), error)
        raise RunError(f"storage {storage}: {first_line(getattr(why, 'orig', None) or why)}") from error


@dataclass
class _Running:
    """A trial that is being run: its runs that are left, the first one under way; scores: of those that are done."""

    trial: optuna.Trial
    left: list[CellFolder]
    following: Following
    told: set[int]
    scores: list[float] = field(default_factory=list)
    returns: deque[float] = field(default_factory=lambda: deque(maxlen=RETURN_WINDOW))
    pruned: bool = False


class _Search:
    """The trials of a study, run by an executor."""

    def __init__(self, study: optuna.Study, space: Space, path: Path, workers: int) -> None:
        import optuna  # noqa: PLC0415 (an extra)

        self._study, self._space, self._path, self._workers = study, space, path, workers
        self.executor = LocalProcesses(space.file, workers)
        self._exhausted = False  # the sampler has nothing left to try
        self._states = optuna.trial.TrialState
        self._told_by_another = optuna.exceptions.UpdateFinishedTrialError  # process, which saw the end first
        self._running: list[_Running] = []
        self._log = optuna.logging.get_logger("optuna.coop")
        # Those of a search that was interrupted go on; those that another process runs are refused by their locks.
        stale = study.get_trials(states=(self._states.RUNNING,))
        self._stale = [(optuna.Trial(study, each._trial_id), set(each.intermediate_values)) for each in stale]

    def advance(self, trials: int) -> bool:
        """Begin trials while there are free processes, and look at the running ones; False if none is left."""
        for running in list(self._running):
            self._look(running)
        for trial, told in list(self._stale):
            if len(self._running) < self._workers:
                if self._goes_on(trial):
                    self._begin(trial, told)
                if any(running.trial is trial for running in self._running) or not self._goes_on(trial):
                    self._stale.remove((trial, told))
        while (
            not self._exhausted and len(self._running) < self._workers and len(self._study.get_trials(False)) < trials
        ):
            self._begin(self._study.ask(), set())
        return bool(self._running or self._stale)

    def _goes_on(self, trial: optuna.Trial) -> bool:
        """Whether nobody has told how a trial ended; one whose run another process holds is waited for."""
        return bool(self._study.get_trials(False)[trial.number].state == self._states.RUNNING)

    def _begin(self, trial: optuna.Trial, told: set[int]) -> None:
        try:
            method, chosen = self._space.suggest(trial)
            trial.set_user_attr("seeds", list(self._space.file.seeds))
            trial.set_user_attr("settings", {"method": method, **chosen})
            cells = self._space.cells(f"trial-{trial.number:04}", method, chosen)
            folders = [CellFolder(self._path, cell, DEFAULT_LOG) for cell in cells]
            running = _Running(trial, folders, Following(folders[0].path, EPISODES), told)
            if self._start(running):
                self._running.append(running)
        except self._told_by_another:
            pass
        except CoopError as error:
            self._fail(trial, str(error))

    def _start(self, running: _Running) -> bool:
        """Start the first run that has not ended; False if another process runs it, or nothing is left to do."""
        while running.left:
            folder = running.left[0]
            folder.check()
            running.following = Following(folder.path, EPISODES)
            running.returns.clear()
            ending = folder.ending()
            if ending is None:
                return self.executor.start(folder)
            if ending.kind != "finished":
                self._fail(running.trial, ending.why)
                return False
            self._finished(running)
        score = sum(running.scores) / len(running.scores)
        self._tell(running.trial, f"finished with value {score:g}", score)
        return False

    def _finished(self, running: _Running) -> None:
        running.scores.append(float(read_summary(running.left.pop(0).path)["return_mean_100"]))

    def _look(self, running: _Running) -> None:
        """Tell the pruner what is new, and see whether the run has ended."""
        folder = running.left[0]
        ending = self.executor.ending(folder)
        try:
            if not running.pruned and self._report(running, folder):
                running.pruned = True
                self.executor.interrupt(folder)
            if ending is None:
                return
            if running.pruned:
                self._tell(running.trial, "pruned", state=self._states.PRUNED)
            elif ending.kind == "finished":
                self._finished(running)
                if self._start(running):
                    return
            else:
                self._fail(running.trial, ending.why)
        except self._told_by_another:
            pass
        except CoopError as error:
            if ending is None:
                self.executor.interrupt(folder)
            self._fail(running.trial, str(error))
        self._running.remove(running)

    def _report(self, running: _Running, folder: CellFolder) -> bool:
        """Report what has been reached at each new twentieth of the run; True if the trial is to be pruned."""
        before, total = len(running.scores) * REPORTS, folder.cell.config.total_steps
        for row in running.following.rows():
            running.returns.append(row["return"])
            step = before + min(REPORTS, row["env_step"] * REPORTS // total)
            if step > before and step not in running.told:
                running.told.add(step)
                running.trial.report(sum(running.returns) / len(running.returns), step)
                if running.trial.should_prune():
                    return True
        return False

    def _fail(self, trial: optuna.Trial, why: str) -> None:
        with suppress(self._told_by_another):
            trial.set_user_attr("why", why)
        self._tell(trial, f"failed: {why}", state=self._states.FAIL)

    def _tell(
        self, trial: optuna.Trial, ended: str, value: float | None = None, state: optuna.trial.TrialState | None = None
    ) -> None:
        """Tell Optuna how a trial has ended, and its log, as `Study.optimize` does.

        A sampler of a finite grid then says by `Study.stop` that it is over.
        """
        self._log.info(f"Trial {trial.number} {ended}; parameters: {trial.params}")
        try:
            self._study.tell(trial, value, state, skip_if_finished=True)
        except RuntimeError as error:
            if "Study.stop" not in str(error):
                raise
            self._exhausted = True
