"""Any gymnasium environment with vectors or pictures and Discrete actions, as a vector environment."""

from __future__ import annotations

import dataclasses
import os
from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Discrete
from numpy.typing import NDArray

from common.bounds import MAX_ACTIONS, MAX_SIDE
from common.envs.observations import FrameMaker
from common.envs.pictures import coloured
from common.envs.protocol import Steps
from common.envs.registry import find_registered
from common.errors import UsageError
from common.imports import describe
from common.settings.environment import EnvSettings
from common.types import Array, EnvSpec

PICTURES_PER_S = 10.0  # where the environment does not say


class GymnasiumEnv:
    """Plain gymnasium environments stepped one after another, as `VectorEnv`.

    `stack` frames make one observation; zeros stand for frames before an episode's first.
    """

    def __init__(self, settings: EnvSettings, seeds: list[int], render_mode: str | None = None) -> None:
        self._envs, self._limit = _make(settings, len(seeds), render_mode)
        self._frame = FrameMaker(settings, self._envs[0].observation_space)
        self.spec = _spec_of(settings, self._envs[0], self._frame)
        self.num_envs = len(seeds)
        self._seeds = seeds
        self._clip = settings.clip_rewards
        self._limit_terminal = settings.time_limit_terminal
        actions = self._envs[0].action_space
        assert isinstance(actions, Discrete)
        self._first_action = int(actions.start)
        self._lengths = [0] * self.num_envs
        self._obs = np.empty(0)
        self._actions = np.empty(0, np.int32)
        # Shared by all steps in which no episode ends, so it must not be written to.
        self._none = np.zeros(self.num_envs, bool)
        self._none.flags.writeable = False

    def reset(self) -> Array:
        """Start every emulator from its seed: <frame_dtype>[envs, *obs_shape].

        Raises:
            UsageError: the observations differ from what the environment's space says.
        """
        frames = [env.reset(seed=seed)[0] for env, seed in zip(self._envs, self._seeds, strict=True)]
        self._lengths = [0] * self.num_envs
        self._obs = np.zeros((self.num_envs, *self.spec.obs_shape), self.spec.frame_dtype)
        for row, frame in enumerate(frames):
            self._frame.check(frame)
            self._put(self._obs, row, frame)
        return self._obs

    def send(self, actions: NDArray[np.int32]) -> None:
        """Store one action, int32 [envs], for every emulator."""
        self._actions = actions

    def recv(self) -> Steps:
        """Play the stored actions; plain environments have no threads that could begin earlier."""
        next_obs = np.empty_like(self._obs)
        if self.spec.stack > 1:
            next_obs[:, :-1] = self._obs[:, 1:]
        rewards, lengths = [], self._lengths
        terminal: list[int] = []
        over: list[int] = []
        for row, action in enumerate(self._actions.tolist()):
            frame, reward, terminated, truncated, _ = self._envs[row].step(action + self._first_action)
            self._put(next_obs, row, frame)
            rewards.append(reward)
            lengths[row] += 1
            is_over = terminated or truncated or lengths[row] == self._limit
            if is_over:
                over.append(row)
            if terminated or (is_over and self._limit_terminal):
                terminal.append(row)
        raw_rewards = np.array(rewards, np.float64)
        learned = np.clip(raw_rewards, -1.0, 1.0) if self._clip else raw_rewards
        self._obs = self._restart(next_obs, over) if over else next_obs
        ended = self._mask(over)
        return Steps(self._obs, next_obs, learned.astype(np.float32), raw_rewards, self._mask(terminal), ended, ended)

    def step(self, actions: NDArray[np.int32]) -> Steps:
        """`send`, then `recv`."""
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
            self._put(obs, row, self._envs[row].reset()[0])
            self._lengths[row] = 0
        return obs

    def _put(self, obs: Array, row: int, observation: Array) -> None:
        """Store an environment's observation as the newest frame of `obs[row]`."""
        frame = self._frame(observation)
        if self.spec.stack > 1:
            obs[row, -1] = frame
        else:
            obs[row] = frame

    def _mask(self, rows: list[int]) -> NDArray[np.bool_]:
        if not rows:
            return self._none
        mask = np.zeros(self.num_envs, bool)
        mask[rows] = True
        return mask


class FilmedGymnasium(GymnasiumEnv):
    """One environment as `FilmedEnv`: pictures that are its observations, or those that it renders."""

    def __init__(self, settings: EnvSettings, seed: int) -> None:
        """Raise UsageError for an environment that has no pictures, or lacks a package for them."""
        (env,), _ = _make(settings, 1)
        metadata, vectors = env.metadata, len(FrameMaker(settings, env.observation_space).shape) == 1
        env.close()
        if vectors and "rgb_array" not in metadata.get("render_modes", ()):
            raise UsageError(f"env.id: {settings.id!r} has no pictures to film")
        super().__init__(settings, [seed], "rgb_array" if vectors else None)
        self.pictures_per_s = float(metadata.get("render_fps", PICTURES_PER_S))
        self._renders = vectors

    def picture(self) -> NDArray[np.uint8]:
        """The newest frame of the observation in colour, or what the environment renders; raises UsageError."""
        if not self._renders:
            return coloured(self._obs[0, -1] if self.spec.stack > 1 else self._obs[0])
        os.environ.setdefault("SDL_VIDEODRIVER", "dummy")  # pygame needs neither a screen
        os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")  # nor to greet
        try:
            return np.asarray(self._envs[0].render(), np.uint8)
        except gymnasium.error.DependencyNotInstalled as error:
            raise UsageError(f"env.id: {self.spec.env_id!r} can't be filmed: {describe(error)}") from None


def gymnasium_spec(settings: EnvSettings) -> EnvSpec:
    """The specification of a gymnasium id.

    Raises:
        UsageError: the id is unknown, or a space or setting is not supported.
    """
    envs, _ = _make(settings, 1)
    try:
        return _spec_of(settings, envs[0], FrameMaker(settings, envs[0].observation_space))
    finally:
        envs[0].close()


def _make(
    settings: EnvSettings, count: int, render_mode: str | None = None
) -> tuple[list[gymnasium.Env[Any, Any]], int]:
    """Make environments without gymnasium's checks and step limit; return them and that limit (0: none)."""
    registered = find_registered(settings)
    # By the specification and not by the id, because `make` warns about ids that have a newer version.
    plain = dataclasses.replace(
        registered,
        order_enforce=False,
        disable_env_checker=True,
        max_episode_steps=None,
        kwargs={**registered.kwargs, **settings.kwargs, **({"render_mode": render_mode} if render_mode else {})},
    )
    try:
        envs = [gymnasium.make(plain) for _ in range(count)]
    except gymnasium.error.DependencyNotInstalled as error:
        raise UsageError(f"env.id: {settings.id!r} needs a package that is not installed: {error}") from None
    except Exception as error:
        text = f"env.id = {settings.id!r}, env.kwargs = {settings.kwargs}: {describe(error)}"
        raise UsageError(text) from error
    return envs, settings.max_episode_steps or registered.max_episode_steps or 0


def _spec_of(settings: EnvSettings, env: gymnasium.Env[Any, Any], frame: FrameMaker) -> EnvSpec:
    actions = env.action_space
    if not isinstance(actions, Discrete):
        raise UsageError(f"env.id: {settings.id!r} has the action space {actions}; allowed is Discrete")
    for what, most, limit in (
        ("actions", int(actions.n), MAX_ACTIONS),
        ("values on a side", max(frame.shape), MAX_SIDE),
    ):
        if most > limit:
            raise UsageError(f"env.id: {settings.id!r} has {most:,} {what}; allowed: at most {limit:,}")
    return EnvSpec(settings.id, frame.shape, frame.dtype, settings.stack, int(actions.n))
