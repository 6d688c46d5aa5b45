"""Speed on MinAtar against Stable-Baselines3's DQN: `python benchmarks/minatar_speed.py [--game breakout]`.

Network, batch, optimizer and one update a step are those of the preset `minatar-GAME`, in both. Measured are lockstep
runs, which act, play, store and sample as well, and updates alone, each from its own replay; on one thread, each in a
process of its own, in turns: a round is one turn of each. In the rival's process, denormal numbers count as 0; without
that its optimizer makes it three times as slow for hundreds of updates at a time. The tables give the median
(lowest..highest) over the rounds of steps or updates per second and of their ratio to Stable-Baselines3's in the same
round, beside the arithmetic of an update.
Needs the extras `bench` and `minatar`.
"""

from __future__ import annotations

import argparse
import multiprocessing
import statistics
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from multiprocessing.connection import Connection
from pathlib import Path

import gymnasium
import numpy as np
import torch
from stable_baselines3 import DQN
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import nn
from torch.utils.flop_counter import FlopCounterMode

from common.networks.network import build_network
from common.process.threads import use_threads
from common.settings.config import RunConfig
from common.settings.methods import METHODS
from common.settings.sources import base_config
from common.types import EnvSpec
from experiments.lockstep import Lockstep
from learner.records.run_directory import RunDirectory

SB3 = "sb3 dqn"
START = 500  # steps before the first update

Turn = Callable[[int], object]


class Player:
    """One subject: `play` does a number of lockstep steps, `update` a number of updates."""

    def __init__(self, play: Turn, update: Turn) -> None:
        self.play, self.update = play, update


class Features(BaseFeaturesExtractor):
    """The preset's network up to its last ReLU, for pictures of height x width x channels."""

    def __init__(self, space: gymnasium.spaces.Box, body: nn.Sequential, width: int) -> None:
        super().__init__(space, width)
        self.body = body

    def forward(self, pictures: torch.Tensor) -> torch.Tensor:
        return self.body(pictures.permute(0, 3, 1, 2))


class Numbers(gymnasium.ObservationWrapper):
    """Bool pictures as the 0 and 1 that Stable-Baselines3 takes, in bytes."""

    def __init__(self, env: gymnasium.Env) -> None:
        super().__init__(env)
        self.observation_space = gymnasium.spaces.Box(0, 1, env.observation_space.shape, np.uint8)

    def observation(self, observation: np.ndarray) -> np.ndarray:
        return observation.view(np.uint8)


def rival(config: RunConfig, spec: EnvSpec) -> Player:
    """Stable-Baselines3's DQN, configured like the preset."""
    learner, replay = config.learner, config.replay
    body = build_network(config.network.kind, spec, config.network.hidden, 0)[:-1]
    rmsprop = {"alpha": learner.alpha, "eps": learner.eps, "momentum": learner.momentum}
    adam = {"betas": (learner.beta1, learner.beta2), "eps": learner.eps}
    kind, options = {"rmsprop": (torch.optim.RMSprop, rmsprop), "adam": (torch.optim.Adam, adam)}[learner.optimizer]
    model = DQN(
        "MlpPolicy",
        Numbers(gymnasium.make(config.env.id)),
        learning_rate=learner.learning_rate,
        buffer_size=replay.capacity,
        learning_starts=START,
        batch_size=learner.batch_size,
        gamma=learner.gamma,
        train_freq=1,
        gradient_steps=1,
        target_update_interval=learner.swap_every,
        exploration_final_eps=config.actor.epsilon_final,
        policy_kwargs={
            "net_arch": [],
            "normalize_images": False,
            "features_extractor_class": Features,
            "features_extractor_kwargs": {"body": body, "width": body[-2].out_features},
            "optimizer_class": kind,
            "optimizer_kwargs": options,
        },
        seed=0,
        device="cpu",
    )
    model.set_logger(Logger(None, []))

    def play(steps: int) -> None:
        model.learn(steps, log_interval=10**9, reset_num_timesteps=False)

    return Player(play, lambda count: model.train(count, learner.batch_size))


def ours(config: RunConfig, path: Path) -> Player:
    """A lockstep run with its files."""
    run = Lockstep(config)
    directory = RunDirectory(path, config)

    def play(steps: int) -> None:
        for _ in range(steps):
            for effects in run.play():
                directory.record(effects.episodes, effects.metrics)

    def update(count: int) -> None:
        for _ in range(count):
            run.agent.update(run.memory.table.sample(config.learner.batch_size))

    return Player(play, update)


def arithmetic(update: Turn) -> float:
    """Millions of multiplications and additions in the matrix products of one update, as PyTorch counts them."""
    with FlopCounterMode(display=False) as counter:
        update(1)
    return counter.get_total_flops() / 1e6


def spread(values: list[float], digits: int) -> str:
    middle, low, high = statistics.median(values), min(values), max(values)
    return f"{middle:.{digits}f} ({low:.{digits}f}..{high:.{digits}f})"


class Subject:
    """A process with one player, which waits while the others have their turns."""

    def __init__(self, name: str, game: str) -> None:
        context = multiprocessing.get_context("spawn")
        self._turns, theirs = context.Pipe()
        context.Process(target=attend, args=(name, game, theirs), daemon=True).start()

    def ask(self, turn: str, count: int) -> float:
        """Seconds that the turn took; of `flops`, millions of operations."""
        self._turns.send((turn, count))
        return self._turns.recv()


def attend(name: str, game: str, turns: Connection) -> None:
    """What the process of a subject does: the turns that it is told."""
    use_threads(1)
    config = base_config(["--preset", f"minatar-{game}", "--method", "dqn" if name == SB3 else name])
    config = replace(config, replay=replace(config.replay, learning_starts=START))
    torch.set_flush_denormal(name == SB3)
    with tempfile.TemporaryDirectory() as folder:
        player = rival(config, Lockstep(config).env.spec) if name == SB3 else ours(config, Path(folder) / name)
        while True:
            try:
                turn, count = turns.recv()
            except EOFError:
                return
            if turn == "flops":
                turns.send(arithmetic(player.update))
                continue
            began = time.perf_counter()
            (player.play if turn == "steps" else player.update)(count)
            turns.send(time.perf_counter() - began)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    with_buffer = [name for name in METHODS.names() if METHODS.get(name).stream is None]
    parser.add_argument("methods", nargs="*", default=with_buffer)
    parser.add_argument("--game", default="breakout")
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--steps", type=int, default=300, help="of each, in a round; and as many updates")
    options = parser.parse_args()
    subjects = {name: Subject(name, options.game) for name in (SB3, *options.methods)}
    for subject in subjects.values():
        subject.ask("steps", START + options.steps)
        subject.ask("updates", options.steps)
    speeds: dict[str, dict[str, list[float]]] = {"steps": {}, "updates": {}}
    for _ in range(options.rounds):
        for name, subject in subjects.items():
            for unit, speed in speeds.items():
                speed.setdefault(name, []).append(options.steps / subject.ask(unit, options.steps))
    for unit, speed in speeds.items():
        print(f"{'':8}  {unit + '/s':24} {'ratio':24} MFLOP an update")
        for name, values in speed.items():
            ratios = [value / base for value, base in zip(values, speed[SB3], strict=True)]
            print(f"{name:8}  {spread(values, 0):24} {spread(ratios, 2):24} {subjects[name].ask('flops', 1):.0f}")


if __name__ == "__main__":
    main()
