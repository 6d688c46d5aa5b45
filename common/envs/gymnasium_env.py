"""Any gymnasium environment with a Box or picture observation and Discrete actions, as a vector environment."""

from __future__ import annotations

import dataclasses
from difflib import get_close_matches
from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Discrete
from numpy.typing import NDArray

from common.envs import catch as _registers_catch  # noqa: F401
from common.envs import corridor as _registers_corridor  # noqa: F401
from common.envs.pictures import SIDE, PictureResizer
from common.envs.protocol import Steps
from common.errors import UsageError
from common.settings.environment import EnvSettings
from common.types import Array, EnvSpec


class GymnasiumEnv:
    """Plain gymnasium environments stepped one after another, as `VectorEnv`.

    A vector observation is one float32 frame. A picture becomes an 84x84 grayscale frame (unless it is one
    already), and `stack` frames make one observation; zeros stand for frames before an episode's first.
    """

    def __init__(self, settings: EnvSettings, seeds: list[int]) -> None:
        self._envs, self._limit = _make(settings, len(seeds))
        self.spec = _spec_of(settings, self._envs[0])
        self.num_envs = len(seeds)
        self._seeds = seeds
        self._clip = settings.clip_rewards
        self._limit_terminal = settings.time_limit_terminal
        self._pictures = self.spec.frame_dtype == "uint8"
        space, actions = self._envs[0].observation_space, self._envs[0].action_space
        assert space.shape is not None
        assert isinstance(actions, Discrete)
        self._first_action = int(actions.start)
        self._resize = PictureResizer(space.shape) if self._pictures else None
        self._lengths = [0] * self.num_envs
        self._obs = np.empty(0)
        self._actions = np.empty(0, np.int32)
        # Shared by all steps in which no episode ends, so it must not be written to.
        self._none = np.zeros(self.num_envs, bool)
        self._none.flags.writeable = False

    def reset(self) -> Array:
        """Start every emulator from its seed: <frame_dtype>[envs, *obs_shape]."""
        frames = [env.reset(seed=seed)[0] for env, seed in zip(self._envs, self._seeds, strict=True)]
        self._lengths = [0] * self.num_envs
        self._obs = np.zeros((self.num_envs, *self.spec.obs_shape), self.spec.frame_dtype)
        for row, frame in enumerate(frames):
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

    def _put(self, obs: Array, row: int, frame: Array) -> None:
        """Store an environment's observation as the newest frame of `obs[row]`."""
        if self._resize is not None:
            frame = self._resize(frame)
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


def gymnasium_spec(settings: EnvSettings) -> EnvSpec:
    """The specification of a gymnasium id.

    Raises:
        UsageError: the id is unknown, or a space is not supported.
    """
    envs, _ = _make(settings, 1)
    try:
        return _spec_of(settings, envs[0])
    finally:
        envs[0].close()


def _make(settings: EnvSettings, count: int) -> tuple[list[gymnasium.Env[Any, Any]], int]:
    """Make environments without gymnasium's checks and step limit; return them and that limit (0: none)."""
    try:
        # By the specification and not by the id, because `make` warns about ids that have a newer version.
        registered = gymnasium.spec(settings.id)
        plain = dataclasses.replace(registered, order_enforce=False, disable_env_checker=True, max_episode_steps=None)
        envs = [gymnasium.make(plain) for _ in range(count)]
    except gymnasium.error.DependencyNotInstalled as error:
        raise UsageError(f"env.id: {settings.id!r} needs a package that is not installed: {error}") from None
    except gymnasium.error.Error:
        near = ", ".join(get_close_matches(settings.id, gymnasium.registry, n=3)) or "CartPole-v0, coop/Catch-v0"
        raise UsageError(
            f"env.id: unknown environment {settings.id!r}; known are gymnasium's ids, such as {near}, and ALE's games"
        ) from None
    return envs, settings.max_episode_steps or registered.max_episode_steps or 0


def _spec_of(settings: EnvSettings, env: gymnasium.Env[Any, Any]) -> EnvSpec:
    space, actions = env.observation_space, env.action_space
    if not isinstance(actions, Discrete):
        raise UsageError(f"env.id: {settings.id!r} has the action space {actions}; allowed is Discrete")
    num_actions, shape = int(actions.n), space.shape or ()
    if isinstance(space, Box) and len(shape) == 1:
        return EnvSpec(settings.id, shape, "float32", 1, num_actions)
    picture = len(shape) == 2 or (len(shape) == 3 and shape[2] in {1, 3})
    if isinstance(space, Box) and space.dtype == np.uint8 and picture:
        return EnvSpec(settings.id, (SIDE, SIDE), "uint8", settings.stack, num_actions)
    raise UsageError(
        f"env.id: {settings.id!r} has the observation space {space}; allowed is a one-dimensional Box or a uint8 "
        "picture, Box of height x width, height x width x 1 or height x width x 3"
    )
