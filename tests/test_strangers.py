"""Runs, studies and checkpoints of somebody else are data: names, links, modules, and the memory that they ask for."""

import json
import os
import pickle
import re
import shutil
import sys
import tracemalloc
import zipfile
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import msgpack
import msgspec
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch
from commands import run_command

import coop
from coop.common.errors import RunError, UsageError
from coop.common.imports import hand_over, import_module, permit, remember
from coop.common.process import untrusted
from coop.common.process.files import LineFile, measure, write_atomic
from coop.common.process.untrusted import (
    MAX_SETTINGS,
    check_links,
    check_run_name,
    check_torch_file,
    load_array,
    page_sizes,
    read_bytes,
    refuse_links,
)
from coop.common.settings.fields import _read_table
from coop.common.settings.tables import load_tables, parse_run_config, sealed_toml
from coop.lockstep.reexecute import reexecute
from coop.records import parquet_seals
from coop.records.checkpoints import ASKED, ask, read_manifest, write_manifest
from coop.records.locks import RunLock
from coop.records.run_options import chosen_config
from coop.records.summaries import SUMMARY, read_summary, summary_text
from coop.studies.report import packed
from coop.studies.report.packed import PackedStudy
from coop.studies.report.packing import study_file
from coop.studies.report.sources import open_source
from coop.studies.sweep import slurm
from coop.studies.sweep.folder import CellFolder
from coop.studies.sweep.grid import GridFile, parse_grid
from coop.studies.tuning import Space

pytestmark = pytest.mark.timeout(300)

BAD_NAMES = [
    "", ".", "..", "../out", "/abs", "a/b", "a\\b", "-rf", ".hidden", "a*", "a?", "a[0]", "a\nb", "a\x1b[2J",
    "a\u202eb", "a\u2028b", "x" * 101, "é" * 51, "\ud800",
]  # fmt: skip


@pytest.mark.parametrize("name", BAD_NAMES)
def test_names_that_are_none(name: str, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="run name"):
        check_run_name(name, "here")
    if "\ud800" in name:
        return
    table = pa.table({"run": ["good", name], "config.toml": ["", ""]})
    (tmp_path / "study.parquet").write_bytes(study_file(table))
    with pytest.raises(UsageError, match="run name"):
        PackedStudy(tmp_path / "study.parquet")


@pytest.mark.parametrize("name", ["coop-seed=0,replay.capacity=100", "dqn-ratio=0.25-seed=0", "x" * 100, "a b", "été"])
def test_names_that_are_some(name: str) -> None:
    assert check_run_name(name, "here") == name


@pytest.mark.parametrize("names", [["a", "a"], [None, "b"]])
def test_a_packed_study_names_each_run_once(names: list[str | None], tmp_path: Path) -> None:
    (tmp_path / "study.parquet").write_bytes(study_file(pa.table({"run": names, "config.toml": ["", ""]})))
    if None in names:
        assert PackedStudy(tmp_path / "study.parquet").names == ["None", "b"]
        return
    with pytest.raises(UsageError, match="two runs have one name"):
        PackedStudy(tmp_path / "study.parquet")


def test_a_grid_s_cells_are_folders_of_the_sweep() -> None:
    for key in ("../../out", "a/b", "x*"):
        text = f'methods = ["dqn"]\n[vary]\n"{key}" = [1, 2]\n'
        with pytest.raises(UsageError, match="a cell: run name"):
            parse_grid(text, "g.toml", check=False)


def test_a_folder_of_runs_is_read_by_its_names(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name in ("good", ".hidden", "bad[1]"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "config.toml").write_text("seed = 0\n")
    assert open_source(tmp_path).names == ["good"]
    assert capsys.readouterr().err == f"warning: {tmp_path}: run name 'bad[1]': holds one of * ? [; left out\n"


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small run of a built-in environment."""
    folder = tmp_path_factory.mktemp("trained") / "run"
    coop.train(method="dqn", total_steps=200, replay={"learning_starts": 20}, run_dir=folder).wait()
    return folder


def a_copy(trained: Path, to: Path) -> Path:
    shutil.copytree(trained, to)
    return to


def linked(path: Path, to: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path)
    path.unlink(missing_ok=True)
    path.symlink_to(to)


INSIDE = [
    *("episodes.csv", "config.toml.part", "summary.json.part", "run-id"),
    *("checkpoints", "videos", "checkpoints/N/learner.pt", "checkpoints/N/replay", "aside", "wandb"),
]


@pytest.mark.parametrize("place", INSIDE)
def test_no_link_leads_out_of_a_run(trained: Path, tmp_path: Path, place: str) -> None:
    run = a_copy(trained, tmp_path / "theirs")
    (newest,) = (run / "checkpoints").iterdir()
    place = place.replace("N", newest.name)
    mine = tmp_path / "mine"
    mine.mkdir() if (run / place).is_dir() or place == "videos" else mine.write_text("precious")
    linked(run / place, mine)
    for look in (check_links, coop.load):
        with pytest.raises(RunError, match="a link that leads out of the run"):
            look(run)
    with pytest.raises(RunError, match="a link that leads out of the run"):
        coop.train(resume=True, run_dir=run, total_steps=300)
    with pytest.raises(RunError, match="a link that leads out of the run"):
        open_source(tmp_path)
    assert list(mine.iterdir()) == [] if mine.is_dir() else mine.read_text() == "precious"


def test_a_device_or_a_pipe_is_not_read_without_end() -> None:
    with pytest.raises(RunError, match=r"/dev/zero: has more than 16,777,216 bytes"):
        read_bytes(Path("/dev/zero"), MAX_SETTINGS)
    with pytest.raises(UsageError, match=r"--config /dev/zero: /dev/zero: has more than"):
        load_tables(None, Path("/dev/zero"))
    reading, writing = os.pipe()
    os.write(writing, b"seed = 7\n")
    os.close(writing)
    assert load_tables(None, Path(f"/dev/fd/{reading}")) == {"seed": 7}
    os.close(reading)


@pytest.mark.parametrize("name", ["metrics.jsonl", "checkpoints", "summary.json"])
def test_a_link_that_leads_to_itself_is_named(trained: Path, tmp_path: Path, name: str) -> None:
    run = a_copy(trained, tmp_path / "theirs")
    linked(run / name, Path(name))
    for look in (check_links, coop.load, open_source):
        with pytest.raises(RunError, match=rf"{name}: a link that leads to itself"):
            look(run)


def cell(run: Path) -> CellFolder:
    """The run as the cell of a sweep."""
    (one,) = parse_grid('methods = ["dqn"]\nseeds = [0]\n', "g.toml").cells
    folder = CellFolder(run.parent, one)
    if run.exists():
        run.rename(folder.path)
    return folder


LOOKS: list[Callable[[Path], object]] = [
    lambda run: RunLock(run, "coop-replay", ("replay",)),
    lambda run: chosen_config(None, None, None, None, run),
    lambda run: cell(run).check(),
    open_source,
    lambda run: open_source(run.parent),
    reexecute,
    lambda run: coop.train(
        method="dqn", total_steps=40, learner={"initial_networks": str(run)}, run_dir=run.parent.with_name("new")
    ).wait(),
]


@pytest.mark.parametrize("number", range(len(LOOKS)))
def test_whatever_looks_into_a_run_refuses_links(number: int, trained: Path, tmp_path: Path) -> None:
    run = a_copy(trained, tmp_path / "theirs" / "run")
    shutil.move(run / "episodes.csv", tmp_path / "mine")
    (run / "episodes.csv").symlink_to(tmp_path / "mine")
    with pytest.raises(RunError, match=r"episodes\.csv: a link that leads out of the run"):
        LOOKS[number](run)


def test_links_within_a_run_and_a_user_s_own_are_left_alone(trained: Path, tmp_path: Path) -> None:
    run = a_copy(trained, tmp_path / "theirs")
    (run / "notes").symlink_to(tmp_path)
    (run / "checkpoints" / "best").symlink_to(run / "checkpoints")
    (tmp_path / "alias").symlink_to(run)
    check_links(tmp_path / "alias")


def test_no_file_is_written_through_a_link(tmp_path: Path) -> None:
    mine = tmp_path / "mine"
    mine.write_text("precious")
    (tmp_path / "x.part").symlink_to(mine)
    (tmp_path / "lines").symlink_to(mine)
    write_atomic(tmp_path / "x", b"theirs")
    with pytest.raises(OSError, match="symbolic links"):
        LineFile(tmp_path / "lines", go_on=False)
    (tmp_path / "checkpoints").mkdir()
    (tmp_path / "checkpoints" / ASKED).symlink_to(tmp_path / "new")
    with pytest.raises(OSError, match="symbolic links"):
        ask(tmp_path)
    (tmp_path / "array-1.sh").symlink_to(tmp_path / "new")
    (tmp_path / "array-2.cells").symlink_to(mine)
    script = slurm._write(slurm.Tasks(GridFile(), tmp_path, None, "none", 1, ""), ["a", "b"])
    assert script == tmp_path / "array-2.sh"
    assert script.with_suffix(".cells").read_text() == "a\nb\n"
    assert not (tmp_path / "new").exists()
    assert mine.read_text() == "precious"


def test_no_pipe_is_opened_to_be_written(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "index.html")
    with pytest.raises(UsageError, match=r"index\.html: neither a file nor a folder; not opened"):
        refuse_links(tmp_path / "index.html")
    (tmp_path / "checkpoints").mkdir()
    os.mkfifo(tmp_path / "checkpoints" / ASKED)
    ask(tmp_path)


EVIL = """
import gymnasium
from pathlib import Path
Path({!r}).write_text("ran")
gymnasium.register("Evil-v0", entry_point="gymnasium.envs.classic_control:CartPoleEnv")
"""
READERS: list[Callable[[str], list[str]]] = [
    lambda run: ["coop-eval", run, "--episodes", "1"],
    lambda run: ["coop-export", run, "--out", "exported"],
    lambda run: ["coop-lockstep", "--resume", "--run-dir", run, "--total-steps", "300"],
    lambda run: ["coop-eval", run, "--video", "film.gif"],
]


def with_settings(run: Path, text: str) -> None:
    """Change a run's settings and every checksum that tells, as somebody with bad intentions does."""
    content = "".join(line for line in text.splitlines(keepends=True) if not line.startswith("#"))
    (run / "config.toml").write_text(sealed_toml(content))
    for checkpoint in (run / "checkpoints").iterdir():
        write_manifest(checkpoint, msgspec.structs.replace(read_manifest(checkpoint), settings=""))
    summary = read_summary(run)
    summary["records"]["config.toml"] = measure(run / "config.toml")
    (run / SUMMARY).write_text(summary_text(summary))


def stranger(trained: Path, place: Path, module: str) -> tuple[Path, Path]:
    """A run whose settings name a module; returns its folder, and the file that the module writes when it runs."""
    run, sign = a_copy(trained, place / "run"), place / "sign"
    text = (run / "config.toml").read_text().replace('id = "CartPole-v0"', f'id = "{module}:Evil-v0"')
    assert f"{module}:Evil-v0" in text
    with_settings(run, text)
    return run, sign


@pytest.mark.parametrize("where", ["inside", "beside", "as a package"])
def test_a_module_that_came_with_a_run_is_not_imported(trained: Path, tmp_path: Path, where: str) -> None:
    """Not even where its user stands in the run's folder, or in the folder that holds it."""
    run, sign = stranger(trained, tmp_path, "evil_env")
    place = {
        "inside": run / "evil_env.py",
        "beside": tmp_path / "evil_env.py",
        "as a package": tmp_path / "evil_env" / "__init__.py",
    }[where]
    place.parent.mkdir(exist_ok=True)
    place.write_text(EVIL.format(str(sign)))
    for stand, name in ((run, "."), (tmp_path, "run")):
        for command in READERS:
            done = run_command(*command(name), cwd=stand)
            assert done.returncode == 2, done.stdout + done.stderr
            assert "evil_env" in done.stderr
            assert done.stderr.count("\n") == 1
            assert not sign.exists(), done.stderr
    stand = place.parent if where != "as a package" else tmp_path
    name = "." if where == "inside" else "run"
    done = run_command("coop-eval", name, "--episodes", "1", "--allow-import", "evil_env", cwd=stand)
    assert done.returncode == 0, done.stderr
    assert f"env.id: imports evil_env from {place}\n" in done.stderr
    assert sign.exists()


def test_a_user_s_own_module_is_imported_and_named(trained: Path, tmp_path: Path) -> None:
    (tmp_path / "theirs").mkdir()
    run, sign = stranger(trained, tmp_path / "theirs", "own_env")
    for own, stand, path in (("project", True, ""), ("library", False, "library")):
        (tmp_path / own).mkdir()
        (tmp_path / own / "own_env.py").write_text(EVIL.format(str(sign)))
        environment = {**os.environ, "PYTHONPATH": str(tmp_path / path)} if path else dict(os.environ)
        cwd = tmp_path / own if stand else tmp_path
        done = run_command("coop-eval", run, "--episodes", "1", cwd=cwd, environment=environment)
        if not path:  # the forked command has its path already
            assert done.returncode == 0, done.stderr
            assert f"env.id: imports own_env from {tmp_path / own / 'own_env.py'}\n" in done.stderr


def test_reading_records_runs_nothing(trained: Path, tmp_path: Path) -> None:
    run, sign = stranger(trained, tmp_path, "evil_records")
    for place in (run / "evil_records.py", tmp_path / "evil_records.py"):
        place.write_text(EVIL.format(str(sign)))
    for stand, runs in ((tmp_path, "."), (run, "..")):
        for command in (
            ["coop-report", runs, "--out", tmp_path / "report"],
            ["coop-report", runs, "--curves", tmp_path / "curves"],
            ["coop-report", runs, "--pack", tmp_path / "study.parquet"],
            ["coop-report", tmp_path / "study.parquet", "--out", tmp_path / "report"],
        ):
            done = run_command(*map(str, command), cwd=stand)
            assert done.returncode == 0, done.stderr
            assert not sign.exists()
    loaded = coop.load(run)
    assert len(loaded.episodes)
    assert loaded.summary
    assert "evil_records" in repr(loaded)
    assert not sign.exists()


def test_one_s_own_run_is_known_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The module that a run was trained with may lie beside it, as long as it is that file and that run."""
    monkeypatch.setattr("coop.common.imports._handed_over", [])
    monkeypatch.setattr("coop.common.imports._named", set())
    monkeypatch.setattr("coop.common.imports._files", {})
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    monkeypatch.setattr(sys, "path", [*sys.path])
    here = tmp_path / "here"
    run = here / "run"
    run.mkdir(parents=True)
    (run / "run-id").write_text("77\n")
    (here / "my_trained.py").write_text("")
    monkeypatch.chdir(here)
    hand_over(run)
    with pytest.raises(UsageError, match=r"my_trained\.py came with the run"):
        import_module("my_trained", "env.id")
    assert str(here) not in sys.path
    permit(["my_trained:Room"])
    import_module("my_trained", "env.id")
    remember(run)
    monkeypatch.setattr("coop.common.imports._named", set())
    del sys.modules["my_trained"]
    import_module("my_trained", "env.id")
    del sys.modules["my_trained"]
    (run / "run-id").write_text("78\n")
    with pytest.raises(UsageError, match="came with the run"):
        import_module("my_trained", "env.id")
    (run / "run-id").write_text("77\n")
    shutil.move(here, tmp_path / "there")
    monkeypatch.chdir(tmp_path / "there")
    hand_over(tmp_path / "there" / "run")
    with pytest.raises(UsageError, match="came with the run"):
        import_module("my_trained", "env.id")


def rewritten_as(path: Path, how: int) -> None:
    """Write an archive anew, with another compression."""
    with zipfile.ZipFile(path) as whole:
        entries = {entry.filename: whole.read(entry) for entry in whole.infolist()}
    with zipfile.ZipFile(path, "w", how) as archive:
        archive.writestr("filling", os.urandom(1 << 18), zipfile.ZIP_STORED)
        for name, content in entries.items():
            archive.writestr(name, content)


PAIRS = b"K\x01" + b"".join(bytes([0x71, each, 0x68, each, 0x86]) for each in range(40))  # x = (x, x), 40 times


def test_a_checkpoint_asks_for_no_more_than_it_holds(tmp_path: Path) -> None:
    path = tmp_path / "learner.pt"
    torch.save({"networks": [torch.rand(1 << 16)]}, path)
    rewritten_as(path, zipfile.ZIP_DEFLATED)
    with pytest.raises(RunError, match="compressed"):  # although no entry is larger than the file
        check_torch_file(path)
    torch.save({"networks": [torch.zeros(1 << 16)], "rest": (1, 2.5, None, "x", True)}, path)
    check_torch_file(path)
    with zipfile.ZipFile(path) as whole:
        entries = {entry.filename: whole.read(entry) for entry in whole.infolist()}

    def rewritten(how: int, **changes: bytes) -> None:
        with zipfile.ZipFile(path, "w", how) as archive:
            for name, content in entries.items():
                archive.writestr(name, changes.get(name.rpartition("/")[2], content))

    rewritten(zipfile.ZIP_DEFLATED)
    with pytest.raises(RunError, match="compressed"):
        check_torch_file(path)
    rewritten(zipfile.ZIP_STORED, **{"0": b"short"})
    with pytest.raises(RunError, match="array '0': 65,536 items, 5 bytes"):
        check_torch_file(path)
    for attack in (
        b"\x80\x02cbuiltins\nbytearray\nK\x05\x85R.",
        b"\x80\x05\x96\xff\xff\xff\xff\xff\x00\x00\x00.",
        b"\x80\x02}" + PAIRS + b"K\x01s.",  # a key of 2^40 numbers to hash
        b"\x80\x02}(" + PAIRS + b"K\x01u.",
        b"\x80\x02(" + PAIRS + b"K\x01d.",
        b"\x80\x02ccollections\nOrderedDict\n(" + PAIRS + b"K\x01\x86\x85\x85R.",
        b"\x80\x04(" + PAIRS + b"\x91.",
        b"\x80\x04\x8f(" + PAIRS + b"\x90.",
        b"\x80\x02(X\x07\x00\x00\x00storageX\x05\x00\x00\x00Float" + PAIRS + b"X\x03\x00\x00\x00cpuK\x00tQ.",
        b"\x80\x02(X\x07\x00\x00\x00storage" + PAIRS + b"X\x01\x00\x00\x000X\x03\x00\x00\x00cpuK\x00tQ.",
        b"\x80\x02",
    ):
        rewritten(zipfile.ZIP_STORED, **{"data.pkl": attack})
        with pytest.raises(RunError, match="can't be read"):
            check_torch_file(path)
    path.write_bytes(b"PK no archive")
    with pytest.raises(RunError, match="can't be read"):
        check_torch_file(path)


def text(word: str) -> bytes:
    """A text in a pickle."""
    return b"X" + len(word).to_bytes(4, "little") + word.encode()


WITHOUT_END = {
    "lists": f"a = {'[' * 20_000}{']' * 20_000}",
    "digits": f"a = {'9' * 5_000}",
    "tables": f"{'a.' * 5_000}a = 1",
}


@pytest.mark.parametrize("kind", WITHOUT_END)
def test_a_text_in_toml_without_end_is_refused_in_a_line(kind: str, tmp_path: Path) -> None:
    (tmp_path / "one.toml").write_text(text := WITHOUT_END[kind])
    readers: list[Callable[[], object]] = [
        lambda: load_tables(None, tmp_path / "one.toml"),
        lambda: parse_run_config(text, "here"),
        lambda: parse_grid(text, "here"),
        lambda: Space(tmp_path / "one.toml"),
    ]
    for read in readers:
        with pytest.raises(UsageError, match=r"(one\.toml|here): [^\n]*(recursion|digits|nests)"):
            read()
    with pytest.raises(ValueError, match="is no inline TOML table"):
        _read_table([f"{{{text}}}"])


@pytest.mark.parametrize("claimed", ["bytes", "entry"])
def test_a_checkpoint_s_sizes_are_those_of_the_file(claimed: str, tmp_path: Path) -> None:
    """Neither the pickle nor the archive's list of entries says how much memory is taken."""
    path, items = tmp_path / "learner.pt", 1 << 29  # float32 of 2 GiB
    taken = b"(" + b"".join(map(text, ("storage", "FloatStorage", "0", "cpu"))) + b"J" + items.to_bytes(4, "little")
    taken = taken.replace(text("FloatStorage"), b"ctorch\nFloatStorage\n") + b"tQ"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("a/data.pkl", b"\x80\x05" + taken + b".")
        archive.writestr("a/data/0", bytes(64))
    with pytest.raises(RunError, match="array '0': 536,870,912 items, 64 bytes"):
        check_torch_file(path)
    if claimed == "entry":
        content = bytearray(path.read_bytes())
        at = content.rindex(b"a/data/0") - 46 + 20  # both sizes in the entry of the list
        content[at : at + 8] = 2 * (4 * items).to_bytes(4, "little")
        path.write_bytes(content)
        with pytest.raises(RunError, match="larger than the file"):
            check_torch_file(path)
        return
    with zipfile.ZipFile(path, "w") as archive:  # the reader would take the memory before it looks for the bytes
        archive.writestr("a/data.pkl", b"\x80\x05\x96" + (1 << 28).to_bytes(8, "little") + b".")
    tracemalloc.start()
    with pytest.raises(RunError, match="can't be read"):
        check_torch_file(path)
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert most < 1 << 25


def test_an_array_is_no_larger_than_its_file(tmp_path: Path) -> None:
    path = tmp_path / "a.npy"
    for array in (np.arange(6.0).reshape(2, 3), np.zeros((0, 4)), np.zeros(())):
        np.save(path, array)
        assert np.array_equal(load_array(path, 1 << 20), array)
    with path.open("wb") as file:
        np.lib.format.write_array_header_1_0(file, {"descr": "<f8", "fortran_order": False, "shape": (1 << 40,)})
        file.write(bytes(64))
    with pytest.raises(ValueError, match="greater than file size"):
        load_array(path, 1 << 20)
    path.write_bytes(pickle.dumps([1]))
    with pytest.raises(ValueError, match="contains pickled"):
        load_array(path, 1 << 20)


def test_a_study_is_measured_before_it_is_spread_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "study.parquet"
    lists = pa.array([[0.0] * 200_000], pa.list_(pa.float64()))
    path.write_bytes(study_file(pa.table({"run": ["a"], "episodes.csv/return": lists})))
    PackedStudy(path)
    monkeypatch.setattr(packed, "MAX_STUDY", 1 << 20)
    assert path.stat().st_size < 10_000
    with pytest.raises(UsageError, match=r"not a packed study: 200,00\d values, [\d,]+ bytes; a study has at most"):
        PackedStudy(path)
    texts = pa.array([["x" * 100_000] * 1_000], pa.list_(pa.string()))
    path.write_bytes(study_file(pa.table({"run": ["a"], "episodes.csv/actor": texts})))
    assert path.stat().st_size < 10_000
    with pytest.raises(UsageError, match=r"not a packed study: 100,000,00\d bytes of text"):
        PackedStudy(path)
    os.truncate(path, 1 << 21)
    with pytest.raises(UsageError, match=r"not a packed study: 2,097,152 bytes; a study has at most"):
        PackedStudy(path)


def test_a_text_is_measured_before_it_is_read(trained: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run = a_copy(trained, tmp_path / "runs" / "one")
    monkeypatch.setattr(untrusted, "MAX_TEXT", 1 << 20)
    with (run / "episodes.csv").open("r+b") as file:
        file.truncate(1 << 40)  # takes no space: such a file comes out of a small archive
    source = open_source(tmp_path / "runs")
    with pytest.raises(RunError, match="allowed: at most"):
        source.text("one", "episodes.csv")
    assert msgpack.packb(json.loads((run / "summary.json").read_text()))


SPARSE = 1 << 40  # bytes that take no space


@pytest.mark.parametrize(
    ("place", "said"),
    [
        ("config.toml", "config.toml: has .* bytes; allowed: at most"),
        ("run-id", "belongs to another run"),
        ("evaluations.csv", "evaluations.csv: has .* bytes; allowed: at most"),
        ("checkpoints/*/DONE", "DONE: .* bytes; allowed: at most"),
        ("checkpoints/*/learner.pt", f"learner.pt: has {SPARSE:,} bytes instead of"),
        ("checkpoints/*/replay/frames.npy", f"frames.npy: has {SPARSE:,} bytes instead of"),
        ("metrics.jsonl", ""),  # cut back to what the checkpoint seals
        ("summary.json", ""),  # not read where a checkpoint is
    ],
)
def test_a_file_larger_than_memory_is_not_read(trained: Path, tmp_path: Path, place: str, said: str) -> None:
    run = a_copy(trained, tmp_path / "runs" / "run")
    (path,) = run.glob(place)
    os.truncate(path, SPARSE)
    done = run_command("coop-report", run.parent, "--out", tmp_path / "out")
    assert "Traceback" not in done.stderr
    done = run_command("coop-lockstep", "--resume", "--run-dir", run, "--total-steps", "300")
    assert re.search(said, done.stderr), done.stderr
    assert (done.returncode > 0, done.stderr.count("\n")) == (bool(said), int(bool(said))), done.stderr
    assert path.stat().st_size == SPARSE or not said


def varint(number: int, size: int) -> bytes:
    """A positive integer in Thrift's compact protocol, in `size` bytes."""
    sevens = [(2 * number >> 7 * place) & 127 | 128 for place in range(size)]
    return bytes([*sevens[:-1], sevens[-1] & 127])


@pytest.mark.parametrize(("field", "claimed"), [("size", 2**31 - 1), ("values", 2**27 - 1)])
def test_a_page_is_no_larger_than_a_study(tmp_path: Path, field: str, claimed: int) -> None:
    """Whatever the footer says: memory is taken for what a page's own header declares."""
    path, count = tmp_path / "study.parquet", 40_000_000  # a number as long as the one that is claimed
    lists = pa.LargeListArray.from_arrays([0, count], pa.array(np.zeros(count, np.int8))).cast(
        pa.large_list(pa.int32())
    )
    table = pa.table({"run": ["a"], "metrics.jsonl/x": lists})
    table = table.replace_schema_metadata({parquet_seals.SEAL: parquet_seals.UNSEALED})
    pq.write_table(
        table, path, compression="zstd", use_dictionary=False, data_page_size=1 << 30, write_statistics=False
    )
    content = path.read_bytes()
    path.write_bytes(parquet_seals.sealed(content))
    PackedStudy(path)
    size = next(size for size, held in pages(content) if held == count)
    now, digits = (size, 5) if field == "size" else (count, 4)
    old, new = varint(now, digits), varint(claimed, digits)
    place = content.index(b"\x15" + old)
    path.write_bytes(parquet_seals.sealed(content[: place + 1] + new + content[place + 1 + len(old) :]))
    with pytest.raises(UsageError, match=r"not a packed study: [\d,]+ values, [\d,]+ bytes; a study has at most"):
        PackedStudy(path)


def pages(content: bytes) -> list[tuple[int, int]]:
    """The pages of a study's last column."""
    column = pq.ParquetFile(pa.BufferReader(content)).metadata.row_group(0).column(1)
    start = column.dictionary_page_offset or column.data_page_offset
    return list(page_sizes(content, start, column.total_compressed_size))


def test_pages_that_are_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "study.parquet"
    pq.write_table(pa.table({"run": ["a"], "metrics.jsonl/x": [[1, 2, 3]]}), path)
    content = path.read_bytes()
    assert sum(held for _, held in pages(content)[-1:]) == 3
    with pytest.raises(ValueError, match="outside of the file"):
        list(page_sizes(content, 4, len(content)))
    rng = np.random.default_rng(0)
    for _ in range(3_000):
        data = rng.integers(0, 256, 60, np.uint8).tobytes()
        with suppress(ValueError):
            list(page_sizes(data, 0, len(data)))
    for bad in (b"\x15\x00\x15\x01\x15\x00\x00", b"\x15\x00\x15\x02\x15\x01\x00"):  # sizes of -1
        with pytest.raises(ValueError, match="negative"):
            list(page_sizes(bad, 0, len(bad)))
    monkeypatch.setattr(untrusted, "MAX_ENTRIES", 100)
    for bad, said in (
        (b"\x1c" * 5_000, "a page's header that is none"),  # structures within structures
        (b"\x19\x00\x25\x00\x15\x00\x00", "a page's header that is none"),  # a list
        (b"\x15" + b"\xff" * 100, "a number without an end"),
        (b"\x15\x00\x15\x00\x15\x00\x00" * 101, "more than 100 pages"),
    ):
        with pytest.raises(ValueError, match=said):
            list(page_sizes(bad, 0, len(bad)))


def test_neither_a_pipe_nor_a_device_is_opened(trained: Path, tmp_path: Path) -> None:
    run = a_copy(trained, tmp_path / "theirs")
    for place in ("config.toml", "episodes.csv"):
        (run / place).unlink()
        os.mkfifo(run / place)
        for look in (check_links, coop.load):
            with pytest.raises((RunError, UsageError), match=r"neither a file nor a folder|holds no run"):
                look(run)
        with pytest.raises(RunError, match="neither a file nor a folder"):
            coop.train(resume=True, run_dir=run)


@pytest.mark.parametrize("place", ["run/summary.json", "run/run-id", "sweep.toml"])
def test_a_report_opens_no_pipe(trained: Path, tmp_path: Path, place: str) -> None:
    a_copy(trained, tmp_path / "theirs" / "run")
    (tmp_path / "theirs" / place).unlink(missing_ok=True)
    os.mkfifo(tmp_path / "theirs" / place)
    done = run_command("coop-report", tmp_path / "theirs", "--out", tmp_path / "out")
    assert done.returncode == 1
    assert done.stderr.endswith(f"{place}: neither a file nor a folder; not opened\n")


def test_a_report_is_not_written_through_links(trained: Path, tmp_path: Path) -> None:
    a_copy(trained, tmp_path / "theirs" / "run")
    (tmp_path / "mine").mkdir()
    (tmp_path / "theirs" / "report").symlink_to(tmp_path / "mine")
    done = run_command("coop-report", tmp_path / "theirs")
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)
    assert "report: a link, to " in done.stderr
    (tmp_path / "theirs" / "report").unlink()
    (tmp_path / "theirs" / "report").mkdir()
    (tmp_path / "theirs" / "report" / "index.html").symlink_to(tmp_path / "mine" / "page")
    done = run_command("coop-report", tmp_path / "theirs")
    assert "index.html: a link, to " in done.stderr
    (tmp_path / "curves").mkdir()
    for place in ("run", "run/learning_curve.png"):
        (tmp_path / "curves" / place).symlink_to(tmp_path / "mine")
        done = run_command("coop-report", tmp_path / "theirs", "--curves", tmp_path / "curves")
        assert f"{place}: a link, to " in done.stderr
        (tmp_path / "curves" / place).unlink()
        (tmp_path / "curves" / "run").mkdir(exist_ok=True)
    assert list((tmp_path / "mine").iterdir()) == []


ROLES = ["coop-actor", "coop-replay", "coop-watch", "coop-limits", "coop-eval", "coop-learner", "coop-local"]


@pytest.mark.parametrize("command", [*ROLES, "coop-lockstep"])
@pytest.mark.parametrize("name", ["../x", "a*"])
def test_a_run_s_name_on_the_wire(command: str, name: str, tmp_path: Path) -> None:
    done = run_command(command, f"--run={name}", cwd=tmp_path)
    assert (done.returncode, done.stderr.count("\n")) == (2, 1), done.stderr
    assert "run" in done.stderr
    assert list(tmp_path.iterdir()) == []


def test_a_network_is_no_larger_than_a_message(trained: Path, tmp_path: Path) -> None:
    run = a_copy(trained, tmp_path / "theirs")
    text = (run / "config.toml").read_text()
    with_settings(run, re.sub(r"hidden = \[[^]]*\]", "hidden = [1048576, 1048576]", text))
    with pytest.raises(UsageError, match=r"network\.hidden = .*parameters; allowed: at most"):
        coop.load(run).policy()
