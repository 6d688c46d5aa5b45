"""The table of metrics: each is where the table says, in rows, status, screen, page, exporter, TensorBoard and docs."""

import json
import re
import urllib.request
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import pytest
from msgspec.structs import replace
from rich.console import Console
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from test_screen import STATUS

from coop.common.errors import BadMessage
from coop.common.messaging import wire
from coop.common.messaging.messages.status import LearnerStatus, Measured
from coop.common.metrics import COLUMNS, MEASURED, METRICS, Metric
from coop.learner.status import measured
from coop.lockstep.lockstep import Lockstep
from coop.monitor.facts import facts, values
from coop.monitor.live_page import LivePage
from coop.monitor.screen import RunScreen
from coop.records.run_directory import RunDirectory
from coop.records.run_options import base_config
from website.assemble import assembled

# Names that dashboards rely on; they stay. Those of metrics.jsonl are in tests/test_topology.py.
PROMETHEUS = """env_steps_total updates_total episodes_total bad_messages_total faults_total return_mean_100 epsilon s
    env_steps_per_s updates_per_s seconds acting size capacity ratio_target ratio_measured ratio_ahead ratio_least
    ratio_most td_error loss q_gap q_abs_mean q_bound sample_age_mean sample_age_p95 reuse_mean evicted_unsampled
    weight_lag_mean"""
TAGS = """charts/SPS charts/updates_per_second charts/epsilon losses/td_loss losses/td_error train/update train/acting
    train/s train/q_gap train/q1_mean train/q2_mean train/q_abs_mean train/archive_td_error train/archive_drift
    train/policy_churn train/dormant_share train/effective_rank train/q_bound train/replay_size train/terminal_share
    train/sample_age_mean train/sample_age_p95 train/reuse_mean train/distinct_share train/evicted_unsampled
    train/weight_lag_mean"""
LIVE = [metric for metric in METRICS if metric.field and not metric.listed]


@dataclass(frozen=True)
class Run:
    """The newest row of metrics.jsonl of a run, its TensorBoard, and a status with that row."""

    row: dict[str, Any]
    board: dict[str, tuple[int, float]]
    status: LearnerStatus


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """400 updates of cooperative learning, whose second row has the metrics that compare with the first."""
    folder: Path = tmp_path_factory.mktemp("run")
    run = Lockstep(base_config(["--method", "coop"]))
    rows = 0
    with RunDirectory(folder, run.config) as directory:
        while rows < 2:
            for effects in run.play():
                directory.record(effects.episodes, effects.metrics)
                rows += bool(effects.metrics)
    run.env.close()
    row = json.loads((folder / "metrics.jsonl").read_text().splitlines()[-1])
    board = EventAccumulator(str(folder / "tb"), size_guidance={"scalars": 0}).Reload()
    newest = {tag: board.Scalars(tag)[-1] for tag in board.Tags()["scalars"]}
    points = {tag: (event.step, event.value) for tag, event in newest.items()}
    return Run(row, points, replace(STATUS, measured=measured(row)))


def test_names_are_unique_and_those_of_the_messages() -> None:
    names = [metric.name for metric in METRICS]
    assert len(set(names)) == len(names)
    assert {f"coop_{name}" for name in PROMETHEUS.split()} <= {metric.prometheus for metric in METRICS}
    assert set(TAGS.split()) <= {metric.tensorboard for metric in METRICS}
    for metric in METRICS:
        assert metric.field in {"", metric.name, f"measured.{metric.name}", metric.name.replace("ratio_", "ratio.")}
        assert bool(metric.line) == bool(metric.words)
        assert bool(metric.chart) == bool(metric.curve)
    assert set(values(STATUS)) <= {metric.name for metric in LIVE}
    whole = replace(STATUS, measured=Measured(**{name: [1] if listed else 1.0 for name, listed in MEASURED.items()}))
    assert values(whole).keys() == {metric.name for metric in LIVE}


def test_the_columns_and_tags_of_a_row(run: Run) -> None:
    assert run.row.keys() == COLUMNS
    for metric in METRICS:
        if metric.tensorboard:
            shown = pytest.approx(run.row[metric.column])
            assert run.board[metric.tensorboard] == (run.row["env_step"], shown), metric.name
    own = {tag for tag in run.board if tag.startswith(("train/", "losses/")) or "per_second" in tag}
    assert own - {metric.tensorboard for metric in METRICS} == {"losses/q_values"}


def test_the_status_carries_a_row_and_is_checked(run: Run) -> None:
    fields = msgspec.to_builtins(run.status)
    read = LearnerStatus.decode(wire.decode(bytes(wire.encode("status", "r", fields))))
    assert msgspec.to_builtins(read)["measured"] == {name: run.row[name] for name in MEASURED}
    earlier = {**fields, "measured": {"loss": 0.5, "of_a_later_version": 1.0}}
    read = LearnerStatus.decode(wire.decode(bytes(wire.encode("status", "r", earlier))))
    assert read.measured == Measured(loss=0.5)
    for value in (float("nan"), float("inf"), "0.5", [0.5]):
        bad = {**fields, "measured": {"loss": value}}
        with pytest.raises(BadMessage, match=r"fields\.measured\.loss"):
            LearnerStatus.decode(wire.decode(bytes(wire.encode("status", "r", bad))))
    assert measured({"loss": 0.5, "effective_rank": float("nan")}) == Measured(loss=0.5), "not known, not refused"


@pytest.mark.parametrize("metric", [metric for metric in METRICS if metric.line], ids=lambda metric: metric.name)
def test_a_metric_on_screen(metric: Metric, run: Run) -> None:
    words = metric.words.format(values(run.status)[metric.name])
    assert words in facts(run.status)[metric.line]
    console = Console(width=1000, height=100, color_system=None)
    with console.capture() as capture:
        console.print(RunScreen("demo", run.status, [], whole=True))
    assert re.sub(r"\s+", " ", words).strip() in re.sub(r"\s+", " ", capture.get())


def test_metrics_on_the_page(run: Run) -> None:
    with closing(LivePage("demo", "0")) as page:
        page.show(run.status, [], 0.0, "")
        with urllib.request.urlopen(f"{page.url}page.json", timeout=20) as answer:
            shown = json.load(answer)
    (point,) = shown["points"]
    drawn = {(chart["title"], *line[:2]) for chart in shown["charts"] for line in chart["lines"]}
    known = values(run.status)
    for metric in METRICS:
        if metric.chart:
            assert (metric.chart, metric.name, metric.curve) in drawn
            assert point[shown["columns"].index(metric.name)] == known[metric.name]
        if metric.line:
            assert metric.words.format(known[metric.name]) in dict(shown["facts"])[metric.line]


def test_metrics_for_prometheus(run: Run) -> None:
    pytest.importorskip("prometheus_client", reason="needs the extra prometheus")
    from prometheus_client.parser import text_string_to_metric_families  # noqa: PLC0415

    from coop.monitor.exporter import exported  # noqa: PLC0415

    with (
        exported("0", lambda: run.status) as port,
        urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics", timeout=20) as answer,
    ):
        families = list(text_string_to_metric_families(answer.read().decode()))
    shown = {sample.name: sample.value for family in families for sample in family.samples}
    texts = {family.name: family.documentation for family in families}
    for metric in LIVE:
        assert shown[metric.prometheus] == values(run.status)[metric.name]
        assert texts[f"coop_{metric.name}"] == metric.meaning


def test_the_table_in_the_documentation() -> None:
    page = assembled("docs/watching.md")
    for metric in METRICS:
        (line,) = re.findall(rf"^\| `{metric.name}` \| .*\|$", page.partition("## Every metric")[2], re.MULTILINE)
        cells = [cell.strip(" `").replace("\\|", "|") for cell in re.split(r"(?<!\\)\|", line)[1:-1]]
        names = (metric.column, metric.field, metric.prometheus, metric.tensorboard, metric.line)
        assert cells == [metric.name, metric.meaning, metric.unit, *names, metric.chart]
