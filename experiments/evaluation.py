"""Evaluation: plays full episodes by a policy, without exploration."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from common.envs.make import make_vector_env
from common.errors import UsageError
from common.settings.environment import EnvSettings
from common.settings.tables import resolve
from common.types import Array
from experiments.saved import SavedPolicy, SavedRun

Acting = Callable[[Array], Any]


@dataclass(frozen=True)
class Evaluation:
    """Unclipped returns of full episodes."""

    returns: list[float]

    @property
    def mean(self) -> float:
        """Mean return."""
        return statistics.fmean(self.returns)

    @property
    def sd(self) -> float:
        """Standard deviation of the returns."""
        return statistics.pstdev(self.returns)


@dataclass(frozen=True)
class CheckpointEvaluation(Evaluation):
    """Returns of the acting `network` (1 or 2) of the checkpoint `epoch`."""

    epoch: int
    network: int


def play(policy: Acting, env: EnvSettings, episodes: int, seed: int) -> list[float]:
    """Play full episodes and return their unclipped returns.

    policy: gives an action for a batch of one stacked observation, <frame_dtype>[1, *obs_shape]. seed: of the emulator.
    """
    emulator = make_vector_env(env, 1, seed)
    returns: list[float] = []
    total = 0.0
    try:
        obs = emulator.reset()
        while len(returns) < episodes:
            steps = emulator.step(np.asarray(policy(obs), np.int32).reshape(1))
            obs = steps.obs
            total += float(steps.raw_rewards[0])
            if steps.episode_over[0]:
                returns.append(total)
                total = 0.0
    finally:
        emulator.close()
    return returns


def evaluate(
    policy: Acting, episodes: int = 20, env: str | Mapping[str, Any] | None = None, seed: int = 0
) -> Evaluation:
    """Play full episodes by a policy in its own environment, or in another one.

    Args:
        policy: of `SavedRun.policy`, or any function of a batch of one stacked observation that gives an action.
        env: an environment's id; or settings that replace those of the policy's environment, as a table
            ({"kwargs": {"side": 12}}).
        seed: of the emulator.

    Raises:
        UsageError: there are no episodes to play; a function without an environment of its own got none.
    """
    if episodes < 1:
        raise UsageError(f"episodes = {episodes}: must be at least 1")
    own = policy.env if isinstance(policy, SavedPolicy) else None
    if env is None and own is None:
        raise UsageError("env: a policy that no run has trained needs one")
    changes = {"id": env} if isinstance(env, str) else dict(env or {})
    settings = resolve({"env": {**(asdict(own) if own else {}), **changes}}).env
    return Evaluation(play(policy, settings, episodes, seed))


def evaluate_checkpoint(run_dir: Path, episodes: int, seed: int) -> CheckpointEvaluation:
    """Play the acting network of a run's newest checkpoint greedily.

    seed: of the emulator; the derived seed differs from those of the run's emulators.

    Raises:
        UsageError: the folder holds no run, or no checkpoint.
    """
    run = SavedRun(run_dir)
    checkpoint = run.checkpoint()
    number = checkpoint.acting + 1
    emulator = np.random.SeedSequence([run.config.seed, 4, seed]).generate_state(1)
    policy = SavedPolicy(run.config.env, checkpoint.spec, (checkpoint.networks[checkpoint.acting],))
    returns = play(policy, run.config.env, episodes, int(emulator[0]))
    return CheckpointEvaluation(returns, checkpoint.epoch, number)
