"""Processor time of the check of what environments give: `python benchmarks/promises.py`.

Lockstep CartPole, and an actor's turns on gymnasium's environments with pictures; with and without the check in turn,
in one process. Prints steps per second of processor time, and the ratio of the two: median and quartiles of the
turns. Emulators of ALE's games come behind no such check.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from itertools import cycle, islice
from typing import Any

import numpy as np

from coop.actors.player import Player
from coop.actors.policy import EpsilonGreedy
from coop.common.envs import gymnasium_env
from coop.common.envs.checked import CheckedEnv
from coop.common.envs.make import make_vector_env
from coop.common.networks.network import FlatNetwork, build_network
from coop.common.settings.environment import EnvSettings
from coop.common.types import Array
from coop.lockstep.lockstep import Lockstep
from coop.records.run_options import base_config


class Trusted(CheckedEnv):
    """The environment alone."""

    def reset(self, seed: int | None = None) -> Array:
        return self._env.reset(seed=seed)[0]  # type: ignore[no-any-return]

    def step(self, action: np.integer[Any]) -> tuple[Array, float, bool, bool]:
        observation, reward, terminated, truncated, _ = self._env.step(action)
        return observation, float(reward), terminated, truncated


def lockstep(steps: int) -> Callable[[], None]:
    """So many steps of a new run of CartPole, with their updates."""
    run = Lockstep(replace(base_config([]), total_steps=10**6))

    def play() -> None:
        for _ in range(steps):
            for _ in run.play():
                pass

    return play


def actor(env_id: str, envs: int, steps: int) -> Callable[[], None]:
    """So many steps of an actor's emulators."""
    env = make_vector_env(EnvSettings(id=env_id), envs, 0)
    first, second = (FlatNetwork(build_network("mlp", env.spec, (32,), seed=seed)) for seed in (0, 1))
    player = Player(env, EpsilonGreedy((first, second), env.spec, np.random.default_rng(0)), lambda _: 0.1)
    player.begin()

    def play() -> None:
        for _ in range(steps // envs):
            player.send(0, 0)
            player.recv()

    return play


def measured(play: Callable[[], None], steps: int) -> float:
    """Steps per second of this process's processor time."""
    began = time.process_time()
    play()
    return steps / (time.process_time() - began)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--turns", type=int, default=15)
    parser.add_argument("--steps", type=int, default=400)
    given = parser.parse_args()
    for name, make in {
        "lockstep, CartPole-v0": lockstep,
        "actor, MinAtar/Breakout-v1": partial(actor, "MinAtar/Breakout-v1", 8),
        "actor, coop/Catch-v0": partial(actor, "coop/Catch-v0", 8),
    }.items():
        plays = []
        for kind in (CheckedEnv, Trusted):
            gymnasium_env.CheckedEnv = kind  # type: ignore[misc]
            plays.append(make(given.steps))
            measured(plays[-1], given.steps)  # warm
        rates: tuple[list[float], list[float]] = ([], [])
        for each in islice(cycle((0, 1)), 2 * given.turns):
            rates[each].append(measured(plays[each], given.steps))
        low, middle, high = statistics.quantiles(checked / trusted for checked, trusted in zip(*rates, strict=True))
        print(
            f"{name}: {statistics.median(rates[0]):,.0f} steps/s with the check, {statistics.median(rates[1]):,.0f} "
            f"without; ratio {middle:.3f} ({low:.3f} to {high:.3f})",
            flush=True,
        )


if __name__ == "__main__":
    main()
