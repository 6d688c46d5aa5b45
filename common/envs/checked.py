"""One environment of gymnasium, behind a check of everything that it gives back."""

from __future__ import annotations

import traceback
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, NoReturn, TypeVar

import gymnasium
import numpy as np
from gymnasium.spaces import Box
from numpy.typing import NDArray

from coop.common.bounds import MAX_MAGNITUDE
from coop.common.errors import RunError, UsageError
from coop.common.imports import describe
from coop.common.process.lifecycle import is_interrupt
from coop.common.process.output import warn, warn_once
from coop.common.types import Array

_STEP = "gymnasium's step gives (observation, reward, terminated, truncated, info)"
_RESET = "gymnasium's reset takes seed and options, and gives (observation, info)"
_BOUND = f"allowed: finite, from -{MAX_MAGNITUDE:,.0f} to {MAX_MAGNITUDE:,.0f}"
MOST_FLAGS = 100  # observations with no other values than 0 and 1, and some of each, after which there is a warning

T = TypeVar("T")


def of_flags(name: str) -> str:
    """The warning of uint8 observations that are only 0 and 1."""
    return (
        f"{name}: uint8 observations of only 0 and 1, which networks see divided by 255; in a space of bool or float32 "
        "they see them as they are"
    )


class Unfit(Exception):
    """Something that does not fit; what: a verb and what is wrong. why: what is allowed."""

    def __init__(self, what: str, why: str) -> None:
        super().__init__(f"{what}; {why}")
        self.what, self.why = what, why


class ObservationCheck:
    """Refuses observations of another shape or dtype than their space's, and values that nobody can learn from."""

    def __init__(self, name: str, space: Box) -> None:
        self._name = name
        self._shape, self._dtype = space.shape, space.dtype
        self._says = f"its observation space says {space.dtype}{list(space.shape)}"
        self._any_value = space.dtype in (np.uint8, np.bool_)
        self._flags_in_a_row = 0 if space.dtype == np.uint8 else MOST_FLAGS

    def __call__(self, given: Any) -> Array:  # noqa: ANN401 (whatever there is)
        """The observation as an array; raises Unfit."""
        observation = given if type(given) is np.ndarray else _as_array(given)
        if observation.dtype == object:
            raise Unfit(f"gives the observation {_shown(given)}", self._says)
        if observation.shape != self._shape:
            raise self._unfit(observation)
        if observation.dtype != self._dtype:
            if not np.can_cast(observation.dtype, self._dtype, "same_kind"):
                raise self._unfit(observation)
            if self._any_value and not np.array_equal(observation.astype(self._dtype), observation):
                raise Unfit(f"gives observations with values to {observation.max()}", self._says)
        if not self._any_value:
            least, most = observation.item(observation.argmin()), observation.item(observation.argmax())
            if not (least >= -MAX_MAGNITUDE and most <= MAX_MAGNITUDE):  # not true of NaN either
                raise Unfit(f"gives observations with values from {least:g} to {most:g}", _BOUND)
        if self._flags_in_a_row < MOST_FLAGS:
            self._look_for_flags(observation)
        return observation

    def _look_for_flags(self, observation: Array) -> None:
        """Warn of uint8 that holds truth values."""
        most = observation.max()
        self._flags_in_a_row = self._flags_in_a_row + int(most) if most <= 1 else MOST_FLAGS + 1
        if self._flags_in_a_row == MOST_FLAGS:
            warn_once(of_flags(self._name))

    def _unfit(self, found: Array) -> Unfit:
        return Unfit(f"gives observations {found.dtype}{list(found.shape)}", self._says)


class CheckedEnv:
    """An environment that gives what gymnasium's interface and its own space promise, or fails in words.

    All methods raise UsageError for what it gives and must not, and RunError for an exception of its own code; one
    line, with the environment's id and the step.
    """

    def __init__(self, env: gymnasium.Env[Any, Any], env_id: str, space: Box, emulator: int | None = None) -> None:
        """emulator: its number, if there are others."""
        self._env, self._name = env, f"env.id: {env_id!r}"
        self._of = "" if emulator is None else f" of emulator {emulator}"
        self._observation = ObservationCheck(self._name, space)
        self._steps = 0

    def reset(self, seed: int | None = None) -> Array:
        """Begin an episode; return its first observation. With a seed, steps are counted anew."""
        if seed is not None:
            self._steps = 0
        try:
            given = self._env.reset(seed=seed)
        except BaseException as error:
            if isinstance(error, TypeError) and "argument 'seed'" in str(error):
                self._refuse(f"raised {raised(error)}", _RESET, reset=True)
            self._failed(error, reset=True)
        if not isinstance(given, tuple) or len(given) != 2:
            self._refuse(f"gives {_shown(given)}", _RESET, reset=True)
        try:
            return self._observation(given[0])
        except Unfit as problem:
            self._refuse(problem.what, problem.why, reset=True)

    def step(self, action: np.integer[Any]) -> tuple[Array, float, bool, bool]:
        """Play an action; return observation, reward, terminated and truncated."""
        self._steps += 1
        try:
            given = self._env.step(action)
        except BaseException as error:
            self._failed(error)
        try:
            observation, reward, terminated, truncated, _ = given
        except (TypeError, ValueError):
            self._refuse(f"gives {_shown(given)}", _STEP)
        if type(reward) is not float:
            reward = self._scalar("reward", reward, float)
        if not -MAX_MAGNITUDE <= reward <= MAX_MAGNITUDE:  # not true of NaN either
            self._refuse(f"gives the reward {reward:g}", _BOUND)
        if type(terminated) is not bool:
            terminated = self._scalar("terminated", terminated, bool)
        if type(truncated) is not bool:
            truncated = self._scalar("truncated", truncated, bool)
        try:
            return self._observation(observation), reward, terminated, truncated
        except Unfit as problem:
            self._refuse(problem.what, problem.why)

    def render(self) -> NDArray[Any]:
        """The picture that it renders: [height, width] or [height, width, channels]; raises UsageError."""
        try:
            picture = np.asarray(self._env.render())
        except BaseException as error:
            raise UsageError(f"{self._name} can't be filmed: {raised(error)}") from error
        if picture.dtype.kind not in "biuf" or picture.ndim not in (2, 3) or not picture.size:
            found = f"{picture.dtype}{list(picture.shape)}"
            raise UsageError(f"{self._name} can't be filmed: it renders {found}, not height x width x 3")
        return picture[..., :3] if picture.ndim == 3 and picture.shape[2] == 4 else picture  # the last is opacity

    def close(self) -> None:
        """Close it. That it can't be closed is no reason to fail, only for a line."""
        try:
            self._env.close()
        except BaseException as error:
            warn(f"{self._name} raised {raised(error)} as it was closed")

    def _scalar(self, what: str, value: Any, kind: Callable[[Any], T]) -> T:  # noqa: ANN401
        """The number or truth value that an array without dimensions, or a number of numpy, is."""
        if isinstance(value, bool | int | float) or (
            isinstance(value, np.generic | np.ndarray) and value.shape == () and value.dtype.kind in "biuf"
        ):
            with suppress(OverflowError):  # of an int beyond all floats
                return kind(value)
        return self._refuse(
            f"gives {what} {_shown(value)}", f"allowed: a single {'number' if kind is float else 'bool'}"
        )

    def _refuse(self, what: str, why: str, *, reset: bool = False) -> NoReturn:
        raise UsageError(f"{self._name} {self._when(reset)} {what}; {why}") from None

    def _failed(self, error: BaseException, *, reset: bool = False) -> NoReturn:
        raise RunError(f"{self._name} {self._when(reset)} raised {raised(error)}") from error

    def _when(self, reset: bool) -> str:
        if not self._steps:
            return f"at the first reset{self._of}"
        return f"at {'the reset after ' if reset else ''}step {self._steps:,}{self._of}"


def raised(error: BaseException) -> str:
    """What a user's code has raised, in one line, with the last line of that code that it came through.

    It may be anything, such as SystemExit, which must not end a run, or an exception of a library that is no Exception;
    an interrupt by a signal alone is raised again.
    """
    if is_interrupt(error):
        raise error
    for frame in reversed(traceback.extract_tb(error.__traceback__)):
        if frame.filename != __file__ and "site-packages" not in frame.filename:
            return f"{describe(error)} ({Path(frame.filename).name}:{frame.lineno})"
    return describe(error)


def _shown(value: object) -> str:
    """A value that is not as it should be, in a few words."""
    if isinstance(value, np.ndarray):
        return f"{value.dtype}{list(value.shape)}"
    if isinstance(value, tuple):
        return f"{len(value)} values"
    text = " ".join(repr(value).split())
    return text if len(text) <= 40 else type(value).__name__


def _as_array(given: object) -> Array:
    try:
        return np.asarray(given)
    except Exception:  # numbers of unequal lengths, or an object that fails to convert; numpy's or its own
        raise Unfit(f"gives the observation {_shown(given)}", "allowed: an array") from None
