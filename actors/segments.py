"""Cuts the steps of many emulator streams into segments that hold each frame once."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from coop.actors.frame_block import FrameBlock
from coop.actors.returns import n_step_returns
from coop.common.envs.protocol import Steps
from coop.common.transitions import MASKS, Segment
from coop.common.types import Array, EnvSpec, EpisodeEnd


class SegmentAssembler:
    """Turns the steps of `num_envs` streams into segments; emulator i is stream `first_stream` + i. Without I/O.

    Each step begins one transition over `n_step` steps, or fewer if its episode ends earlier. A transition belongs to
    the segment in which it becomes complete; until then it waits, even across flushes, so that every transition is
    exact wherever segments are cut. All streams have equally many steps, so their segments are cut together. The
    arrays of a returned segment are never written again, but segments of one round share memory: keeping one segment
    keeps the whole round.
    """

    def __init__(
        self,
        spec: EnvSpec,
        num_envs: int,
        incarnation: int,
        segment_steps: int,
        *,
        n_step: int = 1,
        gamma: float = 1.0,
        first_stream: int = 0,
    ) -> None:
        self._first_stream = first_stream
        self._num_envs, self._incarnation, self._length = num_envs, incarnation, segment_steps
        self._n_step, self._gamma = n_step, gamma
        # Rows of a round's columns: first the earlier steps whose transitions may still wait, then its own steps.
        self._history = n_step - 1
        self._frames = FrameBlock(spec, num_envs, segment_steps, self._history)
        shape = (self._history + segment_steps, num_envs)
        self._actions = np.zeros(shape, np.int32)
        self._rewards = np.zeros(shape, np.float32)
        self._terminated = np.zeros(shape, np.bool_)
        self._ends = np.ones(shape, np.bool_)  # no transition waits before the first step
        self._versions = np.zeros(shape[0], np.int64)
        self._masks = [np.zeros((*shape, spec.num_actions), np.bool_) for _ in MASKS] if spec.masks else []
        self._before = np.arange(-1, shape[0] - 1)  # the step before each row's
        self._episodes: dict[int, list[EpisodeEnd]] = {}
        self._waiting = [0] * num_envs  # number of each stream's earlier steps whose transitions are not complete
        self._carried = [0] * num_envs
        self._sequences = [0] * num_envs
        self._steps = 0

    @property
    def waiting(self) -> int:
        """Steps of each stream since the last flush."""
        return self._steps

    @property
    def incomplete(self) -> int:
        """Steps of a stream up to the last flush whose transitions were not complete there."""
        return max(self._waiting)

    def begin(self, obs: Array) -> None:
        """Store the first observations of all streams, <frame_dtype>[envs, *obs_shape]; call once, before `add`."""
        self._frames.restart(range(self._num_envs), obs)

    def add(
        self, actions: NDArray[np.int32], steps: Steps, param_version: int, episode_ends: Mapping[int, EpisodeEnd]
    ) -> list[Segment]:
        """Add one step of every stream; return the segments if it fills a round, one per stream with transitions.

        actions: int32 [envs]. param_version: of the parameters that chose them.
        episode_ends: the episodes that this step ended, by stream; their `step_in_segment` is set here.
        """
        now = self._history + self._steps
        self._frames.push(steps.next_obs)
        if np.count_nonzero(steps.restarted):
            self._frames.restart(np.flatnonzero(steps.restarted).tolist(), steps.obs)
        self._actions[now] = actions
        self._rewards[now] = steps.rewards
        self._terminated[now] = steps.terminated
        np.logical_or(steps.terminated, steps.restarted, out=self._ends[now])
        self._versions[now] = param_version
        for column, mask in zip(self._masks, (steps.mask, steps.next_mask), strict=False):
            column[now] = mask
        for stream, end in episode_ends.items():
            place = self._waiting[stream] + self._steps
            self._episodes.setdefault(stream, []).append(msgspec.structs.replace(end, step_in_segment=place))
        self._steps += 1
        return self.flush() if self._steps == self._length else []

    def flush(self) -> list[Segment]:
        """Cut every stream here; return a segment for each stream that has complete transitions."""
        steps, self._steps = self._steps, 0
        if not steps:
            return []
        history, end = self._history, self._history + steps
        last, returns = n_step_returns(self._rewards[:end], self._ends[:end], self._n_step, self._gamma)
        stops = [int(spanned.searchsorted(end)) for spanned in last.T]  # `last` never decreases
        waiting = [end - stop for stop in stops]
        frames, obs_index, next_index, kept = self._frames.cut(waiting)
        segments = []
        for stream, stop in enumerate(stops):
            first = history - self._waiting[stream]
            if first < stop:
                final = last[first:stop, stream]
                masks: dict[str, Any] = {}
                if self._masks:
                    mask, next_mask = (column[:, stream] for column in self._masks)
                    masks = {"mask": mask[first:stop].copy(), "next_mask": next_mask.take(final, axis=0)}
                segments.append(
                    Segment(
                        incarnation=self._incarnation,
                        stream=self._first_stream + stream,
                        sequence=self._sequences[stream],
                        frames=frames[stream],
                        obs_index=obs_index[stream, first:stop],
                        next_index=next_index[stream].take(final - history, axis=0),
                        actions=self._actions[first:stop, stream].copy(),
                        rewards=returns[first:stop, stream].copy(),
                        terminated=self._terminated[:, stream].take(final),
                        param_version=self._versions[first:stop].copy(),
                        span=(final - self._before[first:stop]).astype(np.uint8),
                        carried=self._carried[stream],
                        episodes=tuple(self._episodes.get(stream, ())),
                        **masks,
                    )
                )
                self._sequences[stream] += 1
                self._carried[stream] = kept[stream]
        self._waiting = waiting
        self._episodes = {}
        if history:
            for column in (self._actions, self._rewards, self._terminated, self._ends, self._versions, *self._masks):
                column[:history] = column[steps:end].copy()
        return segments
