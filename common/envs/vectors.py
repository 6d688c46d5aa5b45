"""Gymnasium's vector environments: each emulator of one looks like an environment of its own.

All emulators of a vector environment step in one call, that of its first one; `Row.chosen` holds actions until then.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium.envs.registration import EnvSpec
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv
from numpy.typing import NDArray

from coop.common.envs.checked import MASK
from coop.common.errors import UsageError

Vector = gymnasium.vector.VectorEnv[Any, Any, Any]
Outcome = tuple[Any, Any, Any, Any, Any]


def make_rows(name: str, plain: EnvSpec, mode: str, seeds: Sequence[int]) -> list[Row]:
    """Make as many emulators as there are seeds, in one vector environment, and return each as an environment.

    A vector environment that begins an episode only by a step of all its emulators (mode NEXT_STEP) is made with one
    emulator, as often as needed, unless it is gymnasium's own.

    name: of the environment, for what is said. mode: gymnasium's `vectorization_mode`. Raises UsageError, or whatever
    the environment's own code raises.
    """
    own = {"autoreset_mode": AutoresetMode.DISABLED, **({"context": "forkserver"} if mode == "async" else {})}
    given = plain.kwargs.get("vector_kwargs", {})
    kwargs: dict[str, Any] = {} if mode == "vector_entry_point" else {"vector_kwargs": {**own, **given}}
    plain.kwargs = {name: value for name, value in plain.kwargs.items() if name != "vector_kwargs"}

    def make(count: int) -> Vector:
        return gymnasium.make_vec(plain, count, mode, **kwargs)

    envs = make(len(seeds))
    reset = _autoreset(name, envs)
    if reset != AutoresetMode.NEXT_STEP or _restarts_alone(envs, reset) or len(seeds) == 1:
        return _VectorEmulators(name, envs, reset, seeds).rows
    envs.close()
    return [row for seed in seeds for row in _VectorEmulators(name, make(1), reset, [seed]).rows]


def _autoreset(name: str, envs: Vector) -> AutoresetMode:
    found = (envs.metadata or {}).get("autoreset_mode")
    try:
        return AutoresetMode(found)
    except ValueError:
        says = "allowed: one of gymnasium.vector.AutoresetMode"
        raise UsageError(f'{name} has metadata["autoreset_mode"] = {found!r}; {says}') from None


def _restarts_alone(envs: Vector, mode: AutoresetMode) -> bool:
    """Whether `reset` takes options["reset_mask"]."""
    return mode == AutoresetMode.DISABLED or isinstance(envs.unwrapped, SyncVectorEnv | AsyncVectorEnv)


class _VectorEmulators:
    """The emulators of one vector environment."""

    def __init__(self, name: str, envs: Vector, mode: AutoresetMode, seeds: Sequence[int]) -> None:
        self.envs, self._mode, self._seeds = envs, mode, list(seeds)
        self._alone = _restarts_alone(envs, mode)
        self._begun: Any = None
        self._given: Any = None
        self.rows = [Row(self, number) for number in range(len(seeds))]
        inner = envs.unwrapped
        if isinstance(inner, SyncVectorEnv) and inner.envs[0].has_wrapper_attr("action_masks"):
            if mode == AutoresetMode.SAME_STEP:
                raise UsageError(
                    f"{name} has action masks by a method; mode SAME_STEP leaves out an episode's last one"
                )
            for row, env in zip(self.rows, inner.envs, strict=True):
                row.action_masks = env.get_wrapper_attr("action_masks")

    def begin(self) -> None:
        """Start all emulators, each from its seed, or all from the first one where only one seed is taken."""
        seeds: Any = self._seeds if len(self._seeds) > 1 or self._alone else self._seeds[0]
        try:
            self._begun = self.envs.reset(seed=seeds)
        except (TypeError, ValueError, gymnasium.error.Error):
            self._begun = self.envs.reset(seed=self._seeds[0])

    def begun(self, number: int) -> Any:  # noqa: ANN401 (whatever there is)
        """What an emulator's reset gives, after `begin`."""
        if not isinstance(self._begun, tuple) or len(self._begun) != 2:
            return self._begun
        return self._of("observations", self._begun[0], number), _info(self._begun[1], number)

    def play(self) -> None:
        """Let all emulators take the actions chosen."""
        actions = np.array([row.chosen for row in self.rows], self.envs.single_action_space.dtype)
        self._given = self.envs.step(actions)

    def outcome(self, number: int) -> Any:  # noqa: ANN401 (whatever there is)
        """What an emulator's step gives, after `play`."""
        given = self._given
        if not isinstance(given, tuple) or len(given) != 5:
            return given
        obs, rewards, terminated, truncated, infos = given
        outcome = tuple(
            self._of(what, values, number)
            for what, values in (("rewards", rewards), ("terminated", terminated), ("truncated", truncated))
        )
        if self._mode == AutoresetMode.SAME_STEP and self._ended(number):
            if not isinstance(infos, Mapping) or "final_obs" not in infos:
                raise LookupError('info["final_obs"], which mode SAME_STEP gives where an episode ends')
            last = self._of('info["final_obs"]', infos["final_obs"], number)
            return last, *outcome, _info(infos.get("final_info", {}), number)
        return self._of("observations", obs, number), *outcome, _info(infos, number)

    def restart(self, number: int) -> tuple[Any, Any]:
        """Begin an emulator's next episode: what its reset gives."""
        if self._mode == AutoresetMode.SAME_STEP and self._ended(number):
            obs, infos = self._given[0], self._given[4]
        elif self._alone:
            obs, infos = self.envs.reset(options={"reset_mask": np.arange(len(self.rows)) == number})
        elif len(self.rows) > 1:
            raise LookupError("no limit of episodes but its own, as SAME_STEP restarts no emulator alone")
        elif self._mode == AutoresetMode.NEXT_STEP and self._ended(number):
            self.play()
            obs, infos = self._given[0], self._given[4]
        else:
            obs, infos = self.envs.reset()
        return obs[number], _info(infos, number)

    def _of(self, what: str, values: Any, number: int) -> Any:  # noqa: ANN401
        """An emulator's of the values of all; raises LookupError unless there is one for each."""
        try:
            found = str(len(values))
        except TypeError:
            found = type(values).__name__
        if found != str(len(self.rows)):
            raise LookupError(f"{what} of each of {len(self.rows)} emulators; it gives {found}")
        return values[number]

    def _ended(self, number: int) -> bool:
        return bool(self._given[2][number] or self._given[3][number])


class Row(gymnasium.Env[Any, Any]):
    """One emulator of a vector environment.

    chosen: the action that it takes next.
    """

    action_masks: Callable[[], NDArray[Any]]

    def __init__(self, emulators: _VectorEmulators, number: int) -> None:
        envs = emulators.envs
        self._emulators, self._number = emulators, number
        self.observation_space, self.action_space = envs.single_observation_space, envs.single_action_space
        self.metadata = envs.metadata
        self.chosen: Any = 0

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:  # noqa: ANN401
        """Begin the next episode; with a seed, all emulators begin with the first one, each from its own."""
        if seed is None:
            return self._emulators.restart(self._number)
        if self._number == 0:
            self._emulators.begin()
        return self._emulators.begun(self._number)

    def step(self, action: Any) -> Any:  # noqa: ANN401
        """The outcome of the action chosen, when the first emulator has been asked for its own."""
        if self._number == 0:
            self._emulators.play()
        return self._emulators.outcome(self._number)

    def render(self) -> Any:  # noqa: ANN401
        """The picture of this emulator."""
        return _at(self._emulators.envs.render(), self._number)

    def close(self) -> None:
        """Close all emulators with the first."""
        if self._number == 0:
            self._emulators.envs.close()


def _at(values: Any, number: int) -> Any:  # noqa: ANN401
    return None if values is None else values[number]


def _info(infos: Any, number: int) -> dict[str, Any]:  # noqa: ANN401
    """Of an emulator's info what is read: its action mask."""
    if not isinstance(infos, Mapping) or MASK not in infos or not infos.get(f"_{MASK}", {number: True})[number]:
        return {}
    return {MASK: infos[MASK][number]}
