"""What a report says against a baseline, by hand-made runs; and that its figures and page fit."""

import re
import shutil
import subprocess
from itertools import pairwise
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.figure import Figure as Canvas
from test_comparisons import write_runs

from coop.common.errors import UsageError
from coop.studies.report.baseline import baseline_figure, baseline_table, find_baseline
from coop.studies.report.figures import buffers
from coop.studies.report.intervals import Interval
from coop.studies.report.page import page
from coop.studies.report.plots import STYLE, WIDTH, Figure, Line, Panel, _finish_panel, draw
from coop.studies.report.results import tables
from coop.studies.report.study import Study, load_study
from coop.studies.report.summaries import final_returns
from coop.studies.report.table import ResultTable
from coop.studies.report.writer import write_report

CHROMIUM = shutil.which("chromium") or shutil.which("google-chrome")
MEASURE = """<script>
for (const each of document.querySelectorAll("details")) each.open = true;
const wide = [...document.querySelectorAll(".table")].filter((each) => each.scrollWidth > each.clientWidth);
document.title = `${document.documentElement.scrollWidth} ${innerWidth} ${wide.length}`;
</script>"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return write_runs(tmp_path)


@pytest.fixture(scope="module")
def reported(tmp_path_factory: pytest.TempPathFactory) -> tuple[Study, list[ResultTable]]:
    """The same runs, and the tables of their report; dqn is the baseline."""
    study = load_study(write_runs(tmp_path_factory.mktemp("runs")))
    return study, [baseline_table(study, find_baseline(study, "dqn")), *tables(study)]


def by_place(rows: list[dict[str, Any]], measure: str = "return of the last 100") -> dict[tuple[str, str], list[Any]]:
    names = ("mean", "baseline", "difference", "low", "high", "seeds")
    return {(r["method"], r["setting"]): [r[n] for n in names] for r in rows if r["measure"] == measure}


def around(mean: float) -> list[Any]:
    """The mean of mean - 2, mean and mean + 2, and its t interval."""
    return [pytest.approx(mean + times * 4.302653 * 2 / 3**0.5) for times in (0, -1, 1)]


def test_differences_from_a_method(folder: Path) -> None:
    study = load_study(folder)
    found = by_place(baseline_table(study, find_baseline(study, "dqn")).frame.to_dict("records"))
    # By seed: 50, 53, 56 minus 100, 101, 102 at 500; 70, 73, 76 at 600; 200, 203, 206 at 5000.
    assert found == {
        ("coop", "capacity 500"): [53.0, 101.0, *around(-48.0), 3],
        ("coop", "capacity 600"): [73.0, 101.0, *around(-28.0), 3],
        ("coop", "capacity 5000"): [203.0, 101.0, *around(102.0), 3],
        ("coop", "all"): [pytest.approx(329 / 3), 101.0, *around(26 / 3), 3],
    }


@pytest.mark.parametrize("name", ["coop-500-1", "coop-500-0"])
def test_differences_from_a_run_are_those_from_its_setting(name: str, folder: Path) -> None:
    study = load_study(folder)
    table = baseline_table(study, find_baseline(study, name))
    assert table.title == "Differences from coop, capacity 500"
    found = by_place(table.frame.to_dict("records"))
    assert [key for key in found if key[0] == "coop"] == [("coop", "capacity 600"), ("coop", "capacity 5000")]
    assert found["coop", "capacity 600"] == [73.0, 53.0, 20.0, 20.0, 20.0, 3]
    assert found["dqn", "capacity 500"] == [101.0, 53.0, *around(48.0), 3]
    shown = baseline_figure(study, find_baseline(study, name))
    assert [panel.y for panel in shown.panels] == ["difference of return of the last 100", "difference of area"]
    assert shown.panels[0].ticks == ["capacity 500", "capacity 600", "capacity 5000"]


def test_only_seeds_that_both_have_count(folder: Path) -> None:
    shutil.rmtree(folder / "dqn-600-2")
    study = load_study(folder)
    found = by_place(baseline_table(study, find_baseline(study, "coop-600-0")).frame.to_dict("records"))
    assert found["dqn", "capacity 600"] == [
        100.5,
        71.5,
        29.0,
        *(pytest.approx(29 + wide) for wide in (-12.7062, 12.7062)),
        2,
    ]


def test_what_is_no_baseline(folder: Path) -> None:
    study = load_study(folder)
    with pytest.raises(UsageError) as refused:
        find_baseline(study, "dqm")
    assert str(refused.value) == (
        "--baseline dqm: unknown; did you mean dqn? allowed: dqn, coop, or the name of a run's folder"
    )
    for gone in folder.glob("dqn-*"):
        shutil.rmtree(gone)
    study = load_study(folder)
    with pytest.raises(UsageError, match="--baseline coop: no other runs have seeds in common with it"):
        baseline_table(study, find_baseline(study, "coop"))
    with pytest.raises(UsageError, match="--baseline x: unknown"):
        write_report(folder, folder / "out", "x")
    assert not (folder / "out").exists()


@pytest.mark.parametrize("columns", [1, 3])
@pytest.mark.parametrize(
    "sizes",
    [(500, 1000, 1500, 2000, 3000, 3500, 4000, 5000), (0, 50, 100, 200, 500, 1000, 2000, 5000), (10, 1_000_000)],
)
def test_labels_of_ticks_do_not_touch(sizes: tuple[int, ...], columns: int) -> None:
    values = np.array(sizes, np.float64)
    line = Line("dqn", values, Interval(values, values, values))
    with mpl.rc_context(STYLE):
        canvas = Canvas(figsize=(WIDTH if columns > 1 else WIDTH * 2 / 3, 2.3), layout="constrained")
        grid = canvas.subplots(1, columns, squeeze=False)[0]
        for axes in grid:
            axes.plot(range(len(values)), values)
            _finish_panel(axes, Panel("", "capacity", "return", [line], marks=True, sizes=True), columns)
        canvas.draw_without_rendering()
        for axes in grid:
            labels = [label for label in axes.get_xticklabels() if label.get_text()]
            boxes = [label.get_window_extent() for label in labels]
            assert len(labels) >= 2
            assert labels[-1].get_text() in ("5k", "1000k")
            assert all(left.x1 < right.x0 for left, right in pairwise(boxes))


def test_a_table_for_readers() -> None:
    rows = [["a <b>", 1.5, 0.25, None, None, 7], ["c", 200.0, None, 1.0, float("nan"), 8], ["d,e", 3, 1.0, 1.0, 2.0, 9]]
    spreads = {"mean": ["sd"], "IQM": ["low"]}
    table = ResultTable("t", "T", ["name", "mean", "sd", "IQM", "low", "more"], rows, "note", spreads, aside=["more"])
    assert table.csv() == 'name,mean,sd,IQM,low,more\na <b>,1.5,0.25,,,7\nc,200,,1,,8\n"d,e",3,1,1,2,9\n'
    assert table.markdown().splitlines() == [
        *("## T", "", "| name | mean (sd) | IQM (low) |", "| --- | --- | --- |"),
        *("| a <b> | 1.5 (0.25) | - |", "| c | 200 | 1 |", "| d,e | 3 (1) | 1 (2) |", "", "note"),
    ]
    assert "<td>a &lt;b&gt;</td>" in table.html()
    interval = ResultTable("t", "T", ["x", "low", "high"], [[1.0, 0.5, 2.0]], spreads={"x": ["low", "high"]})
    assert interval.markdown().splitlines()[2:] == ["| x [95 %] |", "| --- |", "| 1 [0.5, 2] |"]


def test_nothing_is_wider_than_the_window(reported: tuple[Study, list[ResultTable]], tmp_path: Path) -> None:
    study, made = reported
    drawn = [(figure, tmp_path / f"{figure.name}.png") for figure in (buffers(study), final_returns(study))]
    for figure, png in drawn:
        draw(figure, png)
    index = tmp_path / "index.html"
    index.write_text(page(study, tmp_path, made, drawn, []) + MEASURE, encoding="utf-8")
    headings = re.findall("<h2>(.*?)</h2>", index.read_text(encoding="utf-8"))
    assert headings == [*("Return against buffer size", made[0].title, "Over all settings", "Every setting"),
                        *("Figures", "Tables")]  # fmt: skip
    if CHROMIUM is None:
        pytest.skip("needs Chromium: apt-get install chromium")
    flags = ["--headless=new", "--no-sandbox", "--disable-gpu", f"--user-data-dir={tmp_path}/c", "--dump-dom"]
    for width in (1300, 700):
        command = [CHROMIUM, *flags, f"--window-size={width},900", index.as_uri()]
        shown = subprocess.run(command, capture_output=True, text=True, check=True).stdout
        (found,) = re.findall(r"<title>(\d+) (\d+) (\d+)</title>", shown)
        whole, window, scrolled = map(int, found)
        assert whole <= window, "the page does not scroll sideways"
        assert width < 1300 or scrolled == 0, "nor does a table"


def test_long_labels_leave_room_for_the_points(tmp_path: Path) -> None:
    ticks = ["reset_role_at_episode False, noise constant, feedback weight-gradient", "all"]
    values = np.array([1.0, 2.0])
    line = Line("coop", np.array([0.0, 1.0]), Interval(values, values, values))
    figure = Figure("f", "F", "", "", [Panel("", "", "return", [line], marks=True, ticks=ticks)])
    assert figure.width == WIDTH
    canvas = Canvas(figsize=(figure.width, 2.3), layout="constrained")
    axes = canvas.subplots()
    _finish_panel(axes, figure.panels[0], figure.columns)
    canvas.draw_without_rendering()
    assert axes.get_position().width > 0.5
    draw(figure, tmp_path / "f.png")
    assert (tmp_path / "f.pdf").exists()


def test_one_seed_has_no_interval(folder: Path) -> None:
    for path in [*folder.glob("*-1"), *folder.glob("*-2"), *folder.glob("*-9")]:
        shutil.rmtree(path)
    study = load_study(folder)
    assert {run.config.seed for run in study.runs} == {0}
    found = set()
    for table in tables(study):
        for row in table.rows:
            for column, cell in zip(table.columns, row, strict=True):
                if column.endswith(("low", "high")):
                    found.add(table.name)
                    assert cell is None or np.isnan(cell), f"{table.name}: {column}"
    assert {"aggregate", "improvement", "breaking_points", "common_breaking", "settings", "sizes"} <= found
    write_report(folder, folder / "report")
