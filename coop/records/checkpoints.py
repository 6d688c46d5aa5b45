"""The checkpoints of a run on disk: their files and seals, for learner, replay service and all that read them.

`checkpoints/NUMBER/` holds `learner.pt`, the replay service's part `replay/`, and `DONE`, which is written last and
seals them: format, run, number, and size and checksum of each file. `replay/` has a `DONE` of its own, as it may lie on
another machine. The learner's also seals the run's records: how long they were, and the checksum of what they held.
`WRITING` marks a checkpoint that has been begun: without it and without `DONE`, something has been lost.

Only names that the product wrote are read or removed; others in these folders are the user's.
"""

from __future__ import annotations

import json
import os
import re
from contextlib import suppress
from pathlib import Path
from typing import Any

import msgspec

from coop.common.errors import RunError
from coop.common.process.files import (
    FileDigest,
    make_folder,
    measure,
    sealed,
    sync_file,
    sync_folder,
    unsealed,
    write_atomic,
)
from coop.common.process.untrusted import MAX_SETTINGS, read_bytes
from coop.records.summaries import SUMMARY, read_summary

FOLDER = "checkpoints"
LEARNER = "learner.pt"
REPLAY = "replay"
DONE = "DONE"
WRITING = "WRITING"
PART, OLD = ".part", ".old"  # behind a folder's name: not yet in its place, and no longer
KEPT = 2  # finished checkpoints
ASKED = "ASKED"  # in the folder of checkpoints: somebody waits for a new one
RECORDS = ("episodes.csv", "metrics.jsonl")
"""The records that a resumed run cuts back to the size that its checkpoint seals."""
EVALUATIONS = "evaluations.csv"
SWEEP = "sweep.toml"  # in the folder of a sweep
_NUMBER = re.compile(r"0|[1-9][0-9]{0,17}")
_FILE = re.compile(r"learner\.pt|state\.msgpack|[a-z][a-z_]*\.npy")  # what a checkpoint consists of
_OURS = re.compile(rf"({_FILE.pattern}|{DONE})(\.[0-9a-f]{{8}}\.part)?|{WRITING}")
FORMAT = 2


class Damaged(Exception):
    """A checkpoint, or a part of one, is not whole; the message says why."""


class Manifest(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What `DONE` seals.

    run, number: of the checkpoint. settings: checksum of those that a resumed run keeps. files, records: by name.
    fallbacks: where the run went on from an older checkpoint than its newest. journal: the first file of the journal
    that continues a replay service's part; 0 for others.
    """

    run: int
    number: int
    files: dict[str, FileDigest]
    records: dict[str, FileDigest] = msgspec.field(default_factory=dict)
    fallbacks: list[str] = msgspec.field(default_factory=list)
    journal: int = 0
    settings: str = ""


def checkpoint_path(run_dir: Path, number: int) -> Path:
    """The folder of a checkpoint."""
    return run_dir / FOLDER / str(number)


def checkpoint_numbers(run_dir: Path, part: str = "") -> list[int]:
    """Numbers of the checkpoints that a run directory has folders of, whole or not, in ascending order.

    part: only those with this file or folder.
    """
    try:
        with os.scandir(run_dir / FOLDER) as entries:
            there = [entry for entry in entries if _NUMBER.fullmatch(entry.name)]
            own = [entry for entry in there if entry.is_dir(follow_symlinks=False)]
    except OSError:
        return []
    return sorted(int(entry.name) for entry in own if not part or Path(entry.path, part).exists())


def ask(run_dir: Path) -> None:
    """Ask the run that works in a folder for a checkpoint; raises OSError."""
    make_folder(run_dir / FOLDER)
    os.close(os.open(run_dir / FOLDER / ASKED, os.O_RDONLY | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK, 0o666))


def take_request(run_dir: Path) -> bool:
    """Whether somebody has asked for a checkpoint since the last call."""
    try:
        (run_dir / FOLDER / ASKED).unlink()
    except OSError:
        return False
    return True


def write_manifest(folder: Path, manifest: Manifest) -> None:
    """Write `DONE`, once everything that it seals is on the disk; raises OSError."""
    write_atomic(folder / DONE, sealed(json.dumps({"format": FORMAT, **msgspec.to_builtins(manifest)}).encode()))


def read_manifest(folder: Path) -> Manifest:
    """Read `DONE`; raises Damaged."""
    try:
        tables = json.loads(unsealed(read_bytes(folder / DONE, MAX_SETTINGS)))
        version = tables.pop("format")
        if version != FORMAT:
            raise Damaged(f"{DONE}: written by another version, format {version}; this one reads {FORMAT}")
        manifest = msgspec.convert(tables, Manifest)
    except FileNotFoundError:
        raise Damaged("not finished" if (folder / WRITING).exists() else f"{DONE} is missing") from None
    except (OSError, RunError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise Damaged(f"{DONE}: {reason(error)}") from error
    if strange := [name for name in manifest.files if not _FILE.fullmatch(name)]:
        raise Damaged(f"{DONE}: names {strange[0]!r}, which is no file of a checkpoint")
    if strange := [name for name in manifest.records if name not in RECORDS]:
        raise Damaged(f"{DONE}: names {strange[0]!r}, which is no record of a run")
    return manifest


def check_part(folder: Path, number: int, run_id: int | None) -> Manifest:
    """Check a part of a checkpoint byte by byte. run_id: of its run, None if that is not known.

    Raises:
        Damaged: it is not whole, or belongs to another checkpoint or run.
    """
    manifest = read_manifest(folder)
    if manifest.number != number:
        raise Damaged(f"{DONE}: is that of checkpoint {manifest.number}")
    if run_id not in (None, manifest.run):
        raise Damaged(f"{DONE}: belongs to another run")
    for name, written in manifest.files.items():
        try:
            size = (folder / name).stat().st_size
            found = measure(folder / name, written.size)
        except OSError as error:
            raise Damaged(f"{name}: {reason(error)}") from error
        if size != written.size:
            raise Damaged(f"{name}: has {size:,} bytes instead of {written.size:,}")
        if found != written:
            raise Damaged(f"{name}: wrong checksum")
    return manifest


def check_record(path: Path, written: FileDigest) -> None:
    """Check the beginning of a record file that a checkpoint or a summary has sealed; raises Damaged."""
    try:
        found = measure(path, written.size)
    except OSError as error:
        raise Damaged(f"{path.name}: {reason(error)}") from error
    if found.size < written.size:
        raise Damaged(f"{path.name}: has {found.size:,} bytes, and should have at least {written.size:,}")
    if found != written:
        raise Damaged(f"{path.name}: wrong checksum in its first {written.size:,} bytes")


def checked_summary(run_dir: Path) -> dict[str, Any]:
    """A run's summary.json, after a check that the records are those it seals; empty if the run has not ended.

    Raises:
        RunError: the summary can't be read, or a record is shorter or another one than it says.
    """
    summary = read_summary(run_dir)
    for name, (size, checksum) in summary.get("records", {}).items():
        try:
            if name not in (*RECORDS, EVALUATIONS, "config.toml"):
                raise Damaged(f"{SUMMARY}: names {name!r}, which is no record of a run")
            check_record(run_dir / name, FileDigest(size, checksum))
        except Damaged as damaged:
            raise RunError(f"{run_dir}: can't be read as it was written: {damaged}") from damaged
    return summary


def begin(path: Path) -> None:
    """Create the folder of a checkpoint that is about to be written, marked as unfinished; raises OSError."""
    make_folder(path)
    (path / WRITING).touch()
    (path / DONE).unlink(missing_ok=True)
    sync_folder(path)


def finish(run_dir: Path, path: Path, manifest: Manifest) -> None:
    """Seal a checkpoint whose files are on the disk, after its records are too; raises OSError."""
    for name, written in manifest.records.items():
        if sync_file(run_dir / name) < written.size:
            raise OSError(f"{name}: lines wait for space")
    sync_folder(run_dir)
    write_manifest(path, manifest)
    (path / WRITING).unlink(missing_ok=True)


def remove_old(run_dir: Path, number: int) -> None:
    """Delete the checkpoints older than the `KEPT` newest finished ones up to `number`."""
    kept = [each for each in finished(run_dir) if each <= number][-KEPT:]
    for old in checkpoint_numbers(run_dir):
        if kept and old < kept[0]:
            remove(checkpoint_path(run_dir, old))


def remove(path: Path) -> None:
    """Delete a checkpoint, or the replay service's part of one, but nothing else that lies there."""
    with suppress(OSError):
        (path / WRITING).touch()  # a kill may leave a part of it
        for inner in (path / REPLAY, path / f"{REPLAY}{PART}", path / f"{REPLAY}{OLD}"):
            if inner.is_dir() and not inner.is_symlink():
                remove(inner)
        for file in sorted(path.iterdir(), key=lambda file: (file.name != DONE, file.name == WRITING)):
            if _OURS.fullmatch(file.name):
                file.unlink()
    with suppress(OSError):  # something else lies there
        path.rmdir()


def exchange(new: Path, path: Path) -> None:
    """Put a whole folder `NAME.part`, which is on the disk, in the place of a part that may be there; raises OSError.

    A kill leaves one of the two whole, where `settle` finds it.
    """
    old = _beside(path, OLD)
    remove(old)
    if path.exists():
        path.rename(old)
    new.rename(path)
    sync_folder(path.parent)
    remove(old)


def settle(path: Path, number: int) -> None:
    """Complete an `exchange` that was killed, for the process that owns the folder; raises OSError."""
    for each in (_beside(path, PART), _beside(path, OLD)):
        if not each.exists():
            continue
        with suppress(Damaged):
            if not path.exists() and check_part(each, number, None):
                each.rename(path)
                sync_folder(path.parent)
        remove(each)


def settle_checkpoints(run_dir: Path) -> None:
    """`settle` for all checkpoints of a run directory."""
    with suppress(FileNotFoundError), os.scandir(run_dir / FOLDER) as entries:
        names = {Path(entry.name).stem for entry in entries if Path(entry.name).suffix in (PART, OLD)}
        for name in sorted(filter(_NUMBER.fullmatch, names)):
            settle(run_dir / FOLDER / name, int(name))


def _beside(path: Path, ending: str) -> Path:
    return path.with_name(path.name + ending)


def finished(run_dir: Path) -> list[int]:
    """Numbers of the checkpoints with `DONE`, in ascending order."""
    return checkpoint_numbers(run_dir, DONE)


def reason(error: BaseException) -> str:
    """What has failed, in one line."""
    text = (error.strerror if isinstance(error, OSError) else "") or str(error) or type(error).__name__
    return text.splitlines()[0][:200]
