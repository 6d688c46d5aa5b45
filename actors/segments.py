"""Steps of many emulator streams, cut into segments that hold each frame once."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from actors.frame_block import FrameBlock
from common.envs.protocol import Steps
from common.types import Array, EnvSpec, EpisodeEnd, Segment


class SegmentAssembler:
    """Turns the steps of `num_envs` streams into segments; stream i is emulator i. Pure: no I/O, no clock.

    All streams have had equally many steps, so their segments fill together. The arrays of a returned segment are
    never written again, but those of one round share memory: a segment that is kept keeps the round.
    """

    def __init__(self, spec: EnvSpec, num_envs: int, incarnation: int, segment_steps: int) -> None:
        self._num_envs, self._incarnation, self._length = num_envs, incarnation, segment_steps
        self._frames = FrameBlock(spec, num_envs, segment_steps)
        self._actions = np.empty((segment_steps, num_envs), np.int32)
        self._rewards = np.empty((segment_steps, num_envs), np.float32)
        self._terminated = np.empty((segment_steps, num_envs), np.bool_)
        self._versions = np.empty(segment_steps, np.int64)
        self._episodes: dict[int, list[EpisodeEnd]] = {}
        self._carried = [0] * num_envs
        self._sequence = 0
        self._steps = 0

    def begin(self, obs: Array) -> None:
        """Take the first observations, <frame_dtype>[envs, *obs_shape], of all streams; once, before `add`."""
        self._frames.restart(range(self._num_envs), obs)

    def add(
        self, actions: NDArray[np.int32], steps: Steps, param_version: int, episode_ends: Mapping[int, EpisodeEnd]
    ) -> list[Segment]:
        """Add one step of every stream; the segments that it filled, one a stream, or none.

        actions: int32 [envs]. param_version: of the parameters that chose them.
        episode_ends: by stream, the episodes that this step ended; their `step_in_segment` is set here.
        """
        now = self._steps
        self._frames.push(steps.next_obs)
        if np.count_nonzero(steps.restarted):
            self._frames.restart(np.flatnonzero(steps.restarted).tolist(), steps.obs)
        self._actions[now] = actions
        self._rewards[now] = steps.rewards
        self._terminated[now] = steps.terminated
        self._versions[now] = param_version
        for stream, end in episode_ends.items():
            self._episodes.setdefault(stream, []).append(replace(end, step_in_segment=now))
        self._steps += 1
        return self.flush() if self._steps == self._length else []

    def flush(self) -> list[Segment]:
        """Cut every stream here: the segments begun, one a stream, or none if no step was added since the last."""
        steps, self._steps = self._steps, 0
        if not steps:
            return []
        frames, obs_index, next_index, carried = self._frames.cut()
        actions, rewards, terminated = (
            np.array(column[:steps].T, order="C") for column in (self._actions, self._rewards, self._terminated)
        )
        versions = self._versions[:steps].copy()
        segments = [
            Segment(
                incarnation=self._incarnation,
                stream=stream,
                sequence=self._sequence,
                frames=frames[stream],
                obs_index=obs_index[stream],
                next_index=next_index[stream],
                actions=actions[stream],
                rewards=rewards[stream],
                terminated=terminated[stream],
                param_version=versions,
                carried=self._carried[stream],
                episodes=tuple(self._episodes.get(stream, ())),
            )
            for stream in range(self._num_envs)
        ]
        self._carried = carried
        self._episodes = {}
        self._sequence += 1
        return segments


@dataclass(frozen=True, slots=True)
class FinishedEpisode:
    """An episode that ended with the last step: the stream, its unclipped return, its length in steps."""

    stream: int
    episode_return: float
    length: int


class EpisodeTracker:
    """Sums up the unclipped rewards and the steps of every stream's episode."""

    def __init__(self, num_envs: int) -> None:
        self._returns = np.zeros(num_envs)
        self._steps = 0
        self._begun = [0] * num_envs

    def add(self, steps: Steps) -> list[FinishedEpisode]:
        """Add one step of every stream; the episodes that it ended."""
        self._returns += steps.raw_rewards
        self._steps += 1
        if not np.count_nonzero(steps.episode_over):
            return []
        finished = []
        for stream in np.flatnonzero(steps.episode_over).tolist():
            length = self._steps - self._begun[stream]
            finished.append(FinishedEpisode(stream, float(self._returns[stream]), length))
            self._returns[stream] = 0.0
            self._begun[stream] = self._steps
        return finished
