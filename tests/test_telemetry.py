"""What metrics.jsonl says of the samples of an interval."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from common.settings.sources import base_config
from experiments.lockstep import Lockstep
from learner.records.run_directory import RunDirectory
from learner.telemetry import reuse_histogram


@pytest.mark.parametrize(
    ("reuse", "histogram"),
    [
        ([1, 1, 1], [3]),
        ([1, 2, 3, 4, 7, 8], [1, 2, 2, 1]),
        ([16], [0, 0, 0, 0, 1]),
        ([2**31 - 1, 1], [1, *[0] * 29, 1]),
    ],
)
def test_reuse_histogram(reuse: list[int], histogram: list[int]) -> None:
    assert reuse_histogram(np.array(reuse, np.int32)) == histogram


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
        assert sum(row["reuse_histogram"]) == 200 * 32
        if replacement:
            assert 21.5 < 32 * row["distinct_share"] < 23
        else:
            assert row["distinct_share"] == 1
    # Held for 40 updates at 0.8 draws each, a sample is seldom drawn for the first time.
    first, *_, last = rows[1]["reuse_histogram"]
    assert 200 * 0.5 < first <= 260
    assert last > 0
