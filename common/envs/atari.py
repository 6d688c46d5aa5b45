"""Atari games in ALE's native vector environment: C++ threads, frame skip, max-pool, 84x84 grayscale, stacking."""

from __future__ import annotations

from typing import Any

import ale_py
import numpy as np
from ale_py import roms
from ale_py.vector_env import AtariVectorEnv
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray

from coop.common.envs.protocol import Steps
from coop.common.errors import UsageError
from coop.common.settings.environment import EnvSettings
from coop.common.types import Array, EnvSpec

FRAMES_PER_S = 60
SCREEN = (210, 160)  # height, width
FRAME_LIMIT = 108_000  # emulator frames of an episode, half an hour of play


class AtariEnv:
    """Emulators of one game, as `VectorEnv`.

    After a reset the stack holds zeros and the first frame. A lost life does not change the stack: with
    `episodic_life` it is terminal for learning only. The limit on an episode's length counts from the first
    frame after the no-ops. The emulator stops in the middle of a frame skip when a game or its time ends, so the last
    frame of such an episode is pooled from the frames until then.
    An action out of range would stop the emulators' threads for good, so `send` refuses it.
    """

    def __init__(self, settings: EnvSettings, game: str, seeds: list[int]) -> None:
        self.spec = atari_spec(settings, game)
        self.num_envs = len(seeds)
        self.mask: NDArray[np.bool_] | None = None
        self._seeds = np.array(seeds)
        self._clip = settings.clip_rewards
        self._limit_terminal = settings.time_limit_terminal
        self._ale = _emulators(settings, game, self.num_envs, stack_num=settings.stack)
        self._game_start = np.empty(0)

    def reset(self) -> Array:
        """Start every emulator from its seed: uint8 [envs, *obs_shape]."""
        obs, info = self._ale.reset(seed=self._seeds)
        self._game_start = info["frame_number"] - info["episode_frame_number"]
        return self._shape(obs)

    def send(self, actions: NDArray[np.int32]) -> None:
        """Let the emulators' threads begin to play one action each, int32 [envs].

        Raises:
            ValueError: an action is out of range.
        """
        if actions.min() < 0 or actions.max() >= self.spec.num_actions:
            raise ValueError(f"actions: {actions.tolist()}; allowed are 0..{self.spec.num_actions - 1}")
        self._ale.send(actions)

    def recv(self) -> Steps:
        """Wait for all emulators."""
        obs, rewards, terminated, _, info = self._ale.recv()
        # The frames played before the current game change exactly when the emulator was reset: `terminated` is
        # also set by a lost life, and a reset with `truncated` unset is possible when both fall together.
        game_start = info["frame_number"] - info["episode_frame_number"]
        restarted = game_start != self._game_start
        self._game_start = game_start
        obs = next_obs = self._shape(obs)
        if np.count_nonzero(restarted):
            next_obs = obs.copy()
            next_obs[restarted] = self._shape(info["final_obs"])[restarted]
        if self._limit_terminal:
            terminated = terminated | restarted
        raw_rewards = rewards.astype(np.float64)
        learned = np.clip(rewards, -1, 1) if self._clip else rewards
        return Steps(obs, next_obs, learned.astype(np.float32), raw_rewards, terminated, restarted, restarted)

    def step(self, actions: NDArray[np.int32]) -> Steps:
        """`send`, then `recv`; raises as `send`."""
        self.send(actions)
        return self.recv()

    def close(self) -> None:
        """Join the emulators' threads."""
        del self._ale

    def _shape(self, obs: Array) -> Array:
        return obs.reshape(self.num_envs, *self.spec.obs_shape)


class FilmedAtari(AtariEnv):
    """One emulator of a game, as `FilmedEnv`: a second one plays the same actions from the same seed in full colour."""

    def __init__(self, settings: EnvSettings, game: str, seed: int) -> None:
        super().__init__(settings, game, [seed])
        self.pictures_per_s = FRAMES_PER_S / settings.frame_skip
        self._twin = _emulators(
            settings, game, 1, stack_num=1, grayscale=False, img_height=SCREEN[0], img_width=SCREEN[1]
        )
        self._picture: Array

    def reset(self) -> Array:
        """See `AtariEnv`."""
        self._show(self._twin.reset(seed=self._seeds)[0])
        return super().reset()

    def send(self, actions: NDArray[np.int32]) -> None:
        """See `AtariEnv`."""
        super().send(actions)
        self._twin.send(actions)

    def recv(self) -> Steps:
        """See `AtariEnv`."""
        self._show(self._twin.recv()[0])
        return super().recv()

    def picture(self) -> NDArray[np.uint8]:
        """The screen: uint8 [210, 160, 3]."""
        return self._picture

    def close(self) -> None:
        """Join both emulators' threads."""
        super().close()
        del self._twin

    def _show(self, screens: Array) -> None:
        self._picture = screens.reshape(*SCREEN, 3)


def _emulators(
    settings: EnvSettings,
    game: str,
    count: int,
    autoreset: AutoresetMode = AutoresetMode.SAME_STEP,
    **screen: Any,  # noqa: ANN401
) -> AtariVectorEnv:
    """ALE's emulators of a game; screen: how they show it."""
    limit = settings.max_episode_steps * settings.frame_skip
    return AtariVectorEnv(
        game,
        count,
        autoreset_mode=autoreset,
        max_num_frames_per_episode=limit or FRAME_LIMIT,
        repeat_action_probability=settings.repeat_action_probability,
        full_action_space=settings.full_action_space,
        frameskip=settings.frame_skip,
        noop_max=settings.noop_max + 1,  # ALE draws from 0..noop_max-1
        use_fire_reset=False,
        # This ends the episode for learning and keeps the game; ALE's `episodic_life` would reset the emulator.
        life_loss_info=settings.episodic_life,
        reward_clipping=False,
        **screen,
    )


def atari_spec(settings: EnvSettings, game: str) -> EnvSpec:
    """The specification of a game, given the name of its ROM.

    Raises:
        UsageError: the ROM's file is missing or has the wrong content.
    """
    ale_py.ALEInterface.setLoggerMode(ale_py.LoggerMode.Error)
    emulator = ale_py.ALEInterface()
    try:
        rom = roms.get_rom_path(game)
        assert rom is not None  # a name that ale-py knows
        emulator.loadROM(rom)
    except OSError as error:
        raise UsageError(f"env.id: the ROM of {game!r} can't be read: {error}") from None
    actions = emulator.getLegalActionSet() if settings.full_action_space else emulator.getMinimalActionSet()
    return EnvSpec(settings.id, (84, 84), "uint8", settings.stack, len(actions))
