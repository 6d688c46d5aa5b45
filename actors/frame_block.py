"""The frames of a round of segments: one growing row of frames a stream, and which of them make its observation."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from common.types import Array, EnvSpec


class FrameBlock:
    """Frames <frame_dtype>[envs, capacity, *frame_shape], filled from the front, each stream at its own pace.

    `current`: int32 [envs, stack], the rows of the frames that make each stream's observation, oldest first; they
    never decrease, and the last one is the stream's newest frame.
    """

    def __init__(self, spec: EnvSpec, num_envs: int, steps: int) -> None:
        self._spec, self._num_envs = spec, num_envs
        self._capacity = steps + 4 * spec.stack  # room for some restarts; grows where that is not enough
        self._frames = self._allocate()
        self._streams = np.arange(num_envs)
        self._used = np.zeros(num_envs, np.int32)
        self._most = 0  # at least max(used), kept without looking at the array
        self.current = np.zeros((num_envs, spec.stack), np.int32)

    def push(self, obs: Array) -> NDArray[np.int32]:
        """Store the newest frame of every stream's observation, which continues the last; the new `current`.

        obs: <frame_dtype>[envs, *obs_shape].
        """
        self._reserve(1)
        self._frames[self._streams, self._used] = obs[:, -1] if self._spec.stack > 1 else obs
        current = np.empty_like(self.current)
        current[:, :-1] = self.current[:, 1:]
        current[:, -1] = self._used
        self._used += 1
        self.current = current
        return current

    def restart(self, streams: Iterable[int], obs: Array) -> None:
        """Store the whole observations of streams that do not continue; frames equal to their neighbour once.

        obs: <frame_dtype>[envs, *obs_shape].
        """
        self._reserve(self._spec.stack)
        stacks = obs.reshape(self._num_envs, self._spec.stack, *self._spec.frame_shape)
        self.current = self.current.copy()
        for stream in streams:
            row = int(self._used[stream]) - 1
            for place, frame in enumerate(stacks[stream]):
                if place == 0 or not np.array_equal(frame, stacks[stream, place - 1]):
                    row += 1
                    self._frames[stream, row] = frame
                self.current[stream, place] = row
            self._used[stream] = row + 1

    def cut(self) -> tuple[list[Array], list[int]]:
        """End the round: each stream's frames, and how many of the last ones begin its next round.

        The next round begins with the frames of the current observation, in rows from 0.
        """
        first = self.current[:, 0]
        carried = (self._used - first).tolist()
        full, used = self._frames, self._used.tolist()
        self._frames = self._allocate()
        for stream, count in enumerate(carried):
            self._frames[stream, :count] = full[stream, used[stream] - count : used[stream]]
        self.current = self.current - first[:, None]
        self._used = self._used - first
        self._most = max(carried)
        return [frames[:count] for frames, count in zip(full, used, strict=True)], carried

    def _reserve(self, count: int) -> None:
        """Make room for `count` more frames in every stream."""
        if self._most + count > self._capacity:
            self._most = int(self._used.max())
            if self._most + count > self._capacity:
                self._capacity += self._capacity // 2 + count
                old, self._frames = self._frames, self._allocate()
                self._frames[:, : self._most] = old[:, : self._most]
        self._most += count

    def _allocate(self) -> Array:
        return np.empty((self._num_envs, self._capacity, *self._spec.frame_shape), self._spec.frame_dtype)
