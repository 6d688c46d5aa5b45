"""The frames of a round of segments: a growing row of frames per stream, and the indices that make observations."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from coop.common.types import Array, EnvSpec

Rows = NDArray[np.int32]


class FrameBlock:
    """Frames <frame_dtype>[envs, capacity, *frame_shape], filled from the front, each stream at its own pace.

    A step copies one frame per stream. Indices are computed at the end of the round: a stack that continues consists
    of the last `stack` rows pushed, so only restarts have to be recorded.
    """

    def __init__(self, spec: EnvSpec, num_envs: int, max_steps: int, history: int = 0) -> None:
        """history: steps before a round whose observations the round may still need."""
        self._spec, self._num_envs, self._history = spec, num_envs, history
        self._capacity = history + max_steps + 4 * spec.stack  # room for some restarts; grows if that is too little
        self._allocate()
        # Row numbers, in `_free` and `_pushed`, count through all streams: stream * capacity + row.
        self._free = self._first.copy()
        # The stacks at the start of the round, then the row that each step pushed.
        self._pushed = np.zeros((spec.stack + max_steps, num_envs), np.int64)
        self._windows = np.arange(max_steps + 1)[:, None] + np.arange(spec.stack)
        self._steps = 0
        self._most = 0  # upper bound of the rows of any stream, kept without reading arrays
        self._past: Rows = np.zeros((num_envs, history, spec.stack), np.int32)  # stacks of the steps before the round
        self._restarts: list[tuple[int, int, list[int]]] = []  # steps before it, stream, rows of the new stack

    def push(self, obs: Array) -> None:
        """Store the newest frame of each stream's continuing observation, <frame_dtype>[envs, *obs_shape]."""
        if self._most == self._capacity:
            self._reserve(1)
        self._flat[self._free] = obs[:, -1] if self._spec.stack > 1 else obs
        self._pushed[self._spec.stack + self._steps] = self._free
        self._free += 1
        self._most += 1
        self._steps += 1

    def restart(self, streams: Iterable[int], obs: Array) -> None:
        """Store the whole observations of streams that restarted; consecutive equal frames only once.

        obs: <frame_dtype>[envs, *obs_shape].
        """
        stack = self._spec.stack
        if self._most + stack > self._capacity:
            self._reserve(stack)
        self._most += stack
        for stream in streams:
            row, rows, before = int(self._free[stream]) - 1, [], None
            for frame in obs[stream] if stack > 1 else obs[stream : stream + 1]:
                if (content := frame.tobytes()) != before:
                    row, before = row + 1, content
                    self._flat[row] = frame
                rows.append(row - stream * self._capacity)
            self._free[stream] = row + 1
            self._restarts.append((self._steps, stream, rows))

    def cut(self, waiting: list[int]) -> tuple[list[Array], Rows, Rows, list[int]]:
        """End the round; the next one begins with the frames of the current observations.

        waiting: number of each stream's last steps, at most `history`, that are needed again; their frames stay too.

        Returns:
            frames: of each stream, <frame_dtype>[n_frames, *frame_shape].
            obs_index: int32 [envs, history + steps, stack], including steps before the round; meaningless for those
                that did not wait. next_index: int32 [envs, steps, stack].
            kept: number of each stream's last frames that begin its next round.
        """
        of_round, next_index = self._indices()
        obs_index = np.concatenate((self._past, of_round), axis=1) if self._history else of_round
        current = obs_index.shape[1] - 1
        first = [int(rows[current - count, 0]) for rows, count in zip(obs_index, waiting, strict=True)]
        used: list[int] = (self._free - self._first).tolist()
        kept = [count - row for count, row in zip(used, first, strict=True)]
        frames = [frames[:count] for frames, count in zip(self._frames, used, strict=True)]
        self._allocate()
        for stream, count in enumerate(kept):
            self._frames[stream, :count] = frames[stream][-count:]
        moved = self._first - first
        self._pushed[: self._spec.stack] = obs_index[:, -1].T + moved
        if self._history:
            self._past = obs_index[:, current - self._history : current] - np.array(first, np.int32)[:, None, None]
        self._free = self._first + kept
        self._most = max(kept)
        self._steps = 0
        self._restarts = []
        return frames, obs_index[:, :-1], next_index, kept

    def _indices(self) -> tuple[Rows, Rows]:
        """Rows of obs, int32 [envs, steps + 1, stack] (last: the next step's), and next_obs, [envs, steps, stack]."""
        stack = self._spec.stack
        rows = (self._pushed[: stack + self._steps] - self._first).astype(np.int32)
        obs_index = rows.T.take(self._windows[: self._steps + 1], axis=1)
        next_index = obs_index[:, 1:].copy() if self._restarts else obs_index[:, 1:]
        for steps, stream, stacked in self._restarts:
            # `later` steps after the restart, the stack still begins with the new stack's frames from `later` on.
            for later in range(min(stack, self._steps + 1 - steps)):
                obs_index[stream, steps + later, : stack - later] = stacked[later:]
                next_index[stream, steps + later : steps + later + 1, : stack - later - 1] = stacked[later + 1 :]
        return obs_index, next_index

    def _reserve(self, count: int) -> None:
        """Make room for `count` more frames in every stream."""
        self._most = int((self._free - self._first).max())
        if self._most + count <= self._capacity:
            return
        old, before, first = self._frames, self._capacity, self._first
        self._capacity += before // 2 + count
        self._allocate()
        self._frames[:, :before] = old
        shift = self._first - first
        self._free += shift
        self._pushed[: self._spec.stack + self._steps] += shift

    def _allocate(self) -> None:
        self._first = np.arange(self._num_envs) * self._capacity  # row of each stream's first frame
        shape = (self._num_envs * self._capacity, *self._spec.frame_shape)
        self._flat: Array = np.empty(shape, self._spec.frame_dtype)
        self._frames = self._flat.reshape(self._num_envs, self._capacity, *self._spec.frame_shape)
