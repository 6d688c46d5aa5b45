"""What a run goes on from: which of its checkpoints are whole, and what is moved aside.

Learner, replay service, lockstep runs, evaluation, export and re-execution decide by this module alone. Nothing is
deleted that a person could want, and nothing is changed before it is clear what a run goes on from.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import msgspec

from coop.common.errors import CoopError, RunError, UsageError
from coop.common.process.files import FileDigest, aside_folder, measure, move_aside, truncate
from coop.common.process.untrusted import LEFT, MAX_SETTINGS, read_bytes, read_text
from coop.common.settings.tables import CONFIG, check_toml
from coop.records.checkpoints import (
    DONE,
    EVALUATIONS,
    FOLDER,
    LEARNER,
    RECORDS,
    REPLAY,
    WRITING,
    Damaged,
    Manifest,
    check_part,
    check_record,
    checkpoint_numbers,
    checkpoint_path,
    finished,
    reason,
    remove,
    settle_checkpoints,
    write_manifest,
)
from coop.records.run_ids import has_run_id, read_run_id
from coop.records.summaries import SUMMARY, read_summary

_STARTED = (*RECORDS, EVALUATIONS, SUMMARY, "learning_curve.png", "tb", "videos")  # by a run without a checkpoint
_REPLACED = (CONFIG, EVALUATIONS, SUMMARY, "learning_curve.png", "roster.json")  # by one that begins


@dataclass(frozen=True)
class Whole:
    """A checkpoint that can be gone on from. state: of the learner, if it was loaded."""

    path: Path
    manifest: Manifest
    state: dict[str, Any] = field(default_factory=dict)

    @property
    def number(self) -> int:
        """Its number, in updates."""
        return self.manifest.number


@dataclass(frozen=True)
class Survey:
    """What a run directory holds: whole checkpoints, the newest first, and by number what is wrong with others.

    unfinished: numbers of those that were begun only. lost_records: newest checkpoint that lacks nothing but records.
    """

    run_dir: Path
    whole: tuple[Whole, ...] = ()
    problems: Mapping[int, str] = field(default_factory=dict)
    unfinished: tuple[int, ...] = ()
    lost_records: int | None = None

    @property
    def newest(self) -> Whole | None:
        """The checkpoint to go on from; None to begin."""
        return self.whole[0] if self.whole else None

    @cached_property
    def passed_over(self) -> str:
        """Which checkpoints are passed over, and why, in one line; empty if none is."""
        return "; ".join(f"checkpoint {number}: {why}" for number, why in sorted(self.problems.items()))

    def of(self, number: int) -> Whole:
        """The whole checkpoint with a number."""
        return next(each for each in self.whole if each.number == number)

    def cut_back(self, number: int, why: str) -> Survey:
        """The survey with whole checkpoints younger than `number` as ones that can't be gone on from."""
        younger = {each.number: why for each in self.whole if each.number > number}
        return replace(self, problems={**self.problems, **younger})

    def describe(self) -> str:
        """Where a resumed run goes on, and what it passes over, in one line."""
        if self.newest is None:
            there = "the run there has no checkpoint yet" if self.begun else "there is no run there yet"
            return f"starts in {self.run_dir}: {there}"
        return f"resuming from checkpoint {self.newest.number}{self.fallback and f'; passes over {self.fallback}'}"

    @property
    def fallback(self) -> str:
        """What is wrong with the checkpoints younger than the newest whole one; empty if that is the newest."""
        return "; ".join(self.fallbacks(self.newest.number)) if self.newest else ""

    def fallbacks(self, number: int) -> list[str]:
        """What is wrong with each checkpoint that is younger than `number`."""
        return [f"checkpoint {each}: {why}" for each, why in sorted(self.problems.items()) if each > number]

    @property
    def begun(self) -> bool:
        """True if a run has begun in the directory."""
        return holds_run(self.run_dir)

    def check(self) -> None:
        """Raise UsageError if a run is there that can't be gone on with; nothing has been changed then."""
        if self.newest is not None:
            return
        if self.problems:
            left = self.lost_records
            how = "" if left is None else f"--resume-from {left} goes on with what is left of them; "
            raise UsageError(
                f"run directory {self.run_dir}: no checkpoint can be gone on from: {self.passed_over}. Nothing was "
                f"changed; {how}--overwrite moves the run aside and starts over"
            )
        try:
            summary = read_summary(self.run_dir)
        except RunError as error:
            raise UsageError(f"{error}; and there is no checkpoint to go on from") from error
        if summary.get("updates") and not str(summary.get("exit")).startswith("failed"):
            raise UsageError(
                f"run directory {self.run_dir}: {summary['updates']:,} updates, but no checkpoint to go on from. "
                "Nothing was changed; --overwrite moves the run aside and starts over"
            )


def survey(
    run_dir: Path,
    *,
    replay: bool = False,
    records: bool = False,
    settings: str = "",
    load: Callable[[Path], dict[str, Any]] | None = None,
    every: bool = False,
) -> Survey:
    """Look for whole checkpoints, from the newest on, without changing anything.

    Args:
        replay: the replay service's part must be whole too.
        records: the run's records must hold what the checkpoint seals, as they must to be continued.
        settings: checksum of the run's settings, as config.toml has them; not compared if it is empty.
        load: reads the learner's state of a checkpoint; one for which that fails is not whole.
        every: look at every checkpoint, not only as far as the newest whole one.
    """
    run_id = _owner(run_dir)
    whole: list[Whole] = []
    problems, unfinished, lost_records = {}, [], None
    for number in reversed(checkpoint_numbers(run_dir)):
        path = checkpoint_path(run_dir, number)
        if not (path / DONE).exists() and ((path / WRITING).exists() or not (path / LEARNER).exists()):
            unfinished.append(number)  # or a replay service's, or the user's
            continue
        try:
            manifest = check_part(path, number, run_id)
            if LEARNER not in manifest.files:
                raise Damaged(f"{DONE}: does not seal {LEARNER}")
            if settings and manifest.settings not in ("", settings):
                raise Damaged("it was saved with other settings than those in config.toml")
            if replay:
                _check_replay(path, number, manifest.run)
            state = {} if load is None else _loaded(path, load)
            lost_records = number if lost_records is None else lost_records
            for name in RECORDS if records else ():
                check_record(run_dir / name, manifest.records.get(name, FileDigest(0, 0)))
        except Damaged as damaged:
            problems[number] = str(damaged)
            continue
        whole.append(Whole(path, manifest, state))
        if not every:
            break
    return Survey(run_dir, tuple(whole), problems, tuple(unfinished), None if whole else lost_records)


@dataclass(frozen=True)
class Start:
    """How a run begins in its directory.

    resume: go on with the run there, if one has begun. resume_from: go back to this checkpoint of it first.
    overwrite: move the run there aside, and start over.
    """

    resume: bool = False
    resume_from: int | None = None
    overwrite: bool = False

    @property
    def goes_on(self) -> bool:
        """True if a run that is there is to be continued."""
        return self.resume or self.resume_from is not None

    def check_free(self, run_dir: Path) -> None:
        """Raise UsageError if a run is in the directory that this one neither goes on with nor moves aside.

        So are files of the user that this one would replace.
        """
        if self.goes_on or self.overwrite:
            return
        if holds_run(run_dir):
            how = "give another folder, go on with --resume (resume=True in Python), or move it aside with --overwrite"
            raise UsageError(f"run directory {run_dir}: holds a run already; {how}")
        if there := strays(run_dir):
            how = "give another folder, or move it aside with --overwrite"
            raise UsageError(f"run directory {run_dir}: {there[0]} there is no run's, and would be replaced; {how}")

    def prepare(
        self,
        run_dir: Path,
        *,
        replay: bool,
        settings: str = "",
        load: Callable[[Path], dict[str, Any]] | None = None,
        every: bool = False,
    ) -> tuple[Survey, list[str]]:
        """Decide what to go on from in a directory whose locks this process holds; return it, and lines to say.

        Nothing is changed but what `resume_from` and `overwrite` ask for, and what a kill left half done. The
        arguments are those of `survey`.

        Raises:
            UsageError: a run is there that can't be gone on with.
            RunError: the directory can't be written.
        """
        self.check_free(run_dir)  # again: another process may have had the locks since
        notices = []
        try:
            if self.goes_on:
                settle_checkpoints(run_dir)
            if self.overwrite:
                notices.append(overwrite(run_dir))
            if self.resume_from is not None:
                notices.append(keep_from(run_dir, self.resume_from))
        except OSError as error:
            raise RunError(f"run directory {run_dir}: {reason(error)}") from error
        found = Survey(run_dir)
        if self.goes_on:
            found = survey(run_dir, replay=replay, records=True, settings=settings, load=load, every=every)
            found.check()
            try:
                notices += [_move_strays(run_dir), found.describe()]
            except OSError as error:
                raise RunError(f"run directory {run_dir}: {reason(error)}") from error
        return found, [line for line in notices if line]


def holds_run(run_dir: Path) -> bool:
    """True if a run has begun in a folder."""
    return has_run_id(run_dir) or any((run_dir / name).exists() for name in RECORDS) or bool(finished(run_dir))


def strays(run_dir: Path) -> list[str]:
    """What a run would replace or remove in a folder in which none has begun, by name: the user's."""
    if holds_run(run_dir):
        return []
    names = (*_REPLACED, *(f"videos/{film.name}" for film in (run_dir / "videos").glob("[0-9]*.gif")))
    return [name for name in names if (run_dir / name).is_file() and not (name == CONFIG and _is_written(run_dir))]


def _is_written(run_dir: Path) -> bool:
    """Whether config.toml is as the product wrote it, for a run that has not begun."""
    try:
        check_toml(read_text(run_dir / CONFIG, MAX_SETTINGS), CONFIG, needed=True)
    except (OSError, UnicodeDecodeError, CoopError):
        return False
    return True


def _move_strays(run_dir: Path) -> str:
    """Move the user's files aside that a run would replace; return a line that says so. Raises OSError."""
    if not (there := strays(run_dir)):
        return ""
    to = aside_folder(run_dir)
    move_aside(run_dir, there, to)
    return f"{', '.join(there)} of {run_dir}, which no run had written, is in {to}"


def go_back(found: Survey, number: int | None) -> str:
    """Prepare a run directory for going on from checkpoint `number` (None: beginning); return what was done.

    Checkpoints begun only are deleted; younger ones are moved aside, and so are copies of the records, where the run
    falls back. A run that starts over leaves its records aside.

    Raises:
        OSError: the directory can't be written.
    """
    run_dir = found.run_dir
    for begun in found.unfinished:
        if (checkpoint_path(run_dir, begun) / WRITING).exists():
            remove(checkpoint_path(run_dir, begun))
    younger = [each for each in checkpoint_numbers(run_dir, LEARNER) if number is None or each > number]
    started = [name for name in _STARTED if number is None and (run_dir / name).exists()]
    if not younger and not (started and _has_lines(run_dir)):
        return ""
    to = aside_folder(run_dir)
    if number is not None:
        for name in RECORDS:
            if (run_dir / name).exists():
                shutil.copy2(run_dir / name, to / name)
    else:
        move_aside(run_dir, started, to)
    move_aside(run_dir, [f"{FOLDER}/{each}" for each in younger], to)
    return f"what {'was there' if number is None else 'is younger'} is in {to}"


def keep_from(run_dir: Path, number: int) -> str:
    """Go back to checkpoint `number` although younger ones are whole, or records of it are damaged.

    The younger ones are moved aside, and copies of the records; damaged records are sealed as they are.

    Returns a line that says what was done.

    Raises:
        UsageError: there is no such checkpoint, or its own files are damaged.
        OSError: the directory can't be written.
    """
    there = checkpoint_numbers(run_dir, LEARNER)
    if number not in there:
        held = ", ".join(map(str, there)) or "none"
        raise UsageError(f"--resume-from {number}: no such checkpoint in {run_dir}; there: {held}")
    path, problems = checkpoint_path(run_dir, number), []
    try:
        manifest = check_part(path, number, _owner(run_dir))
    except Damaged as damaged:
        raise UsageError(f"--resume-from {number}: {damaged}; nothing was changed") from damaged
    for name, written in manifest.records.items():
        try:
            check_record(run_dir / name, written)
        except Damaged as damaged:
            problems.append(str(damaged))
    moved = go_back(Survey(run_dir), number)
    if problems:
        to = aside_folder(run_dir)
        kept = {}
        for name, written in manifest.records.items():
            record = run_dir / name
            record.touch()
            shutil.copy2(record, to / name)
            lines = read_bytes(record)[: written.size]
            truncate(record, lines.rfind(b"\n") + 1)
            kept[name] = measure(record)
        fallback = f"checkpoint {number}: {'; '.join(problems)}"
        fallbacks = [*manifest.fallbacks, fallback]
        write_manifest(path, msgspec.structs.replace(manifest, records=kept, fallbacks=fallbacks))
    return "; ".join(filter(None, [f"goes back to checkpoint {number}", *problems, moved]))


def overwrite(run_dir: Path) -> str:
    """Move the run in a directory aside, so that another may begin; return a line that says so. Raises OSError."""
    if not holds_run(run_dir):
        return _move_strays(run_dir)
    there = [name for name in LEFT if (run_dir / name).exists()]
    to = aside_folder(run_dir)
    move_aside(run_dir, there, to)
    return f"the run that was in {run_dir} is in {to}"


def _owner(run_dir: Path) -> int | None:
    try:
        return read_run_id(run_dir) if has_run_id(run_dir) else None
    except RunError:
        return -1  # an id that no run has: every checkpoint is another run's


def _check_replay(path: Path, number: int, run_id: int) -> None:
    try:
        check_part(path / REPLAY, number, run_id)
    except Damaged as damaged:
        raise Damaged(
            f"{REPLAY}/: {damaged}" if str(damaged).startswith("not ") else f"{REPLAY}/{damaged}"
        ) from damaged


def _loaded(path: Path, load: Callable[[Path], dict[str, Any]]) -> dict[str, Any]:
    try:
        return load(path)
    except Exception as error:
        raise Damaged(f"{LEARNER}: {reason(error)}") from error


def _has_lines(run_dir: Path) -> bool:
    """Whether a run that has begun has recorded something."""
    for name in RECORDS:
        with suppress(OSError), (run_dir / name).open("rb") as file:
            if name.endswith(".csv"):
                file.readline(MAX_SETTINGS)
            if file.read(1):
                return True
    return False
