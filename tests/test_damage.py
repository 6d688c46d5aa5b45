"""Damaged runs: what is wrong is said, nothing is made worse, and what is whole goes on.

The tests of whole commands share one run; each works on a copy.
"""

import json
import os
import re
import shutil
import subprocess
import tracemalloc
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest
from commands import run_command
from samples import make_segment
from test_checkpoints import CONFIG, save, save_learner
from test_journal import _insert, _use

import coop
from coop.common.errors import RunError, UsageError
from coop.common.process.files import FileDigest, measure, sealed, unsealed
from coop.common.types import EnvSpec
from coop.evaluation.evaluate import evaluate_checkpoint
from coop.evaluation.export import export
from coop.lockstep.run import LockstepRun
from coop.records import checkpoints, resumption
from coop.records.checkpoints import DONE, WRITING, Manifest, checkpoint_numbers, write_manifest
from coop.records.curve import learning_curve
from coop.records.growing import GrowingTable
from coop.records.locks import _place
from coop.records.reading import read_csv, read_jsonl, read_lines, read_run_config
from coop.records.resumption import Start, survey
from coop.replay.core import ReplayCore, RetryLater
from coop.replay.persistence.checkpoints import ReplayCheckpoints
from coop.replay.persistence.journal import HEADER_BYTES, SEGMENT, Header, Journal
from coop.replay.persistence.journal import _packed as packed_header
from coop.replay.persistence.recovery import recover
from coop.studies.report.packed import PackedStudy
from coop.studies.report.packing import pack
from coop.studies.report.study import load_study
from coop.studies.report.writer import draw_curves
from coop.studies.sweep.folder import CellFolder
from coop.studies.sweep.grid import load_grid

pytestmark = pytest.mark.timeout(300)  # whole commands, also on a busy machine

SHORT = ("--total-steps", "260", "--replay.capacity", "100", "--replay.learning-starts", "40", "--network.hidden", "8")
AHEAD = replace(CONFIG, replay=replace(CONFIG.replay, tolerance=1000.0))  # inserts need no draws
ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished lockstep run with checkpoints 200 and 220."""
    path = tmp_path_factory.mktemp("made") / "run"
    run_command("coop-lockstep", *SHORT, "--checkpoint-every", "100", "--run-dir", path, check=True)
    assert checkpoint_numbers(path) == [200, 220]
    return path


@pytest.fixture
def run(made: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(made, tmp_path / "run"))


def flip(path: Path, place: int = -1) -> None:
    """Change a bit; place: of the byte, the middle one by default."""
    data = bytearray(path.read_bytes())
    data[place if place >= 0 else len(data) // 2] ^= 1
    path.write_bytes(data)


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def resume(run: Path, *flags: str) -> subprocess.CompletedProcess[str]:
    return run_command("coop-lockstep", "--resume", "--run-dir", run, *flags)


def lose(run: Path, what: str) -> None:
    """Make every checkpoint of a run that was killed unreadable in one way."""
    for role in ("learner", "replay"):
        with (run / f".{role}.lock").open("r+b") as lock:
            lock.write(f"coop-lockstep on this host (pid 7)\n{'0' * 32}\n{_place(lock.fileno())}\n".encode())
    for folder in (run / "checkpoints").iterdir():
        match what:
            case "bit":
                flip(folder / "learner.pt")
            case "version":
                (folder / DONE).write_bytes(sealed(json.dumps({"format": 1}).encode()))
            case "done":
                (folder / DONE).unlink()
            case "table":
                shutil.rmtree(folder / "replay")
            case "state":
                (folder / "learner.pt").write_bytes(b"not a state, but sealed")
                manifest = checkpoints.read_manifest(folder)
                files = {"learner.pt": measure(folder / "learner.pt")}
                write_manifest(folder, Manifest(manifest.run, manifest.number, files, manifest.records))


@pytest.mark.parametrize("what", ["bit", "version", "done", "table", "state"])
@pytest.mark.parametrize("command", ["coop-lockstep", "coop-learner", "coop-local"])
def test_a_run_without_a_readable_checkpoint_is_refused_and_stays_as_it_is(what: str, command: str, run: Path) -> None:
    if command == "coop-learner" and what == "table":
        pytest.skip("its table is elsewhere")
    if command == "coop-local" and what == "state":
        pytest.skip("its learner refuses it, as only that has PyTorch")
    lose(run, what)
    before = contents(run)
    done = run_command(command, "--resume", "--run-dir", run, "--total-steps", "900")
    assert done.returncode == 2, done.stdout
    assert done.stderr.count("\n") == 1
    assert "checkpoint 200: " in done.stderr
    assert "checkpoint 220: " in done.stderr
    assert contents(run) == before, "down to the name of the lock's last holder"


def test_python_refuses_as_the_commands_do(run: Path) -> None:
    lose(run, "bit")
    before = contents(run)
    for distributed in (False, True):
        with pytest.raises(UsageError, match="no checkpoint can be gone on from"):
            coop.train(run_dir=run, resume=True, distributed=distributed)
    with pytest.raises(UsageError, match=r"has no complete checkpoint: checkpoint 200: learner\.pt: wrong checksum"):
        coop.load(run).policy()
    assert contents(run) == before


def test_a_run_of_another_account_is_refused(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever the operating system answers: EACCES of a permission, EIO of a disk or of a network file system."""

    def fails(path: Path, size: int | None = None) -> FileDigest:
        raise OSError(5, os.strerror(5), str(path))

    monkeypatch.setattr(checkpoints, "measure", fails)
    with pytest.raises(UsageError, match=r"checkpoint 220: learner.pt: Input/output error"):
        resumption.Start(resume=True).prepare(run, replay=True)


def test_a_fallback_is_said_everywhere_and_younger_ones_are_kept_aside(run: Path) -> None:
    newest = run / "checkpoints" / "220"
    flip(newest / "replay" / "frames.npy")
    damaged = contents(newest)
    done = resume(run, "--total-steps", "300")
    assert done.returncode == 0, done.stderr
    why = "checkpoint 220: replay/frames.npy: wrong checksum"
    assert done.stdout.startswith(f"resuming from checkpoint 200; passes over {why}\n")
    assert json.loads((run / "summary.json").read_text())["fallbacks"] == [why]
    (aside,) = (run / "aside").iterdir()
    assert contents(aside / "checkpoints" / "220") == damaged
    assert (aside / "episodes.csv").exists(), "as it was, for what it says of the steps that were lost"
    assert load_study(run.parent).warnings == [f"run: went on from an older checkpoint: {why}"]
    resume(run, "--total-steps", "320")
    assert json.loads((run / "summary.json").read_text())["fallbacks"] == [why], "the run keeps it in mind"


def test_readers_of_networks_take_the_older_one_and_say_so(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (run / "checkpoints" / "220" / "learner.pt").unlink()
    warning = (
        f"warning: {run}: takes checkpoint 200; passes over checkpoint 220: learner.pt: No such file or directory\n"
    )
    assert next(evaluate_checkpoint(run, 1, 0)).checkpoint == 200
    assert capsys.readouterr().err == warning
    assert export(run, tmp_path / "out").checkpoint == 200
    assert capsys.readouterr().err == warning
    assert coop.load(run).checkpoint().number == 200
    assert capsys.readouterr().err == warning


@pytest.mark.parametrize("other", ["best", "0220", "٣", "-1", "2.5", "1000"])
def test_folders_of_the_user_among_the_checkpoints_are_the_users(other: str, run: Path) -> None:
    mine = run / "checkpoints" / other
    mine.mkdir()
    (mine / "figure.txt").write_text("mine")
    if other == "best":
        shutil.copytree(run / "checkpoints" / "220", mine, dirs_exist_ok=True)
    before = contents(mine)
    done = resume(run, "--total-steps", "500", "--checkpoint-every", "50")
    assert done.returncode == 0, done.stderr
    assert contents(mine) == before
    assert next(evaluate_checkpoint(run, 1, 0)).checkpoint == 460


def test_a_file_of_the_user_in_an_old_checkpoint_outlives_it(tmp_path: Path) -> None:
    for number in (100, 200, 300, 400):
        save_learner(tmp_path, number, {})
        (tmp_path / "checkpoints" / str(number) / "notes.txt").write_text("mine")
    assert checkpoint_numbers(tmp_path) == [100, 200, 300, 400]
    assert checkpoint_numbers(tmp_path, "learner.pt") == checkpoint_numbers(tmp_path, DONE) == [300, 400]
    assert contents(tmp_path / "checkpoints" / "100") == {"notes.txt": b"mine"}


def test_a_replay_service_lists_only_its_own_parts(spec: EnvSpec, tmp_path: Path) -> None:
    journal = Journal(tmp_path / "journal", 5, 1, keep=False)
    core, checkpoints = ReplayCore(CONFIG, spec, journal), ReplayCheckpoints(tmp_path, 5, journal)
    mine = tmp_path / "checkpoints" / "best" / "replay"
    mine.mkdir(parents=True)
    (tmp_path / "journal" / "notes.log").write_text("mine")
    for number in (10, 20, 30):
        core.insert(make_segment(spec, number))
        save(core, checkpoints, number, number - 10)
    assert checkpoints.intact() == [20, 30]
    assert mine.exists()
    assert (tmp_path / "journal" / "notes.log").read_text() == "mine"


def test_a_link_and_a_foreign_record_name_are_not_followed(run: Path, tmp_path: Path) -> None:
    outside = tmp_path / "outside.csv"
    outside.write_text("not of this run")
    for number in (200, 220):
        folder = run / "checkpoints" / str(number)
        manifest = checkpoints.read_manifest(folder)
        records = {"../outside.csv": FileDigest(0, 0)}
        write_manifest(folder, Manifest(manifest.run, number, manifest.files, records))
    done = resume(run, "--total-steps", "300")
    assert done.returncode == 2
    assert "names '../outside.csv', which is no record of a run" in done.stderr
    assert outside.read_text() == "not of this run"


def test_shorter_records_cost_a_checkpoint_or_are_accepted_by_name(run: Path) -> None:
    sizes = {
        n: checkpoints.read_manifest(run / "checkpoints" / n).records["metrics.jsonl"].size for n in ("200", "220")
    }
    metrics = run / "metrics.jsonl"
    os.truncate(metrics, sizes["220"] - 1)
    if sizes["200"] < sizes["220"]:
        done = resume(Path(shutil.copytree(run, run.with_name("other"))), "--total-steps", "300")
        assert "resuming from checkpoint 200; passes over checkpoint 220: metrics.jsonl: has" in done.stdout
    os.truncate(metrics, 10)
    before = contents(run)
    done = resume(run, "--total-steps", "300")
    assert done.returncode == 2
    assert f"metrics.jsonl: has 10 bytes, and should have at least {sizes['220']:,}" in done.stderr
    assert "--resume-from 220 goes on with what is left" in done.stderr
    assert contents(run) == before
    done = run_command("coop-lockstep", "--resume-from", "220", "--run-dir", run, "--total-steps", "300")
    assert done.returncode == 0, done.stderr
    assert "goes back to checkpoint 220; metrics.jsonl: has 10 bytes" in done.stdout
    assert (
        "checkpoint 220: metrics.jsonl: has 10 bytes" in json.loads((run / "summary.json").read_text())["fallbacks"][0]
    )


def test_resume_from_an_older_checkpoint_keeps_the_younger_aside(made: Path, run: Path) -> None:
    done = run_command("coop-lockstep", "--resume-from", "200", "--run-dir", run)
    assert done.returncode == 0, done.stderr
    assert (run / "episodes.csv").read_bytes() == (made / "episodes.csv").read_bytes(), "the same steps again"
    (aside,) = (run / "aside").iterdir()
    assert contents(aside / "checkpoints" / "220") == contents(made / "checkpoints" / "220")
    done = run_command("coop-lockstep", "--resume-from", "7", "--run-dir", run)
    assert done.returncode == 2
    assert f"--resume-from 7: no such checkpoint in {run}; there: 200, 220" in done.stderr


def test_overwriting_moves_the_run_aside(run: Path) -> None:
    before = {name: data for name, data in contents(run).items() if not name.endswith(".lock")}
    (run / "notes.txt").write_text("mine")
    refused = run_command("coop-lockstep", *SHORT, "--run-dir", run)
    assert (refused.returncode, "--overwrite" in refused.stderr) == (2, True)
    done = run_command("coop-lockstep", *SHORT, "--seed", "3", "--overwrite", "--run-dir", run)
    assert done.returncode == 0, done.stderr
    (aside,) = (run / "aside").iterdir()
    assert done.stdout.startswith(f"the run that was in {run} is in {aside}\n")
    assert contents(aside) == before
    assert (run / "notes.txt").read_text() == "mine"
    assert json.loads((run / "summary.json").read_text())["seed"] == 3
    both = run_command("coop-lockstep", "--overwrite", "--resume", "--run-dir", run)
    assert (both.returncode, "give one of them" in both.stderr) == (2, True)


def test_a_run_that_another_process_has_played_meanwhile_is_left_alone(run: Path) -> None:
    """Between a command's first look at a folder and its lock on it."""
    before = contents(run)
    with pytest.raises(UsageError, match="holds a run already"):
        LockstepRun(read_run_config(run), run, "test", Start(), log="none")
    assert contents(run) == before


def test_overwriting_leaves_a_folder_without_a_run_as_it_is(tmp_path: Path) -> None:
    for name in ("videos", "logs"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "mine.txt").write_text("mine")
    before = contents(tmp_path)
    assert resumption.overwrite(tmp_path) == ""
    assert contents(tmp_path) == before


def test_files_of_the_user_are_not_replaced_by_a_run(run: Path, tmp_path: Path) -> None:
    there, written = tmp_path / "mine", (run / "config.toml").read_text()
    mine = {name: f"mine: {name}".encode() for name in ("summary.json", "evaluations.csv", "learning_curve.png")}
    mine |= {"roster.json": b"{}", "videos/100.gif": b"GIF", "config.toml": b"# a note\nmethod = 'dqn'\n"}
    (there / "videos").mkdir(parents=True)
    for name, data in mine.items():
        (there / name).write_bytes(data)
        with pytest.raises(UsageError, match=rf"{name} there is no run's, and would be replaced; .*--overwrite"):
            Start().check_free(there)
        (there / name).unlink()
    (there / "config.toml").write_text(written)  # of a run that is about to begin
    Start().check_free(there)
    for name, data in mine.items():
        (there / name).write_bytes(data)
    refused = run_command("coop-lockstep", "--config", there / "config.toml", "--run-dir", there)
    assert (refused.returncode, refused.stderr.count("\n"), "config.toml there" in refused.stderr) == (2, 1, True)
    assert contents(there) == mine
    (there / "summary.json").unlink()
    for start in (Start(overwrite=True), Start(resume=True)):
        _, (line, *_) = start.prepare(there, replay=False)
        (aside,) = (there / "aside").iterdir()
        assert line.startswith("config.toml, evaluations.csv, ")
        assert line.endswith(f"is in {aside}")
        assert contents(aside) == {name: data for name, data in mine.items() if name != "summary.json"}
        aside.rename(tmp_path / "moved")
        shutil.copytree(tmp_path / "moved", there, dirs_exist_ok=True)
        shutil.rmtree(tmp_path / "moved")


def test_a_run_killed_before_its_first_checkpoint_begins_again_with_its_records_aside(run: Path) -> None:
    (run / "summary.json").unlink()
    for folder in (run / "checkpoints").iterdir():
        (folder / DONE).unlink()
        (folder / WRITING).touch()
    records = (run / "episodes.csv").read_bytes()
    done = resume(run)
    assert done.stdout.startswith(f"starts in {run}: the run there has no checkpoint yet\n"), done.stderr
    (aside,) = (run / "aside").iterdir()
    assert (aside / "episodes.csv").read_bytes() == records
    assert (run / "episodes.csv").read_bytes() == records, "the same seed"


def test_a_run_whose_checkpoints_are_gone_is_not_begun_again(run: Path) -> None:
    shutil.rmtree(run / "checkpoints")
    before = contents(run)
    done = resume(run)
    assert (done.returncode, "220 updates, but no checkpoint to go on from" in done.stderr) == (2, True)
    assert contents(run) == before


@pytest.mark.parametrize("file", ["config.toml", "run-id"])
def test_a_config_or_an_id_that_was_not_written_by_the_run(file: str, run: Path) -> None:
    path = run / file
    if file == "config.toml":
        path.write_text(path.read_text().replace("gamma = 0.95", "gamma = 0.94"))
    else:
        path.write_text("6\n")
    before = contents(run)
    for command, flags in (("coop-lockstep", ("--resume", "--run-dir", run)), ("coop-eval", (run, "--episodes", "1"))):
        done = run_command(command, *flags)
        assert (done.returncode, done.stderr.count("\n")) == (2, 1), done.stderr
        assert "not what was written" in done.stderr or "belongs to another run" in done.stderr
    assert contents(run) == before
    (run / "config.toml").unlink()
    done = resume(run)
    assert (done.returncode, "its config.toml is missing" in done.stderr) == (2, True)


def test_a_checkpoint_is_whole_on_the_disk_before_its_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Files, then folders, then DONE: in the order of the calls to the operating system."""
    calls: list[str] = []
    fsync, rename = os.fsync, Path.replace

    def synced(descriptor: int) -> None:
        calls.append(f"sync {Path(f'/proc/self/fd/{descriptor}').readlink().relative_to(tmp_path)}")
        fsync(descriptor)

    def renamed(path: Path, target: Path) -> Path:
        calls.append(f"name {target.relative_to(tmp_path)}")
        return rename(path, target)

    for name in checkpoints.RECORDS:
        (tmp_path / name).write_text("a line\n")
    monkeypatch.setattr(os, "fsync", synced)
    monkeypatch.setattr(Path, "replace", renamed)
    from coop.records.learner_checkpoints import saving_checkpoint  # noqa: PLC0415 (with what is patched)

    records = {name: measure(tmp_path / name) for name in checkpoints.RECORDS}
    with saving_checkpoint(tmp_path, 5, 100, {"a": 1}, records=records):
        calls.append("replay")
    order = [calls.index(each) for each in ("name checkpoints/100/learner.pt", "replay", "sync episodes.csv")]
    done = calls.index("name checkpoints/100/DONE")
    for place, name in ((place, call.removeprefix("name ")) for place, call in enumerate(calls) if call[:4] == "name"):
        assert calls[place - 1].startswith(f"sync {name}."), "its content, under another name"
        assert calls[place + 1] == f"sync {Path(name).parent}"
    assert order == sorted(order)
    assert calls.index("sync checkpoints/100") < order[0], "the mark of what has only been begun"
    assert calls.index("sync checkpoints") < done, "the folder that names the checkpoint's"
    last = len(calls) - calls[::-1].index("sync .")
    assert max(order) < calls.index("sync metrics.jsonl") < last <= done
    assert calls[done + 1] == "sync checkpoints/100"
    (tmp_path / "metrics.jsonl").write_text("")
    ahead = saving_checkpoint(tmp_path, 5, 200, {}, records=records)
    with pytest.raises(OSError, match=r"metrics\.jsonl: lines wait for space"), ahead:
        pass


def test_a_run_over_processes_goes_on_from_the_checkpoint_that_both_hold(tmp_path: Path) -> None:
    path = tmp_path / "run"
    flags = ("--actors", "1", "--run-dir", path)
    run_command("coop-local", *flags, *SHORT, "--checkpoint-every", "100", "--replay.journal", check=True)
    older, newest = checkpoint_numbers(path)
    flip(path / "checkpoints" / str(newest) / "replay" / "actions.npy")
    damaged = contents(path / "checkpoints" / str(newest))
    done = run_command("coop-local", *flags, "--resume", "--total-steps", "300")
    assert done.returncode == 0, done.stderr
    why = f"passes over checkpoint {newest}: replay/actions.npy: wrong checksum\n"
    assert done.stdout.startswith(f"resuming from checkpoint {older}; {why}")
    summary = json.loads((path / "summary.json").read_text())
    assert (summary["exit"], summary["transitions_lost"]) == ("complete", 0)
    assert summary["fallbacks"] == [f"checkpoint {newest}: the replay service has no whole part of it"]
    (aside,) = (path / "aside").iterdir()
    assert contents(aside / "checkpoints" / str(newest)) == damaged


CELL = 'preset = "cartpole"\nmethods = ["dqn"]\nseeds = [0]\n[fixed]\ntotal_steps = 260\n'


@pytest.mark.parametrize("what", ["empty summary", "bit of the summary", "empty records", "shorter records"])
def test_a_cell_is_finished_when_its_files_are(what: str, run: Path, tmp_path: Path) -> None:
    (tmp_path / "grid.toml").write_text(CELL)
    (cell,) = load_grid(str(tmp_path / "grid.toml")).cells
    folder = CellFolder(tmp_path, cell)
    run.rename(folder.path)
    ending = folder.ending()
    assert ending is not None
    assert ending.kind == "finished"
    summary, metrics = folder.path / "summary.json", folder.path / "episodes.csv"
    match what:
        case "empty summary":
            summary.write_text("")
        case "bit of the summary":
            summary.write_text(summary.read_text().replace('"episodes": 1', '"episodes": 2'))
        case "empty records":
            metrics.write_text("")
        case "shorter records":
            os.truncate(metrics, metrics.stat().st_size - 1)
    assert folder.ending() is None


def _journal(spec: EnvSpec, folder: Path) -> tuple[ReplayCore, list[int]]:
    """A core with a journal of six segments; the offsets at which their records begin."""
    core, at = ReplayCore(AHEAD, spec, Journal(folder, 5, 1, keep=False)), []
    for sequence in range(6):
        at.append((folder / "00000001.log").stat().st_size)
        assert not isinstance(_insert(core, spec, sequence), RetryLater)
    return core, at


@pytest.mark.parametrize(
    ("place", "words", "lost"),
    [
        (HEADER_BYTES + 40, r"record 3 at byte [\d,]+, a segment, is damaged", 4),
        (12, r"record 3 before byte [\d,]+ can't be read", 4),  # of the header
        (0, "", 0),  # only the mark, by which a record is found
    ],
)
def test_a_damaged_record_costs_only_itself_and_is_counted(
    place: int, words: str, lost: int, spec: EnvSpec, tmp_path: Path
) -> None:
    _, at = _journal(spec, tmp_path)
    flip(tmp_path / "00000001.log", at[2] + place)
    before = contents(tmp_path)
    twin = ReplayCore(AHEAD, spec)
    number, notices = recover(twin, tmp_path, 1, 5)
    assert number == 2
    assert (twin.table.inserted, twin.lost) == (24 - lost, lost)
    if lost:
        assert pytest.importorskip("re").search(words, notices[1]), notices
        assert "the journal lacks 4 transitions that had been acknowledged" in notices[2]
    assert contents(tmp_path) == before, "reading changes nothing"
    twin.recorder = Journal(tmp_path, 5, number, keep=False, accepted=twin.table.inserted)
    assert not isinstance(_insert(twin, spec, 6), RetryLater)
    third = ReplayCore(AHEAD, spec)
    recover(third, tmp_path, 1, 5)
    assert (third.table.inserted, third.lost) == (28 - lost, lost), "the same loss, once"


@pytest.mark.parametrize(("sync", "lost"), [(False, 4), (True, 0)])
def test_what_was_never_flushed_was_not_acknowledged(spec: EnvSpec, tmp_path: Path, sync: bool, lost: int) -> None:
    """The machine's death may leave a torn record at a journal's end; also where the next process has begun a file."""
    _, at = _journal(spec, tmp_path)
    flip(tmp_path / "00000001.log", at[-1] + HEADER_BYTES + 40)
    for _ in range(2):
        twin = ReplayCore(AHEAD, spec)
        number, notices = recover(twin, tmp_path, 1, 5, sync=sync)
        assert (twin.table.inserted, twin.lost) == (20, lost)
        assert ("had been acknowledged" in notices[-1]) == (lost > 0)
        Journal(tmp_path, 5, number, keep=False, sync=sync, accepted=20).close()


@pytest.mark.parametrize("length", [1 << 40, (1 << 28) + 1])
def test_a_record_is_no_longer_than_a_message(length: int, spec: EnvSpec, tmp_path: Path) -> None:
    """Whatever its header declares, and however much of nothing the file holds."""
    path = tmp_path / "00000001.log"
    _, at = _journal(spec, tmp_path)
    header = Header(0, SEGMENT, 1, 3, 12, length)
    with path.open("r+b") as file:
        file.seek(at[2])
        file.write(packed_header(header))
        file.truncate(1 << 41)
    tracemalloc.start()
    twin = ReplayCore(AHEAD, spec)
    _, notices = recover(twin, tmp_path, 1, 5)
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert (twin.table.inserted, twin.lost) == (20, 4)
    assert f"record 3 at byte {at[2]:,}, a segment, is damaged" in notices[1]
    assert most < 1 << 25


def test_a_page_of_zeros_costs_what_it_covers(spec: EnvSpec, tmp_path: Path) -> None:
    _, at = _journal(spec, tmp_path)
    data = bytearray((tmp_path / "00000001.log").read_bytes())
    data[at[1] + 10 : at[3] + 10] = bytes(at[3] - at[1])
    (tmp_path / "00000001.log").write_bytes(data)
    twin = ReplayCore(AHEAD, spec)
    _, notices = recover(twin, tmp_path, 1, 5)
    assert (twin.table.inserted, twin.lost) == (12, 12)
    assert "records 2 to 4 before byte" in notices[1]


def test_draws_of_what_is_lost_are_passed_over(spec: EnvSpec, tmp_path: Path) -> None:
    core = ReplayCore(CONFIG, spec, Journal(tmp_path, 5, 1, keep=False))
    _use(core, spec, range(9))
    content = (tmp_path / "00000001.log").read_bytes()
    for part in (3, 1):  # a third, and all but the last record
        end = len(content) // part - (HEADER_BYTES + 200 if part == 1 else 0)
        (tmp_path / "00000001.log").write_bytes(content[:100] + bytes(end - 100) + content[end:])
        twin = ReplayCore(CONFIG, spec)
        recover(twin, tmp_path, 1, 5)
        assert twin.table.inserted + twin.lost == core.table.inserted
        assert twin.lost > 0
        assert twin.drawn == core.drawn


def test_a_missing_file_and_the_end_of_a_file_are_counted(spec: EnvSpec, tmp_path: Path) -> None:
    journal = Journal(tmp_path, 5, 1, keep=True)
    core = ReplayCore(AHEAD, spec, journal)
    for sequence in range(6):
        _insert(core, spec, sequence)
        journal.roll()
    (tmp_path / "00000003.log").unlink()
    os.truncate(tmp_path / "00000005.log", (tmp_path / "00000005.log").stat().st_size - HEADER_BYTES - 10)
    twin = ReplayCore(AHEAD, spec)
    _, notices = recover(twin, tmp_path, 1, 5)
    assert (twin.table.inserted, twin.lost) == (16, 8)
    assert "file 3 is missing" in notices[1]


def test_a_journal_of_which_nothing_is_left_behind_a_checkpoint_is_said(spec: EnvSpec, tmp_path: Path) -> None:
    folder = tmp_path / "journal"
    journal = Journal(folder, 5, 1, keep=False)
    core = ReplayCore(AHEAD, spec, journal)
    for sequence in range(2):
        _insert(core, spec, sequence)
    save(core, ReplayCheckpoints(tmp_path, 5, journal), 1)
    for sequence in range(2, 4):
        _insert(core, spec, sequence)
    journal.close()
    shutil.rmtree(folder)
    twin = ReplayCore(AHEAD, spec)
    first, _ = ReplayCheckpoints(tmp_path, 5).restore(twin, 1)
    number, notices = recover(twin, folder, first, 5)
    assert number == first == 2
    assert notices[1:] == [
        f"{folder}: file 2 is missing, and so is all that followed; the journal is read on behind it"
    ]
    fresh = recover(ReplayCore(AHEAD, spec), folder, 1, 5)
    assert fresh == (1, ["0 transitions and 0 batches from the journal"]), "of a run that begins"


def test_a_kill_is_no_damage(spec: EnvSpec, tmp_path: Path) -> None:
    """It leaves a payload without its header, or less."""
    _, at = _journal(spec, tmp_path)
    content = (tmp_path / "00000001.log").read_bytes()
    without_header = content[: at[5]] + bytes(HEADER_BYTES) + content[at[5] + HEADER_BYTES :]
    for left in (without_header, without_header[:-1], without_header[: at[5] + 1], content[: at[5]]):
        (tmp_path / "00000001.log").write_bytes(left)
        twin = ReplayCore(AHEAD, spec)
        _, notices = recover(twin, tmp_path, 1, 5)
        assert (twin.table.inserted, twin.lost, len(notices)) == (20, 0, 1)
        assert notices[0].endswith("which ends as a kill leaves it")


def test_a_kill_within_a_record_leaves_none(spec: EnvSpec, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    core, _ = _journal(spec, tmp_path)
    write, written = os.pwrite, 0

    def killed(*arguments: Any) -> int:
        nonlocal written
        written += 1
        if written == 2:
            raise KeyboardInterrupt
        return write(*arguments)

    monkeypatch.setattr(os, "pwrite", killed)
    with pytest.raises(KeyboardInterrupt):
        _insert(core, spec, 6)
    twin = ReplayCore(AHEAD, spec)
    recover(twin, tmp_path, 1, 5)
    assert (twin.table.inserted, twin.lost) == (24, 0), "its actor sends the segment again"


@pytest.mark.parametrize(
    ("name", "damage", "words"),
    [
        ("episodes.csv", lambda data: data[:-3], "episodes.csv: line 14, the last one, is incomplete, and left out"),
        ("metrics.jsonl", lambda data: data[:-3], "metrics.jsonl: line 1, the last one, is incomplete, and left out"),
        (
            "episodes.csv",
            lambda data: data.replace(b"\n3,", b"\n3", 1),
            "line 5: 11 values instead of 12",
        ),
        ("metrics.jsonl", lambda data: data.replace(b":", b";", 1), "metrics.jsonl, line 1: not JSON"),
        ("episodes.csv", lambda data: data.replace(b"\n4,", b"\n\xff,", 1), "episodes.csv, line 6: not text"),
    ],
)
def test_lines_that_cannot_be_read_are_named(
    name: str, damage: Callable[[bytes], bytes], words: str, run: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = run / name
    path.write_bytes(damage(path.read_bytes()))
    try:
        read_csv(path) if name.endswith("csv") else read_jsonl(path)
        message = capsys.readouterr().err
    except RunError as error:
        message = str(error)
    assert words in message
    with pytest.raises(RunError, match=name.replace(".", r"\.")):
        load_study(run.parent)
    with pytest.raises(RunError, match=name.replace(".", r"\.")):
        _ = coop.load(run).episodes


@pytest.mark.parametrize(
    ("text", "line"), [(b"3\r3", "new-line character"), (b"9" * 140_000, "field larger"), (b"3\0", "holds a NUL byte")]
)
def test_records_without_a_seal_are_refused_by_their_line(text: bytes, line: str, run: Path, tmp_path: Path) -> None:
    """Without a summary and checkpoints, nothing but the line itself says that it is damaged."""
    path = run / "episodes.csv"
    (run / "summary.json").unlink()
    shutil.rmtree(run / "checkpoints")
    path.write_bytes(path.read_bytes().replace(b"\n4,", b"\n" + text + b",", 1))
    reads: tuple[Callable[[], object], ...] = (
        lambda: coop.load(run).episodes,
        lambda: pack(run, tmp_path / "study.parquet"),
        lambda: draw_curves(run, tmp_path / "curves"),
        lambda: learning_curve(run, "a run"),
    )
    for read in reads:
        with pytest.raises(RunError, match=rf"episodes\.csv, line 6: (can't be read: )?{line}"):
            read()
    assert run_command("coop-watch", run, "--once").stderr.count("Traceback") == 0
    table = GrowingTable(path)
    assert [row["episode"] for row in table.rows()][:5] == ["0", "1", "2", "3", "3\0" if b"\0" in text else "5"]


def test_an_empty_record_has_no_rows(run: Path) -> None:
    (run / "summary.json").unlink()
    shutil.rmtree(run / "checkpoints")
    for text in ("", "half a line"):
        (run / "episodes.csv").write_text(text)
        assert coop.load(run).episodes.empty
        assert read_csv(run / "episodes.csv") == []


def test_a_digit_of_a_record_is_not_changed_in_silence(run: Path) -> None:
    path = run / "episodes.csv"
    rows = read_lines(path)
    path.write_text("\n".join([rows[0], rows[1].replace("0,", "1,", 1), *rows[2:]]) + "\n")
    for reads in (lambda: load_study(run.parent), lambda: coop.load(run).episodes):
        with pytest.raises(RunError, match=r"episodes\.csv: wrong checksum in its first"):
            reads()


def test_a_packed_study_has_checksums(run: Path, tmp_path: Path) -> None:
    packed = tmp_path / "study.parquet"
    pack(run.parent, packed)
    content = packed.read_bytes()
    for place in (len(content) // 3, len(content) // 2, len(content) - 60, len(content) - 2000):
        flip(packed, place)
        with pytest.raises(UsageError, match=r"study\.parquet"):
            PackedStudy(packed)
        packed.write_bytes(content)
    PackedStudy(packed)
    pq.write_table(pq.read_table(packed).replace_schema_metadata({}), packed)
    with pytest.raises(UsageError, match=r"study\.parquet: not a packed study: has no checksum"):
        PackedStudy(packed)


def test_a_small_sealed_file() -> None:
    assert unsealed(sealed(b"a\nb")) == b"a\nb"
    for damaged in (b"", b"a\nb", sealed(b"a\nb")[:-1], sealed(b"a\nb") + b"c", sealed(b"a\nb").replace(b"b", b"c", 1)):
        with pytest.raises(ValueError, match="wrong checksum"):
            unsealed(damaged)


def test_a_survey_stops_at_the_newest_whole_one(run: Path) -> None:
    flip(run / "checkpoints" / "200" / "learner.pt")
    assert survey(run).problems == {}
    assert set(survey(run, every=True).problems) == {200}


@pytest.mark.timeout(900)
def test_damage_on_purpose() -> None:
    """Some of the mutations of which docs/robustness.md tells: none silent, no traceback, no hang."""
    done = run_command(ROOT / "benchmarks" / "corrupt.py", "--mutations", "200", "--seed", "1", timeout=880)
    assert done.returncode == 0, done.stdout + done.stderr
    assert re.search(r"^200 mutations in \d+ s: 0 silent", done.stdout, re.MULTILINE)


def test_a_copy_of_a_run_is_no_further_run(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shutil.copytree(run, run.with_name("run-best"))
    assert [each.name for each in load_study(run.parent).runs] == ["run"]
    assert capsys.readouterr().err == f"warning: {run.with_name('run-best')}: a copy of run, left out\n"
