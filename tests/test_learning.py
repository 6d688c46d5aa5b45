"""Every method finds the optimal action values of a small problem: in lockstep, and coop over the real topology."""

import csv
import json
import os
import statistics
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from commands import run_command
from corridor import CELLS, LEFT, RIGHT, optimal_values
from numpy.typing import NDArray

from coop.common.settings import schedules
from coop.common.settings.config import RunConfig
from coop.common.settings.tables import load_tables, resolve
from coop.learner.agent import Agent
from coop.lockstep.lockstep import Lockstep
from coop.records.learner_checkpoints import newest_checkpoint

pytestmark = pytest.mark.timeout(300)  # whole runs, also on a busy machine

CONFIG = """
total_steps = 2000
[env]
id = "corridor:test/Corridor-v0"
[network]
kind = "mlp"
hidden = [32]
[learner]
gamma = 0.8
optimizer = "adam"
learning_rate = 3e-3
learning_rate_final = 0.03
swap_every = 20
publish_every = 2
[edl]
rate = 0.05
decay = 0.5
decay_every = 500
[replay]
capacity = 500
learning_starts = 64
tolerance = 16
[actor]
epsilon_start = 1.0
epsilon_final = 0.5
epsilon_steps = 1000
epsilon_decay = "exponential"
segment_steps = 4
"""
BOUND = 0.001  # of |Q - Q*|; Q* lies between 0.26 and 1, and 96 runs over processes ended within 0.00005


@pytest.fixture
def config(tmp_path: Path) -> RunConfig:
    (tmp_path / "corridor.toml").write_text(CONFIG)
    return resolve(load_tables(None, tmp_path / "corridor.toml"))


def values(agent: Agent) -> list[NDArray[np.float32]]:
    """What both networks say of every cell and action, float32 [cells, actions]."""
    return list(agent.q_values(np.eye(CELLS, dtype=np.float32)))


@pytest.mark.parametrize("method", ["dqn", "edql", "g-coop", "coop"])
def test_optimal_values_are_found_in_lockstep(method: str, config: RunConfig) -> None:
    run = Lockstep(replace(config, method=method))
    while not run.trainer.outcome():
        for _ in run.play():
            pass
    run.env.close()
    assert run.trainer.outcome() == "complete"
    for q in values(run.agent):
        np.testing.assert_allclose(q, optimal_values(config.learner.gamma), atol=BOUND)
        assert (q[:, RIGHT] > q[:, LEFT]).all()


def test_coop_finds_optimal_values_over_the_real_topology(config: RunConfig, tmp_path: Path) -> None:
    flags = ["--config", tmp_path / "corridor.toml", "--method", "coop", "--actors", "2", "--run-dir", tmp_path / "run"]
    found = {**os.environ, "PYTHONPATH": str(Path(__file__).parent)}
    run_command("coop-local", *flags, environment=found, check=True)
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert summary["exit"] == "complete"
    assert summary["transitions_lost"] == 0
    # Both actors explore as the whole run asks for, not as their own half of the steps would (0.12 more). No actor
    # knows more steps than were inserted; one that waits for a core knows an older count, hence the median.
    with (tmp_path / "run" / "episodes.csv").open(encoding="utf-8") as file:
        recorded = [(int(row["env_step"]), float(row["epsilon"])) for row in csv.DictReader(file)]
    assert all(epsilon > schedules.epsilon(config.actor, step) for step, epsilon in recorded)
    late = [epsilon - schedules.epsilon(config.actor, step) for step, epsilon in recorded if 600 < step < 1600]
    assert len(late) > 20
    assert statistics.median(late) < 0.04
    checkpoint = newest_checkpoint(tmp_path / "run")
    assert checkpoint is not None
    run = Lockstep(replace(config, method="coop"))  # for a network of the right shape
    run.agent.load_state(checkpoint.state["agent"])
    run.env.close()
    for q in values(run.agent):
        np.testing.assert_allclose(q, optimal_values(config.learner.gamma), atol=BOUND)
