"""Steps per second of lockstep runs against Stable-Baselines3's DQN: `python benchmarks/lockstep.py [--rounds 15]`.

CartPole, one update per step, batch 32, three hidden layers of 128, one thread, no double-style targets (theirs has
none). All run in one process and take turns: a round plays the same number of steps with each. Prints the median steps
per second, and the median ratio to Stable-Baselines3 in the same round with its quartiles. Needs the extra `bench`.
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import gymnasium
from stable_baselines3 import DQN
from stable_baselines3.common.logger import Logger

from common.process.threads import use_threads
from common.settings.sources import base_config
from experiments.lockstep import Lockstep
from learner.records.run_directory import RunDirectory

METHODS = ("dqn", "edql", "g-coop", "coop")
WARM_UP = 500  # steps, more than either collects before it learns


def rival() -> Callable[[int], None]:
    """Make a function that plays a number of steps with Stable-Baselines3's DQN, configured like the preset."""
    model = DQN(
        "MlpPolicy",
        gymnasium.make("CartPole-v1", max_episode_steps=200),
        learning_rate=3e-4,
        buffer_size=5000,
        learning_starts=128,
        batch_size=32,
        train_freq=1,
        gradient_steps=1,
        target_update_interval=30,
        exploration_final_eps=0.05,
        policy_kwargs={"net_arch": [128, 128, 128]},
        seed=0,
        device="cpu",
    )
    model.set_logger(Logger(None, []))

    def play(steps: int) -> None:
        model.learn(steps, log_interval=10**9, reset_num_timesteps=False)

    return play


def ours(method: str, path: Path) -> Callable[[int], None]:
    """Make a function that plays a number of steps in lockstep, including the run's files."""
    config = base_config(["--preset", "cartpole-paper", "--method", method])
    run = Lockstep(replace(config, learner=replace(config.learner, double=False)))
    directory = RunDirectory(path, run.config)

    def play(steps: int) -> None:
        for _ in range(steps):
            for effects in run.play():
                directory.record(effects.episodes, effects.metrics)

    return play


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=15)
    parser.add_argument("--steps", type=int, default=500, help="of each, in a round")
    options = parser.parse_args()
    use_threads(1)
    with tempfile.TemporaryDirectory() as folder:
        players = {"sb3 dqn": rival(), **{name: ours(name, Path(folder) / name) for name in METHODS}}
        for play in players.values():
            play(WARM_UP)
        speeds: dict[str, list[float]] = {name: [] for name in players}
        for _ in range(options.rounds):
            for name, play in players.items():
                began = time.perf_counter()
                play(options.steps)
                speeds[name].append(options.steps / (time.perf_counter() - began))
    for name, values in speeds.items():
        ratios = [value / base for value, base in zip(values, speeds["sb3 dqn"], strict=True)]
        low, middle, high = statistics.quantiles(ratios, n=4)
        print(f"{name:8s} {statistics.median(values):6.0f} steps/s   ratio {middle:.2f} ({low:.2f}..{high:.2f})")


if __name__ == "__main__":
    main()
