"""Plays full episodes by a policy, on several emulators at once."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from contextlib import closing
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from coop.common.arguments import as_array
from coop.common.envs.make import env_spec, make_vector_env
from coop.common.envs.protocol import VectorEnv
from coop.common.errors import CoopError, UsageError
from coop.common.imports import describe
from coop.common.messaging.messages.evaluate import EvaluationRow
from coop.common.networks.acting import ActingNetwork
from coop.common.networks.masks import allowed, random_actions
from coop.common.process.console import say
from coop.common.settings.config import RunConfig
from coop.common.types import Array, EnvSpec

Acting = Callable[..., Any]
"""Actions, int [envs], for observations <frame_dtype>[envs, *obs_shape]; in an environment with action masks it gets
those, bool [envs, actions], as well."""

T = TypeVar("T")

AT_ONCE = 8  # emulators, if nothing else is asked for


def play(env: VectorEnv, act: Acting, episodes: int, stopped: Callable[[], bool] = lambda: False) -> list[float]:
    """Play full episodes, and return their unclipped returns; fewer if `stopped` returns True after a step.

    Each emulator plays the same number of episodes, or one more: the first ones to end would be the short ones.
    """
    left = np.array([len(share) for share in np.array_split(np.arange(episodes), env.num_envs)])
    totals = np.zeros(env.num_envs)
    returns: list[float] = []
    obs = env.reset()
    while len(returns) < episodes and not stopped():
        steps = env.step(chosen(act, obs, env.spec, env.mask))
        obs = steps.obs
        totals += steps.raw_rewards
        for number in np.flatnonzero(steps.episode_over & (left > 0)).tolist():
            returns.append(float(totals[number]))
            left[number] -= 1
        totals[steps.episode_over] = 0.0
    return returns


def chosen(act: Acting, obs: Array, spec: EnvSpec, mask: NDArray[np.bool_] | None) -> NDArray[np.int32]:
    """The actions, int32 [envs], of a policy; raises UsageError if they are none, or not allowed."""
    answer = act(obs) if mask is None else act(obs, mask)
    given = as_array("policy: what it gives", answer)
    if given.size == len(obs) and given.dtype.kind in "iu":
        actions = given.reshape(len(obs))
        if actions.min() >= 0 and actions.max() < spec.num_actions:
            if mask is not None and not (fit := mask[np.arange(len(obs)), actions]).all():
                bad = actions[~fit][0]
                raise UsageError(f"policy: gives {bad}, which the mask of {spec.env_id!r}'s state does not allow")
            return actions.astype(np.int32)
    what = f"{given.dtype}{list(given.shape)}" if given.size > 1 else repr(given.tolist())
    raise UsageError(
        f"policy: gives {what} for {len(obs)} of {spec.env_id!r}'s observations; allowed: an int from 0 to "
        f"{spec.num_actions - 1} for each"
    )


def greedy(network: ActingNetwork, spec: EnvSpec) -> Acting:
    """A policy that always takes the best action of a network."""
    return lambda obs, mask=None: allowed(network.q_values(obs, spec), mask).argmax(1)


def exploring(act: Acting, epsilon: float, spec: EnvSpec, rng: np.random.Generator) -> Acting:
    """A policy that takes a random action with probability `epsilon`, and otherwise the one of `act`."""

    def explore(obs: Array, mask: NDArray[np.bool_] | None = None) -> Array:
        random = random_actions(rng, len(obs), spec.num_actions, mask)
        return np.where(rng.random(len(obs)) < epsilon, random, chosen(act, obs, spec, mask))

    return explore if epsilon else act


class Evaluator:
    """Lets the acting network of a run play episodes of their own, apart from those of the training.

    Args:
        config: of the run. episodes: of each evaluation. at_once: emulators at most.
        stopped: returns whether an evaluation should be abandoned. tell: called with a line if one fails: training goes
            on without it.
    """

    def __init__(
        self,
        config: RunConfig,
        stopped: Callable[[], bool],
        episodes: int | None = None,
        epsilon: float = 0.0,
        at_once: int = AT_ONCE,
        tell: Callable[[str], None] = say,
    ) -> None:
        self._config = config
        self._stopped = stopped
        self._tell = tell
        self._episodes = episodes or config.eval_episodes
        self._epsilon = epsilon
        self._at_once = at_once

    def evaluate(self, network: ActingNetwork, number: int, update: int, env_step: int) -> EvaluationRow | None:
        """Evaluate a network, 1 or 2, after `env_step` steps of the run; None if that was abandoned, or has failed.

        The emulators' seed follows from the run's seed and the step, so that a repetition gives the same result.
        """
        began, config, episodes = time.monotonic(), self._config, self._episodes
        env_seed, policy_seed = np.random.SeedSequence([config.seed, 5, env_step]).spawn(2)
        rng = np.random.default_rng(policy_seed)

        def played() -> list[float]:
            at_once, seed = min(episodes, self._at_once), int(env_seed.generate_state(1)[0])
            with closing(make_vector_env(config.env, at_once, seed, bounded=True)) as env:
                act = exploring(greedy(network, env.spec), self._epsilon, env.spec, rng)
                return play(env, act, episodes, self._stopped)

        returns = self._tried(f"evaluation after {env_step:,} steps", played)
        if returns is None or len(returns) < episodes:
            return None
        mean, sd, seconds = statistics.fmean(returns), statistics.pstdev(returns), time.monotonic() - began
        return EvaluationRow(env_step, update, number, episodes, mean, sd, self._epsilon, seconds)

    def film(self, network: ActingNetwork, env_step: int) -> bytes | None:
        """Film the beginning of an episode that a network plays greedily after `env_step` steps: an animated GIF.

        None if that has failed.
        """
        from coop.evaluation.film import Film, short_gif  # noqa: PLC0415 (most runs film nothing)

        settings, seed = self._config.env, np.random.SeedSequence([self._config.seed, 6, env_step]).generate_state(1)

        def filmed() -> bytes:
            return short_gif(Film(greedy(network, env_spec(settings)), settings, int(seed[0])))

        return self._tried(f"video after {env_step:,} steps", filmed)

    def _tried(self, what: str, work: Callable[[], T]) -> T | None:
        try:
            return work()
        except CoopError as error:
            self._tell(f"no {what}: {error}")
        except Exception as error:  # libraries and users' code may raise anything
            self._tell(f"no {what}: {describe(error)}")
        return None
