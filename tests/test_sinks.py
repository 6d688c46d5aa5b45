"""What leaves a run for Prometheus and for Weights & Biases, and what is refused where they are not installed."""

import dataclasses
import json
import os
import re
import signal
import socket
import struct
import sys
import threading
import urllib.request
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
from commands import run_command
from msgspec.structs import replace
from tensorboard.backend.event_processing.data_provider import MultiplexerDataProvider
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensorboard.backend.event_processing.plugin_event_multiplexer import EventMultiplexer
from tensorboard.context import RequestContext
from tensorboard.plugins.base_plugin import TBContext
from tensorboard.plugins.hparams import api_pb2, get_experiment, list_session_groups
from tensorboard.plugins.hparams.backend_context import Context
from test_screen import STATUS

import coop
from coop.common.errors import UsageError
from coop.common.imports import check_extra
from coop.common.messaging.messages.evaluate import EvaluationRow
from coop.common.messaging.messages.status import LearnerStatus
from coop.common.process.lifecycle import Signalled, Stop
from coop.common.process.processes import free_endpoint
from coop.learner.summary import summarise
from coop.lockstep.lockstep import Lockstep
from coop.lockstep.run import LockstepRun
from coop.records.resumption import Start, holds_run
from coop.records.run_directory import RunDirectory
from coop.records.run_options import base_config
from coop.records.sinks import ChosenSinks, RecordedRun, Sink, chosen_sinks
from coop.records.sinks.mlflow import MlflowSink
from coop.records.summaries import read_summary
from website.assemble import assembled

GRID = {
    "methods": ["dqn"],
    "seeds": [3],
    "preset": "cartpole",
    "fixed": {"total_steps": 300, "network": {"hidden": [8]}, "replay": {"learning_starts": 50}},
    "vary": {"replay": {"capacity": [60, 90]}},
}
PAGE = assembled("docs/watching.md")
BLOCK, HEADER = 32768, 7  # bytes, of the log in which wandb keeps its records


def test_a_status_for_prometheus() -> None:
    pytest.importorskip("prometheus_client", reason="needs the extra prometheus")
    from prometheus_client.parser import text_string_to_metric_families  # noqa: PLC0415

    from coop.monitor.exporter import exported  # noqa: PLC0415

    status: LearnerStatus | None = None

    def scrape() -> dict[str, float]:
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics", timeout=20) as answer:
            families = list(text_string_to_metric_families(answer.read().decode()))
        samples = [sample for family in families for sample in family.samples]
        assert not [sample.name for sample in samples if f"`{sample.name}`" not in PAGE], "docs/watching.md lists all"
        own = {"env": "CartPole-v1", "method": "coop", "seed": "0"}
        assert all(own.items() <= sample.labels.items() for sample in samples)
        return {" ".join([s.name, *(v for k, v in sorted(s.labels.items()) if k not in own)]): s.value for s in samples}

    with exported("0", lambda: status) as port:
        assert scrape() == {}, "before the first status"
        status = replace(STATUS, missing=["actor 2 on node2 (pid 44)"])
        logged = scrape()
        with pytest.raises(UsageError, match=f"--prometheus {port}: Address already in use"), exported(str(port), dict):
            pass
        status = replace(STATUS, ratio=None, measured=None, waits=[], env_steps=31_290)
        fewer = scrape()
    assert logged["coop_env_steps_total"] == 31_240
    assert logged["coop_return_mean_100"] == 187.43
    assert (logged["coop_members actor"], logged["coop_members_lost"]) == (2, 1)
    assert (logged["coop_ratio_measured"], logged["coop_ratio_most"]) == (0.998, 80)
    assert (logged["coop_q_abs_mean"], logged["coop_q_bound"]) == (42.13, 100)
    assert logged["coop_wait_share the learner actors"] == 0.63
    assert logged["coop_evicted_unsampled"] == 0, "which is not unknown"
    assert fewer["coop_env_steps_total"] == 31_290
    assert not [name for name in fewer if name.startswith(("coop_ratio", "coop_q", "coop_wait"))]


def records(path: Path) -> Iterator[bytes]:
    """The records of wandb's file: a log of blocks, in which a record may be split into several parts."""
    data, record = path.read_bytes()[7:], b""  # after its own header
    at = HEADER
    while at - HEADER < len(data):
        left = BLOCK - at % BLOCK
        if left < HEADER:
            at += left
            continue
        _, size, kind = struct.unpack_from("<IHB", data, at - HEADER)
        record += data[at : at + size]
        at += HEADER + size
        if kind in (1, 4):  # whole, or the last part
            yield record
            record = b""


def play(run: Lockstep, directory: RunDirectory, rows: int = 2) -> None:
    """Play until there are some more rows of metrics."""
    while rows > 0:
        for effects in run.play():
            directory.record(effects.episodes, effects.metrics)
            rows -= bool(effects.metrics)


def scalars(folder: Path) -> dict[tuple[str, int], float]:
    """What TensorBoard reads of a run, by tag and step."""
    board = EventAccumulator(str(folder / "tb"), size_guidance={"scalars": 0}).Reload()
    return {(tag, e.step): e.value for tag in board.Tags()["scalars"] for e in board.Scalars(tag)}


def test_weights_and_biases_gets_tensorboards_scalars(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    wandb = pytest.importorskip("wandb", reason="needs the extra wandb")
    from wandb.proto.wandb_internal_pb2 import Record  # noqa: PLC0415

    monkeypatch.setenv("WANDB_MODE", "offline")
    run = Lockstep(base_config(["--method", "coop"]))
    with RunDirectory(tmp_path, run.config, log="tensorboard,wandb") as directory:
        play(run, directory)
    wandb.teardown()
    run.env.close()
    expected = scalars(tmp_path)
    (file,) = tmp_path.glob("wandb/offline-run-*/*.wandb")
    logged, settings, ends = {}, {}, []
    for data in records(file):
        record = Record.FromString(data)
        row = {item.key or item.nested_key[0]: json.loads(item.value_json) for item in record.history.item}
        logged |= {(tag, row["env_step"]): value for tag, value in row.items() if "/" in tag}
        settings |= {item.key: json.loads(item.value_json) for item in record.config.update}
        ends += [record.exit.exit_code] if record.HasField("exit") else []
    assert logged == pytest.approx(expected)
    assert settings["replay.capacity"] == run.config.replay.capacity
    assert ends == [1], "a run that nothing has ended"
    assert [path for path in tmp_path.glob("wandb/*/logs/*") if not path.resolve().is_relative_to(tmp_path)]
    assert coop.load(tmp_path).config == run.config, "though W&B has a link to its log elsewhere there"


def test_mlflow_gets_tensorboards_scalars(tmp_path: Path) -> None:
    """A run that is killed behind its checkpoint and resumed is one run of MLflow, in its own directory's store."""
    pytest.importorskip("mlflow", reason="needs the extra mlflow")
    config = base_config(["--method", "coop"])
    config = dataclasses.replace(config, total_steps=1200, checkpoint_every=400)
    run, path = Lockstep(config), tmp_path / "run"
    with RunDirectory(path, config, log="tensorboard,mlflow") as directory:
        run_id = directory.run_id()
        play(run, directory)
        run.save(directory)
        play(run, directory)
    run.env.close()
    resumed = LockstepRun(config, path, "test", Start(resume=True), log="mlflow")
    resumed.play(Stop())
    resumed.close()
    store = mlflow_store(path / "logs" / "mlruns")
    (experiment,) = [each for each in store.search_experiments() if each.name != "Default"]
    (its_run,) = store.search_runs([experiment.experiment_id])
    assert (experiment.name, its_run.info.run_name, its_run.info.status) == ("coop", "run", "FINISHED")
    assert its_run.data.tags["coop.run_id"] == f"{run_id:x}"
    assert its_run.data.params["replay.capacity"] == str(config.replay.capacity)
    logged = {
        (tag, each.step): each.value
        for tag in its_run.data.metrics
        for each in store.get_metric_history(its_run.info.run_id, tag)
    }
    expected = scalars(path)
    assert max(step for _, step in expected) > 1000, "the resumed run goes on with tb/, which has to be cut back"
    assert logged == pytest.approx(expected), "what was behind the checkpoint was logged twice, with the same values"


@pytest.mark.parametrize(
    ("ended", "status"),
    [("complete: target_return reached", "FINISHED"), ("stopped by on_episode", "FINISHED"),
     ("interrupted", "KILLED"), ("diverged: TD errors are not finite at update 3", "FAILED"), (None, "KILLED")],
)  # fmt: skip
def test_mlflow_is_told_how_a_run_has_ended(tmp_path: Path, ended: str | None, status: str) -> None:
    pytest.importorskip("mlflow", reason="needs the extra mlflow")
    run = Lockstep(base_config(["--method", "coop"]))
    run.env.close()
    with RunDirectory(tmp_path / "run", run.config, log="mlflow") as directory:
        if ended is not None:
            directory.conclude(dataclasses.replace(summarise(run.trainer, ended, 0.0, 0), return_mean_100=7), "run")
    store = mlflow_store(tmp_path / "run" / "logs" / "mlruns")
    (its_run,) = store.search_runs([store.get_experiment_by_name("coop").experiment_id])
    assert its_run.info.status == status
    assert its_run.data.metrics == ({} if ended is None else {"final/return_mean_100": 7})


def test_mlflow_s_requests_are_within_its_bounds(tmp_path: Path) -> None:
    pytest.importorskip("mlflow", reason="needs the extra mlflow")
    sink, sizes = MlflowSink(RecordedRun(tmp_path, 7, "")), []
    log = sink._client.log_batch

    def noted(run: str, metrics: Sequence[Any] = (), params: Sequence[Any] = ()) -> None:
        sizes.append((len(metrics), len(params)))
        log(run, metrics=metrics, params=params)

    sink._client.log_batch = noted
    sink.begin({f"setting.{number}": number for number in range(201)}, None)
    sink.scalars({f"metric/{number}": number for number in range(2001)}, 5)
    sink.close()
    store = mlflow_store(tmp_path / "logs" / "mlruns")
    (its_run,) = store.search_runs([store.get_experiment_by_name("coop").experiment_id])
    assert its_run.data.params == {f"setting.{number}": str(number) for number in range(201)}
    assert its_run.data.metrics == {f"metric/{number}": number for number in range(2001)}
    assert sizes == [(0, 100), (0, 100), (0, 1), (1000, 0), (1000, 0), (1, 0)]


def test_a_run_that_a_service_refuses_has_not_begun(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A server that is away is tried three times, not for minutes; and the same folder takes the run without it."""
    pytest.importorskip("mlflow", reason="needs the extra mlflow")
    run, tried = Lockstep(base_config(["--method", "coop"])), []
    run.env.close()
    with socket.create_server(("127.0.0.1", 0)) as server:

        def hang_up() -> None:
            with suppress(OSError):  # at the end
                while True:
                    server.accept()[0].close()
                    tried.append(1)

        threading.Thread(target=hang_up, daemon=True).start()
        monkeypatch.setenv("MLFLOW_TRACKING_URI", f"http://127.0.0.1:{server.getsockname()[1]}")
        with pytest.raises(UsageError, match=r"^--log mlflow: MlflowException: API request to http.* failed"):
            RunDirectory(tmp_path / "run", run.config, log="mlflow")
        assert len(tried) == 3
        assert "MLFLOW_HTTP_REQUEST_MAX_RETRIES" not in os.environ
        monkeypatch.setenv("MLFLOW_HTTP_REQUEST_MAX_RETRIES", "0")
        with pytest.raises(UsageError, match=r"^--log mlflow: "):
            RunDirectory(tmp_path / "run", run.config, log="mlflow")
        assert len(tried) == 4, "as its own variable says"
        server.shutdown(socket.SHUT_RDWR)
    assert not holds_run(tmp_path / "run")


def mlflow_store(folder: Path) -> Any:
    from mlflow import MlflowClient  # noqa: PLC0415

    return MlflowClient(tracking_uri=folder.as_uri())


@pytest.mark.timeout(400)  # two processes
def test_the_runs_of_a_sweep_are_an_experiment(tmp_path: Path) -> None:
    pytest.importorskip("mlflow", reason="needs the extra mlflow")
    done = coop.sweep(GRID, tmp_path / "study", jobs=2, stack=1, log=["mlflow"])
    assert not done.failed
    assert not list((tmp_path / "study").glob("*/tb")), "which --log does not name"
    store = mlflow_store(tmp_path / "study" / "mlruns")
    (experiment,) = [each for each in store.search_experiments() if each.name != "Default"]
    runs = store.search_runs([experiment.experiment_id])
    assert experiment.name == "study"
    assert {each.info.run_name for each in runs} == set(done.runs.index)
    assert {each.data.params["replay.capacity"] for each in runs} == {"60", "90"}
    assert {each.data.tags["coop.replay.capacity"] for each in runs} == {"60", "90"}
    means = done.runs["return_mean_100"].to_dict()
    assert {each.info.run_name: each.data.metrics["final/return_mean_100"] for each in runs} == pytest.approx(means)


@pytest.mark.timeout(400)  # two processes
def test_the_runs_of_a_sweep_are_a_group_with_tags(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("wandb", reason="needs the extra wandb")
    from wandb.proto.wandb_internal_pb2 import Record  # noqa: PLC0415

    monkeypatch.setenv("WANDB_MODE", "offline")
    monkeypatch.setenv("WANDB_TAGS", "mine")
    done = coop.sweep(GRID, tmp_path / "study", jobs=1, stack=1, log="wandb")
    assert not done.failed
    for name, row in done.runs.iterrows():
        (file,) = (tmp_path / "study" / str(name)).glob("wandb/offline-run-*/*.wandb")
        found = [Record.FromString(data) for data in records(file)]
        (run,) = [record.run for record in found if record.HasField("run")][:1]
        assert (run.run_group, run.display_name) == ("study", name)
        assert {*run.tags} == {"mine", "method=dqn", "seed=3", f"replay.capacity={row['replay.capacity']}"}
        final = {item.key or item.nested_key[0]: item.value_json for each in found for item in each.history.item}
        assert json.loads(final["final/return_mean_100"]) == pytest.approx(row["return_mean_100"])
        assert [record.exit.exit_code for record in found if record.HasField("exit")] == [0]


@pytest.mark.timeout(400)  # two processes
def test_hparams_compare_the_cells_of_a_grid(tmp_path: Path) -> None:
    done = coop.sweep(GRID, tmp_path, jobs=1, stack=1)
    multiplexer = EventMultiplexer().AddRunsFromDirectory(str(tmp_path)).Reload()
    context = Context(TBContext(data_provider=MultiplexerDataProvider(multiplexer, str(tmp_path))))
    asked = api_pb2.GetExperimentRequest(experiment_name="", include_metrics=True)
    shown = get_experiment.Handler(RequestContext(), context, "", asked).run()
    assert {each.name for each in shown.hparam_infos} == {"method", "seed", "replay.capacity"}
    assert "final/return_mean_100" in {each.name.tag for each in shown.metric_infos}
    statuses = [api_pb2.STATUS_UNKNOWN, api_pb2.STATUS_SUCCESS, api_pb2.STATUS_FAILURE, api_pb2.STATUS_RUNNING]
    request = api_pb2.ListSessionGroupsRequest(
        experiment_name="", allowed_statuses=statuses, start_index=0, slice_size=10, include_metrics=True
    )
    for info in shown.metric_infos:
        request.col_params.add(metric=info.name)
    rows = list_session_groups.Handler(RequestContext(), context, "", request).run().session_groups
    found = {}
    for row in rows:
        values = {each.name.tag: each.value for each in row.metric_values}
        found[int(row.hparams["replay.capacity"].number_value)] = values["final/return_mean_100"]
        assert row.sessions[0].status == api_pb2.STATUS_SUCCESS
    assert found == pytest.approx(done.runs.set_index("replay.capacity")["return_mean_100"].to_dict())


def test_tensorboards_hparams_show_settings_and_metrics(tmp_path: Path) -> None:
    """Asks the plugin itself, as its page does."""
    run = Lockstep(base_config(["--method", "coop"]))
    for name in ("one", "two"):
        with RunDirectory(tmp_path / name, run.config) as directory:
            play(run, directory, 1)
    run.env.close()
    multiplexer = EventMultiplexer().AddRunsFromDirectory(str(tmp_path)).Reload()
    context = Context(TBContext(data_provider=MultiplexerDataProvider(multiplexer, str(tmp_path))))
    asked = api_pb2.GetExperimentRequest(experiment_name="", include_metrics=True)
    shown = get_experiment.Handler(RequestContext(), context, "", asked).run()
    assert {"replay.capacity", "learner.learning_rate", "method"} <= {each.name for each in shown.hparam_infos}
    assert {"charts/episodic_return", "losses/td_loss"} <= {each.name.tag for each in shown.metric_infos}


def broken(method: str) -> type[Sink]:
    """A user's sink, one of whose methods would end the process."""

    def fail(self: Sink, *given: object) -> None:
        sys.exit("no luck\nat all")

    return type(method, (Sink,), {method: property(fail) if method == "problem" else fail})


broken_in_init, broken_in_begin = broken("__init__"), broken("begin")
broken_in_episode, broken_in_metrics, broken_in_problem = broken("episode"), broken("metrics"), broken("problem")
broken_in_evaluation, broken_in_film = broken("evaluation"), broken("film")
broken_in_conclude, broken_in_close = broken("conclude"), broken("close")


def test_a_sink_that_fails_does_not_end_the_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    later = ("episode", "metrics", "problem", "evaluation", "film", "conclude", "close")
    run = Lockstep(base_config(["--method", "coop"]))
    names = [f"{__name__}:broken_in_{method}" for method in later]
    with RunDirectory(tmp_path / "run", run.config, log=names) as directory:
        play(run, directory)
        directory.evaluation(EvaluationRow(run.step, 0, 1, 1, 5.0, 0.0, 0.0, 1.0))
        directory.film(b"", run.step)
        directory.conclude(summarise(run.trainer, "complete", 0.0, 0), "run")
    run.env.close()
    lines = capsys.readouterr().out.splitlines()
    raised = r"SystemExit: no luck \(test_sinks\.py:\d+\); the run goes on without it"
    assert len(lines) == len(names)
    for name in names:
        assert [line for line in lines if re.fullmatch(f"{re.escape(str(tmp_path))}/run: --log {name}: {raised}", line)]
    assert len((tmp_path / "run" / "episodes.csv").read_text().splitlines()) > 3
    assert read_summary(tmp_path / "run")["exit"] == "complete"
    for name in ("init", "begin"):
        with pytest.raises(UsageError, match=rf"^--log {__name__}:broken_in_{name}: SystemExit: no luck \(test_sinks"):
            RunDirectory(tmp_path / "other", run.config, log=f"{__name__}:broken_in_{name}")
    assert not holds_run(tmp_path / "other")


def test_a_signal_in_a_sink_ends_the_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def arrives(sink: Sink) -> None:
        raise Signalled(signal.SIGTERM)

    sinks = ChosenSinks(RecordedRun(tmp_path, 7, ""), [f"{__name__}:broken_in_close"])
    with pytest.raises(Signalled):
        sinks.tell(arrives)
    assert not capsys.readouterr().out


def test_sinks_are_refused_by_name(tmp_path: Path) -> None:
    assert chosen_sinks("none") == ()
    assert chosen_sinks(["tensorboard"]) == chosen_sinks("tensorboard, tensorboard") == ("tensorboard",)
    done = run_command("coop-lockstep", "--log", "tensorbord", "--run-dir", tmp_path / "run")
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith("coop-lockstep: error: log = 'tensorbord': ")
    assert not (tmp_path / "run").exists()


def test_what_is_not_installed_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    check_extra("--json", "json", "json")
    with pytest.raises(UsageError, match=r"^--x: needs the extra 'x': pip install 'coop-rl\[x\]'$"):
        check_extra("--x", "x", "no_such_module")


def test_flags_are_refused_before_anything_starts(tmp_path: Path) -> None:
    done = run_command("coop-local", "--prometheus", "x", "--run-dir", tmp_path / "run")
    assert (done.returncode, done.stderr) == (
        2,
        "coop-local: error: --prometheus x: PORT or HOST:PORT with a port from 0 to 65535 is needed\n",
    )
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("command", "flags", "refused"),
    [
        ("coop-local", ("--prometheus", "{busy}"), "--prometheus {busy}"),
        ("coop-local", ("--web", "{free}", "--prometheus", "{free}"), "--prometheus {free}"),
        ("coop-learner", ("--prometheus", "{busy}"), "--prometheus {busy}"),
        ("coop-learner", ("--health", "{busy}"), "--health {busy}"),
        ("coop-replay", ("--health", "{busy}"), "--health {busy}"),
        ("coop-actor", ("--health", "{busy}"), "--health {busy}"),
        ("coop-router", ("--health", "{busy}"), "--health {busy}"),
    ],
)
def test_a_port_in_use_is_refused_before_anything_starts(
    tmp_path: Path, command: str, flags: tuple[str, ...], refused: str
) -> None:
    with socket.create_server(("127.0.0.1", 0)) as other:
        ports = {"busy": other.getsockname()[1], "free": free_endpoint().rpartition(":")[2]}
        done = run_command(command, *(flag.format(**ports) for flag in flags), cwd=tmp_path)
    expected = f"{command}: error: {refused.format(**ports)}: Address already in use\n"
    assert (done.returncode, done.stdout, done.stderr) == (2, "", expected)
    assert not list(tmp_path.iterdir())
