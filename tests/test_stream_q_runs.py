"""Runs of Stream Q(lambda): their files, their policies, and their place in sweeps and reports."""

from pathlib import Path

import numpy as np
import onnxruntime
import pytest
import torch
from commands import run_command
from safetensors.numpy import load_file

import coop
from coop.common.networks.normalised import NormalisedNetwork
from coop.common.settings.stream_q import StreamQSettings
from coop.common.settings.tables import resolve, to_toml
from coop.evaluation.export import export
from coop.studies.report.comparisons import paired_table, sizes_table
from coop.studies.report.figures import buffers, figures
from coop.studies.report.plots import draw
from coop.studies.report.results import aggregate_table, breaking_table, settings_table, tables
from coop.studies.report.study import Study, load_study
from coop.studies.sweep.grid import load_grid


@pytest.fixture(scope="module")
def run_dir(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of 600 steps by its command."""
    path = tmp_path_factory.mktemp("run") / "run"
    flags = ["--method", "stream-q", "--total-steps", "600", "--network.hidden", "16", "8", "--run-dir", str(path)]
    done = run_command("coop-lockstep", *flags, check=True)
    assert "complete: 600 steps, 600 updates" in done.stdout
    assert done.stderr == ""
    return path


def test_a_run_writes_what_every_run_writes(run_dir: Path) -> None:
    run = coop.load(run_dir)
    assert run.summary is not None
    assert (run.summary["updates"], run.summary["transitions_accepted"]) == (600, 600)
    assert run.config.method_settings == StreamQSettings()
    rows = run.metrics
    assert list(rows["update"]) == [200, 400, 600]
    assert set(rows["replay_size"]) == {0}
    assert set(rows["q_gap"]) == {0.0}
    np.testing.assert_allclose(rows["epsilon"], 0.01)
    assert len(run.episodes) > 10
    assert (run.episodes["q1_mean"] == run.episodes["q2_mean"]).all()


def test_the_policy_of_a_run_standardizes_as_the_agent_did(run_dir: Path) -> None:
    run = coop.load(run_dir)
    network = run.checkpoint().networks[0]
    assert isinstance(network.in_numpy, NormalisedNetwork)
    assert (network.in_numpy.sd != 1).all()
    obs = np.random.default_rng(0).standard_normal((5, 4)).astype(np.float32)
    mean, sd = network.snapshot()[:4], network.snapshot()[4:8]
    with torch.no_grad():
        _, *layers = network.module.children()
        expected = torch.nn.Sequential(*layers)(torch.from_numpy((obs - mean) / sd)).numpy()
    np.testing.assert_allclose(run.policy().q_values(obs), expected, rtol=1e-4, atol=1e-5)
    assert len(coop.evaluate(run.policy(), episodes=2).returns) == 2


def test_its_networks_are_exported(run_dir: Path, tmp_path: Path) -> None:
    done = export(run_dir, tmp_path / "out")
    assert done.without_onnx == ""
    tensors = load_file(tmp_path / "out" / "network-1.safetensors")
    assert tensors["standardize.sd"].shape == (4,)
    obs = np.random.default_rng(0).standard_normal((3, 4)).astype(np.float32)
    session = onnxruntime.InferenceSession(tmp_path / "out" / "network-1.onnx")
    (values,) = session.run(None, {"obs": obs})
    np.testing.assert_allclose(values, coop.load(run_dir).q_values(obs), rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("command", ["coop-local", "coop-learner"])
def test_distributed_commands_refuse_it_in_one_line(command: str, tmp_path: Path) -> None:
    flags = ["--method", "stream-q", "--run-dir", str(tmp_path / "run")]
    done = run_command(command, *flags)
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)
    assert "method = 'stream-q': in lockstep runs only; it has no replay buffer to share" in done.stderr
    assert not (tmp_path / "run").exists()


GRID = """
methods = ["dqn", "stream-q"]
seeds = [0, 1]
fixed.total_steps = 300
vary.replay.capacity = [100, 2000]
vary.env.max_episode_steps = [50, 60]
"""


def test_a_sweep_over_buffers_has_one_cell_for_it(tmp_path: Path) -> None:
    (tmp_path / "grid.toml").write_text(GRID)
    names = [cell.name for cell in load_grid(str(tmp_path / "grid.toml")).cells]
    assert len(names) == 2 * (4 + 2)
    assert [name for name in names if name.startswith("stream-q") and name.endswith("seed=1")] == [
        "stream-q-max_episode_steps=50-seed=1",
        "stream-q-max_episode_steps=60-seed=1",
    ]


@pytest.fixture
def study(tmp_path: Path) -> Study:
    """Returns: dqn 100 + seed with 100 transitions, 150 + seed with 2,000; stream-q 120 + 2 seeds; two evictions."""
    for seed in (0, 1):
        for eviction in ("fifo", "reservoir"):
            for capacity, value in ((100, 100.0), (2000, 150.0)):
                write_run(tmp_path, "dqn", seed, value + seed, capacity, eviction)
        write_run(tmp_path, "stream-q", seed, 120.0 + 2 * seed, 5000, "fifo")
    return load_study(tmp_path)


def write_run(folder: Path, method: str, seed: int, value: float, capacity: int, eviction: str) -> None:
    path = folder / f"{method}-{capacity}-{eviction}-{seed}"
    path.mkdir()
    config = {
        "method": method,
        "seed": seed,
        "replay": {"capacity": capacity, "eviction": eviction, "learning_starts": 9},
    }
    (path / "config.toml").write_text(to_toml(resolve(config)))
    (path / "summary.json").write_text('{"exit": "complete"}')
    lines = "".join(f"{n},{20 * (n + 1)},{value},0,1,1\n" for n in range(30))
    (path / "episodes.csv").write_text(f"episode,env_step,return,s,q1_mean,q2_mean\n{lines}")
    (path / "metrics.jsonl").touch()


def test_in_figures_over_sizes_it_is_a_line_from_size_0(study: Study, tmp_path: Path) -> None:
    assert study.axes == ("replay.capacity", "replay.eviction")
    figure = buffers(study)
    for panel in figure.panels:
        (line,) = (line for line in panel.lines if line.label == "stream-q")
        assert list(line.x) == ([0, 100, 2000] if panel.title == "eviction fifo" else [100, 2000])
        assert set(line.y.value) == {121.0}
        assert line.dashed
    assert figure.counts == "dqn: 8 runs, seeds 0,1; stream-q: 2 runs, seeds 0,1"
    draw(figure, tmp_path / "figure.png")


def test_in_tables_it_has_size_0_and_is_compared_with_every_size(study: Study) -> None:
    rows = [row[:4] for row in settings_table(study).rows if row[0] == "stream-q"]
    assert rows == [["stream-q", 0, "fifo", 121.0]]
    paired = [row[1:5] for row in paired_table(study).rows if row[0] == "return of the last 100"]
    assert paired == [
        ["capacity 100, eviction fifo", "stream-q", "dqn", 20.5],
        ["capacity 100, eviction reservoir", "stream-q", "dqn", 20.5],
        ["capacity 2000, eviction fifo", "stream-q", "dqn", -29.5],
        ["capacity 2000, eviction reservoir", "stream-q", "dqn", -29.5],
        ["all", "stream-q", "dqn", -4.5],
    ]
    assert [row[1:3] for row in sizes_table(study).rows if row[0] == "all"] == [["dqn", 100.5]]
    assert [row[:2] for row in aggregate_table(study).rows] == [["dqn", 125.5]]
    assert [row[:3] for row in breaking_table(study).rows] == [["fifo", "dqn", 2000], ["reservoir", "dqn", 2000]]
    assert len(tables(study)) > 5


def test_alone_it_is_reported_too(tmp_path: Path) -> None:
    write_run(tmp_path, "stream-q", 0, 100.0, 5000, "fifo")
    study = load_study(tmp_path)
    assert study.axes == ()
    made, lacking = figures(study)
    assert made
    assert any("breaking points: replay.capacity is the same" in line for line in lacking)
    assert tables(study)
