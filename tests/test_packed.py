"""Packed studies: every number comes back, and a report of the file is the report of the folder."""

import csv
import errno
import json
from pathlib import Path

import numpy as np
import pytest

import coop
from coop.common.errors import RunError, UsageError
from coop.studies.report import cli
from coop.studies.report.packed import PackedStudy
from coop.studies.report.packing import pack
from coop.studies.report.study import load_study
from coop.studies.report.writer import write_report
from coop.studies.sweep.grid import load_grid

CONFIG = 'method = "{method}"\nseed = {seed}\ntotal_steps = 4000\n'
HEADER = "episode,env_step,actor,return,epsilon,s,q1_mean,q2_mean\n"
ROW = {
    "env_step": 128, "q_gap": 0.1, "sample_age_mean": 3.25, "sample_age_p95": 1e300, "reuse_mean": 0.1,
    "evicted_unsampled": 0.0,
}  # fmt: skip


def write(run: Path, files: dict[str, str]) -> None:
    run.mkdir(parents=True)
    for name, text in files.items():
        (run / name).write_text(text)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Runs that differ in what they left: whole ones, one too short for metrics, one begun, one of a newer version."""
    for seed in range(2):
        episodes = "".join(
            f"{n},{20 * n + 9},{n % 3:x}a,{n * 1.5:g},0.725354,{0.1 * 0.9**n:.6g},{n / 3:.6g},{-n / 7:.6g}\n"
            for n in range(19)
        )
        rows = [{**ROW, "env_step": 100 * n, "q_gap": 0.1 * n} for n in range(1, 4)]
        if seed:  # the first is of a version that did not write these
            rows[0] |= {"q_abs_mean": 0.5, "q_bound": 100.0}
            rows[1] |= {"q_abs_mean": 100.5, "q_bound": 100.0}
            rows[2] |= {"q_abs_mean": 1e6}  # gamma is 1
            rows[1:] = [{"archive_drift": 0.5, **row} for row in rows[1:]]  # which a run's first row can't have
        lines = "".join(json.dumps(row) + "\n" for row in rows)
        write(
            tmp_path / "study" / f"dqn-seed={seed}",
            {
                "config.toml": CONFIG.format(method="dqn", seed=seed),
                "summary.json": '{\n  "exit": "complete"\n}\n',
                "episodes.csv": HEADER + episodes,
                "metrics.jsonl": lines,
            },
        )
    write(
        tmp_path / "study" / "dqn-seed=2",
        {
            "config.toml": CONFIG.format(method="dqn", seed=2),
            "summary.json": '{"exit": "complete"}',
            "episodes.csv": HEADER + "0,5,0,1e+06,nan,-inf,1e-09,0.333333\n",
            "metrics.jsonl": "",
        },
    )
    newer = {**ROW, "q_gap": float("nan"), "reuse": [1, 2.5], "note": None, "big": 2**70}
    write(
        tmp_path / "study" / "dqn-seed=3",
        {
            "config.toml": CONFIG.format(method="dqn", seed=3),
            "summary.json": '{"exit": "interrupted by SIGINT"}',
            "episodes.csv": HEADER,
            "metrics.jsonl": json.dumps({key: value for key, value in newer.items() if key != "note"}) + "\n",
        },
    )
    write(
        tmp_path / "study" / "dqn-seed=4",
        {"config.toml": CONFIG.format(method="dqn", seed=4), "episodes.csv": "", "metrics.jsonl": ""},
    )
    (tmp_path / "study" / "sweep.toml").write_text('methods = ["dqn"]\nseeds = [0, 1, 2, 3, 4, 5]\n')
    return tmp_path / "study"


def test_a_study_outlives_the_rules_for_its_cells(folder: Path) -> None:
    grid = folder / "sweep.toml"
    grid.write_text(f"{grid.read_text()}fixed.learner.batch_size = 0\n")
    assert load_study(folder).runs, "the runs say themselves what they were"
    with pytest.raises(UsageError, match=r"learner\.batch_size = 0"):
        load_grid(str(grid))


def test_every_number_comes_back(folder: Path, tmp_path: Path) -> None:
    line = pack(folder, tmp_path / "study.parquet")
    assert line.startswith(f"{tmp_path}/study.parquet: 5 runs in ")
    packed = PackedStudy(tmp_path / "study.parquet")
    assert packed.sweep == (folder / "sweep.toml").read_text()
    for run in folder.glob("*/"):
        for name in ("config.toml", "summary.json"):
            assert packed.text(run.name, name) == ((run / name).read_text() if (run / name).exists() else None)
    for run in (folder / "dqn-seed=0", folder / "dqn-seed=1", folder / "dqn-seed=2"):
        rows = list(csv.DictReader((run / "episodes.csv").read_text().splitlines()))
        wanted = HEADER.strip().replace("actor,", "").split(",")
        for name, values in packed.columns(run.name, "episodes.csv", wanted).items():
            np.testing.assert_array_equal(values, [float(row[name]) for row in rows], name)
    seen = packed.columns("dqn-seed=1", "metrics.jsonl", ("q_gap", "sample_age_p95"), ("q_abs_mean", "note"))
    assert seen["q_gap"] == [0.1, 0.2, 0.1 * 3]
    assert seen["sample_age_p95"] == [1e300] * 3
    assert seen["q_abs_mean"] == [0.5, 100.5, 1e6]
    assert seen["note"] == [None] * 3
    with pytest.raises(KeyError):
        packed.columns("dqn-seed=0", "episodes.csv", ("actor",))  # no number in each run


def test_the_report_is_the_same(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    write_report(folder, tmp_path / "from-folder")
    monkeypatch.setattr("sys.argv", ["coop-report", str(folder), "--pack", str(tmp_path / "study.parquet")])
    cli.main()
    monkeypatch.setattr("sys.argv", ["coop-report", str(tmp_path / "study.parquet")])
    cli.main()
    made = sorted(path.name for path in (tmp_path / "from-folder").iterdir())
    assert made == sorted(path.name for path in (folder / "report").iterdir())
    for name in made:
        ours, theirs = (folder / "report" / name).read_bytes(), (tmp_path / "from-folder" / name).read_bytes()
        assert ours.replace(b"study.parquet", b"study") == theirs, name
    page = (folder / "report" / "index.html").read_text()
    assert "dqn-seed=4: begun, not finished" in page
    above = "dqn-seed=1: mean |Q| is above the largest that the rewards seen allow in 1 of 3 rows of metrics.jsonl"
    assert page.count(above) == page.count("mean |Q|") == 1
    assert capsys.readouterr().err == f"warning: {above}\n" * 2


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("episodes.csv", HEADER + "0,5\n", "episodes.csv, line 2: 2 values instead of 8"),
        ("metrics.jsonl", '{"env_step": 1}\n{"env\n', "metrics.jsonl, line 2: not JSON"),
    ],
)
def test_what_cannot_be_read_is_not_packed(name: str, text: str, words: str, folder: Path, tmp_path: Path) -> None:
    (folder / "dqn-seed=1" / name).write_text(text)
    with pytest.raises(RunError) as caught:
        pack(folder, tmp_path / "study.parquet")
    assert f"{folder}/dqn-seed=1/{words}" in str(caught.value)
    assert [path.name for path in tmp_path.iterdir()] == ["study"]


def test_curves_of_all_runs(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pack(folder, tmp_path / "study.parquet")
    for runs, out in ((folder, "a"), (tmp_path / "study.parquet", "b")):
        monkeypatch.setattr("sys.argv", ["coop-report", str(runs), "--curves", str(tmp_path / out)])
        cli.main()
    drawn = {path.parent.name: path.read_bytes() for path in (tmp_path / "a").glob("*/learning_curve.png")}
    assert sorted(drawn) == ["dqn-seed=0", "dqn-seed=1", "dqn-seed=2"]
    assert drawn == {path.parent.name: path.read_bytes() for path in (tmp_path / "b").glob("*/learning_curve.png")}


def full(*_: object) -> None:
    raise OSError(errno.ENOSPC, "No space left")


def test_a_report_replaces_nothing_but_a_report(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out = tmp_path / "mine"
    out.mkdir()
    for name in ("index.html", "returns_steps.png", "returns_steps.csv", "table_runs.md"):
        (out / name).write_text("mine")
        with pytest.raises(UsageError, match=rf"--out .*mine: {name} there is no report's; name an empty or a new"):
            write_report(folder, out)
        assert [path.name for path in out.iterdir()] == [name]
        assert (out / name).read_text() == "mine"
        (out / name).unlink()
    (out / "notes.txt").write_text("mine")
    with monkeypatch.context() as patch:
        patch.setattr("coop.studies.report.writer._draw_all", full)
        with pytest.raises(UsageError, match="No space left"):
            write_report(folder, out)
    for _ in range(2):
        write_report(folder, out)
        assert "has not ended" not in (out / "index.html").read_text()
    (folder / "report").mkdir()
    (folder / "report" / "table_runs.md").write_text("of a report whose page is not kept")
    monkeypatch.setattr("sys.argv", ["coop-report", str(folder)])
    cli.main()
    assert "<code>coop-report" in (folder / "report" / "index.html").read_text()


def test_what_cannot_be_packed(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="no folder with runs to pack"):
        pack(tmp_path, tmp_path / "a.parquet")
    with pytest.raises(UsageError, match=r"--pack .*none/a.parquet: No such file"):
        pack(folder, tmp_path / "none" / "a.parquet")
    with pytest.raises(UsageError, match=r"sweep.toml: not a packed study: "):
        write_report(folder / "sweep.toml", tmp_path / "out")


def test_nothing_but_a_packed_study_is_replaced(folder: Path, tmp_path: Path) -> None:
    run = folder / "dqn-seed=0"
    (tmp_path / "notes.txt").write_text("mine")
    (tmp_path / "link.parquet").symlink_to("notes.txt")
    kept = {path: path.read_bytes() for path in (run / "episodes.csv", folder / "sweep.toml", tmp_path / "notes.txt")}
    for path in kept:
        with pytest.raises(UsageError, match=rf"would replace .*{path.name}: not a packed study: .*name a new file"):
            pack(folder, path)
    with pytest.raises(UsageError, match=r"link\.parquet: a link, to notes\.txt"):
        pack(folder, tmp_path / "link.parquet")
    for runs in (folder, run):
        with pytest.raises(UsageError, match=r"in the folder of the run .*dqn-seed=0; name a file outside of it"):
            pack(runs, run / "new.parquet")
    (tmp_path / "loop").symlink_to("loop")
    with pytest.raises(UsageError, match="Too many levels of symbolic links"):
        pack(folder, tmp_path / "loop" / "new.parquet")
    assert {path: path.read_bytes() for path in kept} == kept
    assert not (run / "new.parquet").exists()
    for seed in (0, 1):
        pack(folder / f"dqn-seed={seed}", folder / "one.parquet")
    assert PackedStudy(folder / "one.parquet").names == ["dqn-seed=1"]


def test_a_thinned_study_keeps_its_episodes_and_warnings(folder: Path, tmp_path: Path) -> None:
    left_out = {"time": 1e9, "loss": 0.5, "reuse_histogram": [1, 2]}
    rows = [
        {**left_out, **ROW, "env_step": 200 * n, "q_abs_mean": 9.0, "q_bound": 8.0 if n == 4 else 10.0}
        for n in range(1, 101)
    ]
    (folder / "dqn-seed=0" / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    pack(folder, tmp_path / "thin.parquet", rows=10)
    thin = PackedStudy(tmp_path / "thin.parquet")
    kept = thin.columns("dqn-seed=0", "metrics.jsonl", ("env_step",), tuple(left_out))
    assert kept["env_step"] == [800, *range(2000, 20001, 2000)]
    assert all(kept[name] == [None] * 11 for name in left_out)
    assert thin.columns("dqn-seed=1", "metrics.jsonl", ("q_gap",))["q_gap"] == [0.1, 0.2, 0.1 * 3]
    assert len(thin.columns("dqn-seed=0", "episodes.csv", ("return",))["return"]) == 19
    studies = load_study(folder), load_study(tmp_path / "thin.parquet")
    whole, short = ([run.above_bound for run in study.runs] for study in studies)
    assert whole == short == [1, 1, 0]


@pytest.mark.parametrize("flags", [["--rows", "5"], ["--rows", "0", "--pack", "x.parquet"]])
def test_rows_that_are_refused(flags: list[str], folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.argv", ["coop-report", str(folder), *flags])
    with pytest.raises(SystemExit) as ended:
        cli.main()
    assert ended.value.code == 2


def test_a_file_without_a_suffix_has_no_place_for_its_report(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pack(folder, tmp_path / "packed")
    monkeypatch.setattr("sys.argv", ["coop-report", str(tmp_path / "packed")])
    with pytest.raises(SystemExit) as ended:
        cli.main()
    assert ended.value.code == 2
    assert "packed: a file without a suffix, so that its report has no place; give --out" in capsys.readouterr().err


def test_tables_of_a_study_whose_methods_have_settings_of_their_own() -> None:
    """Settings that are none of a run's are missing values; pandas warns of nothing."""
    frames = coop.load_sweep(Path(__file__).parents[1] / "results" / "cartpole" / "medqn.parquet")
    settings = frames.episodes.groupby("method")["medqn.epochs"]
    assert settings.count().gt(0).to_dict() == dict.fromkeys(settings.groups, False) | {"medqn": True}
    assert frames._repr_html_().count("<table") == 2
