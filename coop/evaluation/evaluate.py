"""Evaluation of what has been saved: full episodes by the networks of checkpoints, and by any policy."""

from __future__ import annotations

import inspect
import statistics
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from coop.common.arguments import check_whole
from coop.common.bounds import MAX_EVALUATED, MAX_INTEGER, MAX_STREAMS
from coop.common.envs.make import make_vector_env
from coop.common.errors import RunError, UsageError
from coop.common.numbers import exact
from coop.common.settings.environment import EnvSettings
from coop.common.settings.tables import resolve
from coop.evaluation.episodes import AT_ONCE, Acting, exploring, play
from coop.evaluation.film import Film, check_video, write_video
from coop.evaluation.saved import NetworkChoice, SavedPolicy, SavedRun

RESAMPLES = 2000  # of the returns, for an interval


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

    @property
    def interval(self) -> tuple[float, float]:
        """95 % interval of the mean, by the bootstrap."""
        drawn = np.random.default_rng(0).choice(self.returns, (RESAMPLES, len(self.returns)))
        low, high = np.percentile(drawn.mean(1), (2.5, 97.5)).tolist()
        return low, high


@dataclass(frozen=True)
class CheckpointEvaluation(Evaluation):
    """Returns of a run's checkpoint of number `checkpoint`.

    network: 1, 2, or "mean", which plays by the mean of both networks' Q-values. epsilon: probability of a random
    action. acts: the network acted and was trained last.
    """

    run: str
    checkpoint: int
    network: NetworkChoice
    epsilon: float
    acts: bool


def evaluate(
    policy: Acting,
    episodes: int = 20,
    env: str | Mapping[str, Any] | None = None,
    seed: int = 0,
    *,
    epsilon: float = 0.0,
    at_once: int = 1,
) -> Evaluation:
    """Play full episodes by a policy in its own environment, or in another one.

    Args:
        policy: of `SavedRun.policy`, or any function of a batch of stacked observations that gives an action for each;
            in an environment with action masks it is called with those, bool [batch, actions], as well.
        env: an environment's id; or settings that replace those of the policy's environment, as a table
            ({"kwargs": {"side": 12}}).
        seed: of the emulators and the random actions.
        epsilon: probability of a random action.
        at_once: emulators that play at once, each its share of the episodes.

    Raises:
        UsageError: an argument is invalid, or lacks; or the policy gives something else than actions.
        RunError: the environment's own code raises an exception.
    """
    if not callable(policy):
        raise UsageError(f"policy: {type(policy).__name__} is no function of observations")
    check_whole("episodes", episodes, 1, MAX_EVALUATED)
    check_whole("seed", seed, 0, MAX_INTEGER)
    check_whole("at_once", at_once, 1, MAX_STREAMS)
    if isinstance(epsilon, bool) or not isinstance(epsilon, int | float | np.number) or not 0 <= epsilon <= 1:
        raise UsageError(f"epsilon = {epsilon!r}: must be from 0 to 1")
    if not isinstance(env, str | Mapping | None):
        raise UsageError(f"env = {env!r}: must be an id, or a table of settings")
    own = policy.env if isinstance(policy, SavedPolicy) else None
    if env is None and own is None:
        raise UsageError("env: a policy that no run has trained needs one")
    changes = {"id": env} if isinstance(env, str) else dict(env or {})
    settings = resolve({"env": {**(asdict(own) if own else {}), **changes}}).env
    return Evaluation(_returns(policy, settings, episodes, seed, epsilon, at_once))


def evaluate_checkpoint(
    run_dir: Path,
    episodes: int,
    seed: int,
    networks: Sequence[NetworkChoice] = (1, 2, "mean"),
    epsilons: Sequence[float] = (0.0,),
    at_once: int = AT_ONCE,
) -> Iterator[CheckpointEvaluation]:
    """Play the networks of a run's newest checkpoint, each with each epsilon, all from the same starts.

    Of a method with one network, of which the second is an older copy, only the first plays.

    seed: of the emulators; the derived seed differs from those of the run's emulators.

    Raises:
        UsageError: the folder holds no run, or no checkpoint; raised at once, before anything is played.
    """
    run = SavedRun(run_dir)
    checkpoint = run.checkpoint()
    derived = _derived(run, seed)
    chosen: Sequence[NetworkChoice] = networks if run.config.two_networks else (1,)

    def one(network: NetworkChoice, epsilon: float) -> CheckpointEvaluation:
        played = checkpoint.networks if network == "mean" else (checkpoint.networks[network - 1],)
        policy = SavedPolicy(run.config.env, checkpoint.spec, played)
        returns = _returns(policy, run.config.env, episodes, derived, epsilon, at_once)
        acts = network == checkpoint.acting + 1
        return CheckpointEvaluation(returns, str(run_dir), checkpoint.number, network, epsilon, acts)

    return (one(network, epsilon) for network in chosen for epsilon in epsilons)


def film_checkpoint(
    run_dir: Path, video: Path, seed: int, networks: Sequence[NetworkChoice], epsilon: float = 0.0
) -> str:
    """Film an episode of play by a run's newest checkpoint, as far as a film goes; return a line that describes it.

    seed: as of `evaluate_checkpoint`. networks: the one to play; if there are several, the acting network plays.
    epsilon: probability of a random action.

    Raises:
        UsageError: the folder holds no run, or no checkpoint; or its environment can't be filmed, or not so.
        RunError: the video can't be written.
    """
    check_video(video)
    run = SavedRun(run_dir)
    checkpoint = run.checkpoint()
    network: NetworkChoice = networks[0] if len(networks) == 1 else checkpoint.acting + 1  # type: ignore[assignment]
    policy, derived = run.policy(network), _derived(run, seed)
    act = exploring(policy, epsilon, policy.spec, np.random.default_rng(derived))
    film = Film(act, run.config.env, derived)
    try:
        write_video(film, video)
    except OSError as error:
        raise RunError(f"{video}: {error.strerror or error}") from error
    played = f"network {network}{f', epsilon {epsilon:g}' if epsilon else ''}"
    end = "" if film.over else ", where the film ends; the episode does not"
    return f"{video}: {played}, return {exact(film.episode_return)} in {film.steps:,} steps{end}"


def _derived(run: SavedRun, seed: int) -> int:
    (derived,) = np.random.SeedSequence([run.config.seed, 4, seed]).generate_state(1).tolist()
    return int(derived)


def _returns(
    policy: Acting, settings: EnvSettings, episodes: int, seed: int, epsilon: float, at_once: int
) -> list[float]:
    with closing(make_vector_env(settings, min(episodes, at_once), seed, bounded=True)) as env:
        if env.spec.masks:
            _check_takes_masks(policy, settings)
        act = exploring(policy, epsilon, env.spec, np.random.default_rng(seed))
        return play(env, act, episodes)


def _check_takes_masks(policy: Acting, settings: EnvSettings) -> None:
    """Raise UsageError for a function that can't be called with observations and masks."""
    try:
        inspect.signature(policy).bind(None, None)
    except TypeError:
        raise UsageError(f"policy: must take observations and action masks, which {settings.id!r} has") from None
    except ValueError:  # a function without a signature; what it says to its arguments is told as it is played
        return
