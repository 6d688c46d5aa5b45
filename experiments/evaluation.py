"""Greedy evaluation: plays a saved network without exploration."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from actors.player import Player
from actors.policy import Policy
from common.envs.make import make_vector_env
from common.errors import UsageError
from common.settings.tables import load_tables, resolve
from learner.qnetwork import make_network
from learner.records.epochs import complete_epochs, load_learner

CPU = torch.device("cpu")


@dataclass(frozen=True)
class Evaluation:
    """Unclipped returns of full episodes, played by `network` (1 or 2) of the checkpoint `epoch`."""

    epoch: int
    network: int
    returns: list[float]


def evaluate(run_dir: Path, episodes: int, seed: int) -> Evaluation:
    """Play the acting network of a run's newest checkpoint greedily.

    seed: of the emulator; the derived seed differs from those of the run's emulators.

    Raises:
        UsageError: the folder holds no run, or no checkpoint.
    """
    if not (run_dir / "config.toml").is_file():
        raise UsageError(f"{run_dir}: holds no run")
    config = resolve(load_tables(None, run_dir / "config.toml"))
    epochs = complete_epochs(run_dir)
    if not epochs:
        raise UsageError(f"{run_dir}: has no complete checkpoint")
    state = load_learner(run_dir / "checkpoints" / str(epochs[-1]))["agent"]
    emulator = np.random.SeedSequence([config.seed, 4, seed]).generate_state(1)
    env = make_vector_env(config.env, 1, int(emulator[0]))
    networks = [make_network(config, env.spec, number, CPU) for number in (0, 1)]
    for network, flat in zip(networks, state["networks"], strict=True):
        network.load(flat)
    policy = Policy((networks[0], networks[1]), env.spec, np.random.default_rng(seed))
    policy.acting = state["acting"]
    player = Player(env, policy, epsilon=lambda _: 0.0)
    player.begin()
    returns: list[float] = []
    while len(returns) < episodes:
        player.send(0, 0)
        returns += [episode.episode_return for episode in player.recv().ended.values()]
    env.close()
    return Evaluation(epochs[-1], policy.acting + 1, returns)
