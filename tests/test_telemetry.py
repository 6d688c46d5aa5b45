"""What metrics.jsonl says of the samples of an interval, and what TensorBoard's file says of a run."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from coop.learner.telemetry import powers_of_two
from coop.lockstep.lockstep import Lockstep
from coop.records.run_directory import RunDirectory
from coop.records.run_options import base_config


@pytest.mark.parametrize(
    ("values", "counts"),
    [
        ([0, 0], [2]),
        ([1, 1, 1], [0, 3]),
        ([0, 1, 2, 3, 4, 7, 8], [1, 1, 2, 2, 1]),
        ([16], [0, 0, 0, 0, 0, 1]),
        ([2**31 - 1, 1], [0, 1, *[0] * 29, 1]),
    ],
)
def test_counts_by_powers_of_two(values: list[int], counts: list[int]) -> None:
    assert powers_of_two(np.array(values, np.int64)) == counts


@pytest.mark.parametrize("replacement", [True, False])
def test_reuse_and_distinct_samples_of_a_small_table(replacement: bool, tmp_path: Path) -> None:
    """40 transitions, 32 drawn of them: 40 (1 - (1 - 1/40)^32) = 22.2 distinct ones with replacement, 32 without."""
    config = base_config(["--preset", "cartpole-paper", "--method", "dqn"])
    replay = replace(config.replay, capacity=40, learning_starts=40, replacement=replacement)
    run = Lockstep(replace(config, replay=replay))
    with RunDirectory(tmp_path, run.config) as directory:
        for _ in range(500):
            for effects in run.play():
                directory.record(effects.episodes, effects.metrics)
    run.env.close()
    rows = [json.loads(line) for line in (tmp_path / "metrics.jsonl").read_text().splitlines()]
    assert len(rows) == 2
    for row in rows:
        assert sum(row["reuse_histogram"]) == sum(row["sample_age_histogram"]) == 200 * 32
        assert len(row["sample_age_histogram"]) <= 7, "fifo evicts what is older than 40 steps"
        if replacement:
            assert 21.5 < 32 * row["distinct_share"] < 23
        else:
            assert row["distinct_share"] == 1
    # Held for 40 updates at 0.8 draws each, a sample is seldom drawn for the first time.
    first, *_, last = rows[1]["reuse_histogram"]
    assert 200 * 0.5 < first <= 260
    assert last > 0


def test_tensorboard_has_the_usual_names(tmp_path: Path) -> None:
    run = Lockstep(base_config(["--method", "coop"]))
    with RunDirectory(tmp_path, run.config) as directory:
        rows = []
        while len(rows) < 2:
            for effects in run.play():
                directory.record(effects.episodes, effects.metrics)
                rows += [effects.metrics] if effects.metrics else []
    run.env.close()
    board = EventAccumulator(str(tmp_path / "tb"), size_guidance={"scalars": 0, "histograms": 0, "tensors": 0}).Reload()
    episodes = [line.split(",") for line in (tmp_path / "episodes.csv").read_text().splitlines()[1:]]
    for tag, column in (("charts/episodic_return", 5), ("charts/episodic_length", 6)):
        recorded = [(event.step, event.value) for event in board.Scalars(tag)]
        assert recorded == [(int(episode[1]), float(episode[column])) for episode in episodes]
    for tag, name in (
        ("charts/SPS", "env_steps_per_s"),
        ("charts/epsilon", "epsilon"),
        ("losses/td_loss", "loss"),
        ("losses/q_values", f"q{rows[-1]['acting']}_mean"),
        ("train/q_gap", "q_gap"),
    ):
        event = board.Scalars(tag)[-1]
        assert (event.step, event.value) == (rows[-1]["env_step"], pytest.approx(rows[-1][name]))
    age, reuse = (board.Histograms(tag)[-1].histogram_value for tag in ("replay/sample_age", "replay/reuse"))
    assert list(age.bucket) == rows[-1]["sample_age_histogram"]
    assert list(age.bucket_limit) == [2.0**power for power in range(len(age.bucket))]
    assert list(reuse.bucket) == rows[-1]["reuse_histogram"]
    assert list(reuse.bucket_limit) == [2.0 ** (1 + power) for power in range(len(reuse.bucket))]
    (text,) = board.Tensors("hyperparameters")
    assert b"|method|coop|\n|seed|0|\n" in text.tensor_proto.string_val[0]
