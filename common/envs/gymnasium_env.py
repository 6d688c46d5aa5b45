"""Any gymnasium environment with vectors or pictures and Discrete actions, as a vector environment."""

from __future__ import annotations

import dataclasses
import math
import os
from collections.abc import Collection, Mapping, Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Discrete
from numpy.typing import NDArray

from coop.common.bounds import LONGEST_EPISODE, MAX_ACTIONS, MAX_SIDE
from coop.common.envs.checked import CheckedEnv, FirstReset, raised
from coop.common.envs.observations import FrameMaker
from coop.common.envs.pictures import coloured
from coop.common.envs.protocol import Steps
from coop.common.envs.registry import find_registered
from coop.common.envs.vectors import Row, make_rows
from coop.common.errors import UsageError
from coop.common.process.output import warn_once
from coop.common.settings.environment import EnvSettings
from coop.common.types import Array, EnvSpec

PICTURES_PER_S = 10.0  # where the environment does not say
SLOWEST, FASTEST = 0.1, 1000.0  # pictures a second


class GymnasiumEnv:
    """Plain gymnasium environments stepped one after another, as `VectorEnv`.

    `stack` frames make one observation; zeros stand for frames before an episode's first.
    """

    def __init__(
        self, settings: EnvSettings, seeds: list[int], render_mode: str | None = None, *, bounded: bool = False
    ) -> None:
        """bounded: see `make_vector_env`."""
        envs, self._limit = _make(settings, seeds, render_mode)
        self._rows = [env for env in envs if isinstance(env, Row)]
        observations, actions = _spaces(settings, envs[0])
        self._frame = FrameMaker(settings, observations)
        first = FirstReset(envs[0], seeds[0])
        self.spec = _spec_of(settings, actions, self._frame, masks=first.masks)
        self.num_envs = len(seeds)
        several = self.num_envs > 1
        self._envs = [
            CheckedEnv(
                env,
                settings.id,
                observations,
                self.spec.num_actions,
                masks=self.spec.masks,
                first=None if row else first,
                emulator=row if several else None,
            )
            for row, env in enumerate(envs)
        ]
        self._seeds = seeds
        self._bounded = bounded and not self._limit
        if self._bounded:
            self._limit = LONGEST_EPISODE
        self._clip = settings.clip_rewards
        self._limit_terminal = settings.time_limit_terminal
        self._first_action, self._action_dtype = actions.start, actions.dtype
        self._lengths = [0] * self.num_envs
        self._obs = np.empty(0)
        self.mask: NDArray[np.bool_] | None = None
        self._actions = np.empty(0, np.int32)
        # Shared by all steps in which no episode ends, so it must not be written to.
        self._none = np.zeros(self.num_envs, bool)
        self._none.flags.writeable = False

    def reset(self) -> Array:
        """Start every emulator from its seed: <frame_dtype>[envs, *obs_shape].

        Raises:
            UsageError: the environment gives what its spaces or gymnasium's interface rule out.
            RunError: its own code raises an exception.
        """
        self._lengths = [0] * self.num_envs
        self._obs = np.zeros((self.num_envs, *self.spec.obs_shape), self.spec.frame_dtype)
        for row, seed in enumerate(self._seeds):
            self._put(self._obs, row, self._envs[row].reset(seed))
        self.mask = self._masks()
        return self._obs

    def send(self, actions: NDArray[np.int32]) -> None:
        """Store one action, int32 [envs], for every emulator."""
        self._actions = actions

    def recv(self) -> Steps:
        """Play the stored actions; plain environments have no threads that could begin earlier. Raises as `reset`."""
        next_obs = np.empty_like(self._obs)
        if self.spec.stack > 1:
            next_obs[:, :-1] = self._obs[:, 1:]
        rewards, lengths = [], self._lengths
        terminal: list[int] = []
        over: list[int] = []
        # What Discrete.sample gives, numpy's integers, is what environments are written for.
        actions = self._actions.astype(self._action_dtype) + self._first_action
        for emulator, action in zip(self._rows, actions, strict=False):
            emulator.chosen = action
        for row, action in enumerate(actions):
            frame, reward, terminated, truncated = self._envs[row].step(action)
            self._put(next_obs, row, frame)
            rewards.append(reward)
            lengths[row] += 1
            is_over = terminated or truncated or lengths[row] == self._limit
            if terminated or (is_over and self._limit_terminal):
                terminal.append(row)
            if is_over:
                over.append(row)
                if self._bounded and not (terminated or truncated):
                    self._tell_cut()
        raw_rewards = np.array(rewards, np.float64)
        learned = np.clip(raw_rewards, -1.0, 1.0) if self._clip else raw_rewards
        mask, next_mask = self.mask, self._masks()
        self._obs, self.mask = next_obs, next_mask
        if over:
            self._obs, self.mask = self._restart(next_obs, over), self._masks()
        ended = self._flags(over)
        return Steps(
            self._obs, next_obs, learned.astype(np.float32), raw_rewards, self._flags(terminal), ended, ended,
            mask, next_mask,
        )  # fmt: skip

    def step(self, actions: NDArray[np.int32]) -> Steps:
        """`send`, then `recv`; raises as `recv`."""
        self.send(actions)
        return self.recv()

    def close(self) -> None:
        """Close the environments."""
        for env in self._envs:
            env.close()

    def _restart(self, next_obs: Array, rows: list[int]) -> Array:
        obs = next_obs.copy()
        for row in rows:
            obs[row] = 0
            self._put(obs, row, self._envs[row].reset())
            self._lengths[row] = 0
        return obs

    def _put(self, obs: Array, row: int, observation: Array) -> None:
        """Store an environment's observation as the newest frame of `obs[row]`."""
        frame = self._frame(observation)
        if self.spec.stack > 1:
            obs[row, -1] = frame
        else:
            obs[row] = frame

    def _tell_cut(self) -> None:
        warn_once(
            f"env.id: {self.spec.env_id!r}: an episode had not ended after {LONGEST_EPISODE:,} steps, and was cut "
            "there; env.max_episode_steps sets a limit"
        )

    def _masks(self) -> NDArray[np.bool_] | None:
        """The masks of all emulators' present states, bool [envs, actions]."""
        found = [env.mask for env in self._envs] if self.spec.masks else []
        return np.array(found) if found else None

    def _flags(self, rows: list[int]) -> NDArray[np.bool_]:
        if not rows:
            return self._none
        flags = np.zeros(self.num_envs, bool)
        flags[rows] = True
        return flags


class FilmedGymnasium(GymnasiumEnv):
    """One environment as `FilmedEnv`: pictures that are its observations, or those that it renders."""

    def __init__(self, settings: EnvSettings, seed: int) -> None:
        """Raise UsageError for an environment that has no pictures, or lacks a package for them."""
        (env,), _ = _make(settings, [0])
        observations, actions = _spaces(settings, env)
        vectors = len(FrameMaker(settings, observations).shape) == 1
        metadata: Mapping[str, Any] = env.metadata if isinstance(env.metadata, Mapping) else {}  # it may be anything
        modes = metadata.get("render_modes")
        CheckedEnv(env, settings.id, observations, int(actions.n)).close()
        if vectors and not (isinstance(modes, Collection) and "rgb_array" in modes):
            raise UsageError(
                f"env.id: {settings.id!r} has no pictures to film: its metadata['render_modes'] has no 'rgb_array'"
            )
        super().__init__(settings, [seed], "rgb_array" if vectors else None, bounded=True)
        self.pictures_per_s = _speed(metadata.get("render_fps"))
        self._renders = vectors

    def picture(self) -> NDArray[np.uint8]:
        """The newest frame of the observation in colour, or what the environment renders; raises UsageError."""
        if not self._renders:
            return coloured(self._obs[0, -1] if self.spec.stack > 1 else self._obs[0])
        os.environ.setdefault("SDL_VIDEODRIVER", "dummy")  # pygame needs neither a screen
        os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")  # nor to greet
        return coloured(self._envs[0].render())


def _speed(stated: object) -> float:
    """Pictures a second by what an environment states, which may be anything."""
    return float(stated) if isinstance(stated, int | float) and SLOWEST <= stated <= FASTEST else PICTURES_PER_S


def gymnasium_spec(settings: EnvSettings) -> EnvSpec:
    """The specification of a gymnasium id.

    Raises:
        UsageError: the id is unknown, or a space or setting is not supported.
    """
    (env,), _ = _make(settings, [0])
    observations, actions = _spaces(settings, env)
    masks = FirstReset(env, 0).masks
    spec = _spec_of(settings, actions, FrameMaker(settings, observations), masks=masks)
    CheckedEnv(env, settings.id, observations, spec.num_actions).close()
    return spec


def _make(
    settings: EnvSettings, seeds: list[int], render_mode: str | None = None
) -> tuple[Sequence[gymnasium.Env[Any, Any]], int]:
    """Make an environment for each seed, without gymnasium's checks and step limit; return them and that limit.

    The limit is 0 if there is none, or if vector environments of one's own see to it themselves.
    """
    registered = find_registered(settings)
    mode, limit = settings.vectorization_mode, settings.max_episode_steps or _registered_limit(settings, registered)
    if mode is None and registered.entry_point is None and registered.vector_entry_point is not None:
        mode = "vector_entry_point"
    keeps_limit = mode == "vector_entry_point"
    # By the specification and not by the id, because `make` warns about ids that have a newer version.
    plain = dataclasses.replace(
        registered,
        order_enforce=False,
        disable_env_checker=True,
        max_episode_steps=limit or None if keeps_limit else None,
        kwargs={**registered.kwargs, **settings.kwargs, **({"render_mode": render_mode} if render_mode else {})},
    )
    try:
        if mode is None:
            envs: Sequence[gymnasium.Env[Any, Any]] = [gymnasium.make(plain) for _ in seeds]
        else:
            envs = make_rows(f"env.id: {settings.id!r}", plain, mode, seeds)
    except UsageError:
        raise
    except gymnasium.error.DependencyNotInstalled as error:
        raise UsageError(f"env.id: {settings.id!r} needs a package that is not installed: {error}") from None
    except BaseException as error:
        text = f"env.id = {settings.id!r}, env.kwargs = {settings.kwargs}: {raised(error)}"
        raise UsageError(text) from error
    return envs, 0 if keeps_limit else limit


def _registered_limit(settings: EnvSettings, registered: gymnasium.envs.registration.EnvSpec) -> int:
    """The limit of steps with which an environment is registered, 0 if there is none; raises UsageError."""
    limit: Any = registered.max_episode_steps
    if limit is None:
        return 0
    number = isinstance(limit, int | float | np.number) and not isinstance(limit, bool)
    if not number or limit < 1 or limit % 1 != 0:
        raise UsageError(
            f"env.id: {settings.id!r} is registered with max_episode_steps = {limit!r}; allowed: whole numbers from "
            "1 on, or None; env.max_episode_steps sets another limit"
        )
    return int(limit)


def _spaces(settings: EnvSettings, env: gymnasium.Env[Any, Any]) -> tuple[Box, Discrete]:
    """The spaces of an environment's observations and actions; raises UsageError."""
    name = f"env.id: {settings.id!r}"
    try:
        observations, actions = env.observation_space, env.action_space
    except BaseException as error:
        raise UsageError(f"{name} has no observation_space and action_space: {raised(error)}") from error
    if not isinstance(observations, Box) or not 1 <= len(observations.shape) <= 3:
        raise UsageError(
            f"{name} has the observation space {_one_line(observations)}; allowed is a Box of one dimension, or of "
            "pictures, height x width or height x width x channels"
        )
    if not math.prod(observations.shape):
        raise UsageError(f"{name} has the observation space {observations}: there are no values in it")
    if not isinstance(actions, Discrete):
        raise UsageError(f"{name} has the action space {_one_line(actions)}; allowed is Discrete")
    return observations, actions


def _one_line(space: object) -> str:
    return " ".join(str(space).split())


def _spec_of(settings: EnvSettings, actions: Discrete, frame: FrameMaker, *, masks: bool) -> EnvSpec:
    for what, most, limit in (
        ("actions", int(actions.n), MAX_ACTIONS),
        ("values on a side", max(frame.shape), MAX_SIDE),
    ):
        if most > limit:
            raise UsageError(f"env.id: {settings.id!r} has {most:,} {what}; allowed: at most {limit:,}")
    return EnvSpec(settings.id, frame.shape, frame.dtype, settings.stack, int(actions.n), masks)
