"""One environment of gymnasium, behind a check of everything that it gives back."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import Any, NoReturn, TypeVar

import gymnasium
import numpy as np
from gymnasium.spaces import Box
from numpy.typing import NDArray

from coop.common.arguments import has_masked
from coop.common.bounds import MAX_MAGNITUDE
from coop.common.errors import RunError, UsageError
from coop.common.own_code import brief, described
from coop.common.process.lifecycle import is_interrupt
from coop.common.process.output import warn, warn_once
from coop.common.types import Array

_STEP = "gymnasium's step gives (observation, reward, terminated, truncated, info)"
_RESET = "gymnasium's reset takes seed and options, and gives (observation, info)"
_BOUND = f"allowed: finite, from -{MAX_MAGNITUDE:,.0f} to {MAX_MAGNITUDE:,.0f}"
MOST_FLAGS = 100  # observations with no other values than 0 and 1, and some of each, after which there is a warning

MASK = "action_mask"  # in the info of resets and steps, as gymnasium's own environments give it

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


class MaskCheck:
    """Reads the masks of one environment: those of its method `action_masks()`, or `info["action_mask"]` without one.

    mask: bool [actions], the newest one; None if there are none.
    """

    def __init__(self, env: gymnasium.Env[Any, Any], actions: int, *, masks: bool) -> None:
        """masks: whether it gives masks (`FirstReset`)."""
        self._actions, self._masks = actions, masks
        self._method = mask_method(env) if masks else None
        self._given = f'info["{MASK}"]' if self._method is None else "action_masks()"
        self._says = f"allowed: bool or int8[{actions}], 1 for each allowed action and 0 for the others"
        self.mask: NDArray[np.bool_] | None = None

    def __call__(self, info: Any, *, terminal: bool) -> None:  # noqa: ANN401 (whatever there is)
        """Read the mask of a state, with the info that came with it; raises Unfit.

        terminal: nothing follows, so a mask that allows nothing is as good as one that allows all.
        """
        if not self._masks:
            if isinstance(info, Mapping) and MASK in info:
                raise Unfit(f'gives info["{MASK}"]', "allowed: in each state, the first one included, or in none")
            return
        if self._method is not None:
            given = self._method()
        elif not isinstance(info, Mapping) or (given := info.get(MASK)) is None:
            raise Unfit(f'gives no info["{MASK}"]', "allowed: in each state, the first one included, or in none")
        found = _as_array(given, "action mask")
        flags = found.dtype == np.bool_ or (found.dtype.kind in "iu" and ((found == 0) | (found == 1)).all())
        if found.shape != (self._actions,) or not flags:
            values = (
                f"with values to {found.max()} " if found.shape == (self._actions,) and found.dtype.kind in "iu" else ""
            )
            raise Unfit(f"gives the action mask {found.dtype}{list(found.shape)} {values}by {self._given}", self._says)
        mask = found.astype(np.bool_)  # a copy: the environment may write to its own
        if not mask.any():
            if not terminal:
                raise Unfit(f"gives an action mask that allows no action by {self._given}", self._says)
            mask[:] = True
        self.mask = mask


def mask_method(env: gymnasium.Env[Any, Any]) -> Callable[[], Any] | None:
    """The method `action_masks` of an environment or of one of its wrappers, as sb3-contrib has it; or None."""
    method = env.get_wrapper_attr("action_masks") if env.has_wrapper_attr("action_masks") else None
    return method if callable(method) else None


class FirstReset:
    """The first reset of an environment, done ahead of play because it may show whether there are action masks.

    Networks and tables, which need to know it, are made before play begins.

    masks: whether the environment gives masks, by its method or in the info of this reset.
    """

    def __init__(self, env: gymnasium.Env[Any, Any], seed: int) -> None:
        self._env = env
        self._seed: int | None = seed
        self._given: Any = None
        self._error: BaseException | None = None
        self.masks = False
        try:
            self._given = env.reset(seed=seed)
            self.masks = mask_method(env) is not None or MASK in self._given[1]
        except BaseException as error:
            raised(error)
            self._error = error

    def reset(self, *, seed: int | None) -> Any:  # noqa: ANN401 (whatever there is)
        """What that reset gave, or the exception that it raised; another reset where this was taken already."""
        if seed is None or seed != self._seed:
            return self._env.reset(seed=seed)
        self._seed = None
        if self._given is None and self._error is not None:
            raise self._error
        return self._given


class CheckedEnv:
    """An environment that gives what gymnasium's interface and its own space promise, or fails in words.

    All methods raise UsageError for what it gives and must not, and RunError for an exception of its own code; one
    line, with the environment's id and the step.
    """

    def __init__(
        self,
        env: gymnasium.Env[Any, Any],
        env_id: str,
        space: Box,
        actions: int,
        *,
        masks: bool = False,
        first: FirstReset | None = None,
        emulator: int | None = None,
    ) -> None:
        """actions: how many. masks: whether it gives masks. emulator: its number, if there are others.

        first: its first reset, where that is done already.
        """
        self._env, self._name = env, f"env.id: {env_id!r}"
        self._of = "" if emulator is None else f" of emulator {emulator}"
        self._observation = ObservationCheck(self._name, space)
        self._masks = MaskCheck(env, actions, masks=masks)
        self._reset = env.reset if first is None else first.reset
        self._steps = 0

    @property
    def mask(self) -> NDArray[np.bool_] | None:
        """The actions allowed now, bool [actions]; None in an environment without masks."""
        return self._masks.mask

    def reset(self, seed: int | None = None) -> Array:
        """Begin an episode; return its first observation. With a seed, steps are counted anew."""
        if seed is not None:
            self._steps = 0
        try:
            given = self._reset(seed=seed)
        except BaseException as error:
            if isinstance(error, TypeError) and "argument 'seed'" in str(error):
                self._refuse(f"raised {raised(error)}", _RESET, reset=True)
            self._failed(error, reset=True)
        if not isinstance(given, tuple) or len(given) != 2:
            self._refuse(f"gives {_shown(given)}", _RESET, reset=True)
        return self._seen(*given, reset=True)

    def step(self, action: np.integer[Any]) -> tuple[Array, float, bool, bool]:
        """Play an action; return observation, reward, terminated and truncated."""
        self._steps += 1
        try:
            given = self._env.step(action)
        except BaseException as error:
            self._failed(error)
        try:
            observation, reward, terminated, truncated, info = given
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
        return self._seen(observation, info, terminal=terminated), reward, terminated, truncated

    def _seen(self, observation: Any, info: Any, *, reset: bool = False, terminal: bool = False) -> Array:  # noqa: ANN401
        """The observation of a state, once its mask is read."""
        try:
            found = self._observation(observation)
            self._masks(info, terminal=terminal)
        except Unfit as problem:
            self._refuse(problem.what, problem.why, reset=reset)
        except BaseException as error:  # of the environment's own method
            self._failed(error, reset=reset)
        return found

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
            isinstance(value, np.generic | np.ndarray)
            and value.shape == ()
            and value.dtype.kind in "biuf"
            and not has_masked(value)
        ):
            with suppress(OverflowError):  # of an int beyond all floats
                if kind is float or value in (0, 1):  # 2 and NaN are true to Python, and mean something else
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
    """What an environment's code has raised, see `described`.

    It may be anything, such as SystemExit, which must not end a run, or an exception of a library that is no Exception;
    an interrupt by a signal alone is raised again.
    """
    if is_interrupt(error):
        raise error
    return described(error)


def _shown(value: object) -> str:
    """A value that is not as it should be, in a few words."""
    if isinstance(value, np.ndarray):
        return f"{value.dtype}{list(value.shape)}"
    if isinstance(value, tuple):
        return f"{len(value)} values"
    return brief(value)


def _as_array(given: object, what: str = "observation") -> Array:
    if has_masked(given):
        raise Unfit(f"gives the {what} with masked entries", "allowed: an array without any")
    try:
        return np.asarray(given)
    except Exception:  # numbers of unequal lengths, or an object that fails to convert; numpy's or its own
        raise Unfit(f"gives the {what} {_shown(given)}", "allowed: an array") from None
