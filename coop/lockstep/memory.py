"""What becomes of the steps of a lockstep run: a replay table keeps them, or they are learned from at once and gone."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from coop.actors.player import Turn
from coop.actors.segments import SegmentAssembler
from coop.common.errors import RunError, UsageError
from coop.common.numbers import updates_due
from coop.common.registry import loaded
from coop.common.settings.config import RunConfig
from coop.common.settings.methods import METHODS
from coop.common.transitions import IN_BATCH, Batch, DrawRequest, Segment, filled
from coop.common.types import Array, EnvSpec
from coop.learner.agent import Agent
from coop.learner.methods.stream_q import StreamAgent, Transition
from coop.learner.protocol import AnyAgent
from coop.records.checkpoints import Damaged
from coop.replay.core import ReplayCore
from coop.replay.persistence.storage import Mark, load_snapshot, save_snapshot
from coop.replay.preload import preload


class Experience(Protocol):
    """The way from steps to batches."""

    def preload(self, config: RunConfig) -> list[str]:
        """Store the data set with which a run begins; return lines to say. Raises UsageError as `preload`."""

    def begin(self, obs: Array) -> None:
        """Store the run's first observation, <frame_dtype>[1, *obs_shape]."""

    def add(self, turn: Turn, step: int) -> None:
        """Store a step; step: its number, from 1."""

    def follow(self, turn: Turn, step: int) -> None:
        """Follow a step that is played again before `load`."""

    def batches(self, step: int) -> Iterator[Batch]:
        """Yield the batches to learn from after the first `step` steps of the run, the newest of which `add` stored."""

    def counters(self) -> dict[str, int]:
        """The fields of `Drawn` that say what is stored."""

    def update_priorities(self, ids: NDArray[np.int64], priorities: NDArray[np.float32]) -> None:
        """Store new priorities, float32 [batch], of the transitions with the numbers `ids`, int64 [batch]."""

    def save(self, folder: Path, mark: Mark) -> None:
        """Save what is stored for the checkpoint that `mark` names; raises OSError."""

    def load(self, folder: Path, mark: Mark) -> None:
        """Restore what `save` stored; raises UsageError if that is no longer whole."""


def make_experience(config: RunConfig, spec: EnvSpec) -> tuple[AnyAgent, Experience]:
    """The agent of a run's method, and the memory that it learns from."""
    stream = METHODS.get(config.method).stream
    if stream is None:
        return Agent(config, spec), TableMemory(config, spec)
    agent = loaded(stream, f"method {config.method!r}")(config, spec)
    return agent, LatestTransition(agent)


class TableMemory:
    """A replay table, of which batches are drawn as the replay ratio says.

    Steps are stored some at a time, which costs less: a segment ends where a batch is due, so every batch may hold
    every step before it.
    """

    def __init__(self, config: RunConfig, spec: EnvSpec) -> None:
        self._segments = SegmentAssembler(
            spec, 1, 0, config.actor.segment_steps, n_step=config.replay.n_step, gamma=config.learner.gamma
        )
        self._core = ReplayCore(config, spec)
        self.table = self._core.table
        self._eviction, self._offline = config.replay.eviction, config.replay.offline
        self.update_priorities = self.table.update_priorities
        self.begin = self._segments.begin

    def preload(self, config: RunConfig) -> list[str]:
        """See `Experience`."""
        return preload(self.table, config)

    @property
    def waiting(self) -> int:
        """Steps that the table does not hold yet; 0 only at a segment's end."""
        return self._segments.waiting + self._segments.incomplete

    def add(self, turn: Turn, step: int) -> None:
        """See `Experience`."""
        for segment in self._cut(turn, turn.version, step):
            self._core.apply_insert(segment)

    def follow(self, turn: Turn, step: int) -> None:
        """See `Experience`: the table is restored from its snapshot."""
        self._cut(turn, self.due(step - 1), step)

    def _cut(self, turn: Turn, version: int, step: int) -> list[Segment]:
        """Add a step; return the segments that it completes."""
        segments = self._segments.add(turn.actions, turn.steps, version, turn.ended)
        if self.due(step) > self.due(step - 1):
            segments += self._segments.flush()
        return segments

    def batches(self, step: int) -> Iterator[Batch]:
        """See `Experience`."""
        first, due = self.due(step - 1), self.due(step)
        if due > first and not len(self.table):
            raise RunError(f"replay.eviction = {self._eviction!r}: keeps none of {step:,} transitions")
        for number in range(first, due):
            request = DrawRequest(0, number, number, self._core.batch_size, self._core.episodes_total)
            yield self._core.apply_draw(request).batch.read()

    def due(self, step: int) -> int:
        """Number of updates due after the first `step` steps."""
        return updates_due(self._core.limiter.ratio, step) if self._offline else self._core.limiter.due(step)

    def counters(self) -> dict[str, int]:
        """See `Experience`."""
        table = self.table
        return {
            "size": len(table),
            "evicted": table.evicted,
            "evicted_unsampled": table.evicted_unsampled,
            "terminal": table.terminal,
        }

    def save(self, folder: Path, mark: Mark) -> None:
        """See `Experience`."""
        save_snapshot(self._core.snapshot(mark.number, (mark.number,)), threading.Condition(), folder, mark)

    def load(self, folder: Path, mark: Mark) -> None:
        """See `Experience`."""
        try:
            load_snapshot(self._core, folder, mark.run_id, mark.number)
        except Damaged as damaged:
            raise UsageError(f"{folder}: {damaged}") from damaged


class LatestTransition:
    """The newest transition alone, of which the agent learns once."""

    def __init__(self, agent: StreamAgent) -> None:
        self._agent = agent
        self._spec = agent.spec
        self._obs: Array
        self._turn: Turn
        stack = np.arange(self._spec.stack, dtype=np.int32)[None]
        self._index = stack, stack + self._spec.stack

    def preload(self, config: RunConfig) -> list[str]:
        """See `Experience`: there is nowhere to keep one."""
        return []

    def begin(self, obs: Array) -> None:
        """See `Experience`."""
        self._obs = obs
        self._agent.begin(obs[0])

    def add(self, turn: Turn, step: int) -> None:
        """See `Experience`."""
        self._turn = turn

    def follow(self, turn: Turn, step: int) -> None:
        """See `Experience`."""
        self._obs = turn.steps.obs

    def batches(self, step: int) -> Iterator[Batch]:
        """See `Experience`."""
        turn, steps = self._turn, self._turn.steps
        frames = np.concatenate((self._obs, steps.next_obs)).reshape(-1, *self._spec.frame_shape)
        self._obs = steps.obs
        obs_index, next_index = self._index
        given = {
            "obs_index": obs_index, "next_index": next_index, "actions": turn.actions, "rewards": steps.rewards,
            "terminated": steps.terminated, "ids": np.array([step - 1]), "param_version": np.array([turn.version]),
            "mask": steps.mask, "next_mask": steps.next_mask,
        }  # fmt: skip
        restart = steps.obs[0] if steps.restarted[0] else None
        yield Transition(frames=frames, restart=restart, **filled(IN_BATCH, 1, given))

    def counters(self) -> dict[str, int]:
        """See `Experience`."""
        return {}

    def update_priorities(self, ids: NDArray[np.int64], priorities: NDArray[np.float32]) -> None:
        """See `Experience`."""

    def save(self, folder: Path, mark: Mark) -> None:
        """See `Experience`."""

    def load(self, folder: Path, mark: Mark) -> None:
        """See `Experience`."""
