"""Whole episodes of a run, from its kept journal or its table, as a Minari data set."""

from __future__ import annotations

import copy
import re
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from coop.common.errors import BadMessage, CoopError, RunError
from coop.common.messaging import wire
from coop.common.messaging.messages.insert import SegmentReader
from coop.common.process.files import make_folder, part_of, sync_all, sync_folder
from coop.common.transitions import Segment
from coop.common.types import Array, EnvSpec
from coop.evaluation.buffer import Buffer
from coop.evaluation.saved import SavedRun
from coop.records.run_ids import read_run_id
from coop.replay.persistence.journal import SEGMENT, Lost, journal_files, read_file


class NotWholeError(CoopError):
    """A run has no whole episodes; the text says why."""


@dataclass(frozen=True)
class Episode:
    """Consecutive transitions from an episode's start to its end, or between two ends that the learner saw.

    observations: <frame_dtype>[T + 1, *obs_shape]. actions: int32 [T]. rewards: float32 [T]. terminated: the last state
    is terminal; otherwise the episode was cut there.
    """

    observations: Array
    actions: NDArray[np.int32]
    rewards: NDArray[np.float32]
    terminated: bool


def export_minari(run_dir: Path, folder: Path) -> str:
    """Write a run's whole episodes to the new folder `folder`, completely or not at all; return what they are.

    Raises:
        NotWholeError: it has none; nothing is written.
        RunError: the folder can't be written.
    """
    run = SavedRun(run_dir)
    if run.config.replay.n_step > 1:
        raise NotWholeError(f"its transitions sum {run.config.replay.n_step} rewards, replay.n_step")
    buffer = run.buffer()
    kept = run.config.replay.journal_keep and journal_files(run_dir / "journal")[:1] == [1]
    episodes = _of_journal(run_dir, buffer.spec) if kept else _of_buffer(buffer)
    part = part_of(folder)
    try:
        make_folder(part / "data")
        try:
            count, steps = _write(episodes, run, buffer.spec, part / "data")
            if not count:
                raise NotWholeError(
                    "no episode is whole in the table; a run with --replay.journal-keep has all of them"
                )
            sync_all(part)
            part.replace(folder)
        finally:
            shutil.rmtree(part, ignore_errors=True)
        sync_folder(folder.parent)
    except OSError as error:
        raise RunError(f"{error.filename or folder}: {error.strerror or error}") from error
    source = "its journal" if kept else f"checkpoint {buffer.checkpoint}"
    return f"{count:,} whole episodes of {source}, {steps:,} transitions,"


def _write(episodes: Iterator[Episode], run: SavedRun, spec: EnvSpec, path: Path) -> tuple[int, int]:
    """Write a Minari data set; return the numbers of its episodes and transitions."""
    import minari  # noqa: PLC0415 (an extra)
    from minari.data_collector import EpisodeBuffer  # noqa: PLC0415
    from minari.dataset.minari_storage import MinariStorage  # noqa: PLC0415

    low, high = (0, 255) if spec.frame_dtype == "uint8" else (0, 1) if spec.frame_dtype == "bool" else (-np.inf, np.inf)
    observations = gym.spaces.Box(low, high, spec.obs_shape, np.dtype(spec.frame_dtype).type)
    storage = MinariStorage.new(
        path, observations, gym.spaces.Discrete(spec.num_actions), _env_spec(run), jpeg_encoding=False
    )
    name = re.sub(r"[^A-Za-z0-9_]+", "-", run.path.resolve().name).strip("-") or "run"
    storage.update_metadata(
        {
            "dataset_id": f"coop/{name}-v0",
            "minari_version": minari.__version__,
            "algorithm_name": run.config.method,
            "description": f"All whole episodes of a run of {run.config.env.id}, as its learner saw them",
        }
    )
    steps = 0

    def buffers() -> Iterator[Any]:
        nonlocal steps
        for each in episodes:
            length = len(each.actions)
            steps += length
            ends = np.arange(length) == length - 1
            yield EpisodeBuffer(
                observations=each.observations,
                actions=each.actions.astype(np.int64),
                rewards=each.rewards,
                terminations=ends & each.terminated,
                truncations=ends & (not each.terminated),
            )

    storage.update_episodes(buffers())
    return int(storage.total_episodes), steps


def _env_spec(run: SavedRun) -> Any:  # noqa: ANN401 (gymnasium's EnvSpec)
    """What gymnasium knows of the environment, if it does without an import; None if not."""
    settings = run.config.env
    if settings.atari or settings.id not in gym.registry:
        return None
    spec = copy.deepcopy(gym.spec(settings.id))
    spec.kwargs = {**spec.kwargs, **settings.kwargs}
    return spec


def _of_buffer(buffer: Buffer) -> Iterator[Episode]:
    """The episodes of which a table holds every transition."""
    if buffer.episode is None or buffer.length is None:
        raise NotWholeError("its transitions are of several emulators; a run with --replay.journal-keep has the order")
    for number in np.unique(buffer.episode[buffer.length > 0]):
        rows = np.flatnonzero(buffer.episode == number)
        if len(rows) == buffer.length[rows[0]]:
            yield from _cut(
                buffer.observations[rows],
                buffer.next_observations[rows],
                buffer.actions[rows],
                buffer.rewards[rows],
                buffer.terminated[rows],
            )


def _of_journal(run_dir: Path, spec: EnvSpec) -> Iterator[Episode]:
    """The episodes of a journal that begins with the run, stream by stream as they end.

    Segments of a stream may have arrived in another order. Of one that is missing, and of those on both sides, only the
    episodes that it cuts are left out.
    """
    waiting: dict[tuple[int, int], list[tuple[Array, ...]]] = {}
    following: dict[tuple[int, int], int] = {}
    cut: set[tuple[int, int]] = set()  # streams whose present episode lacks its beginning
    for stream, segment in _in_order(run_dir, spec):
        if segment.sequence != following.get(stream, 0):
            cut.add(stream)
        following[stream] = segment.sequence + 1
        columns = (
            segment.frames[segment.obs_index].reshape(-1, *spec.obs_shape),
            segment.frames[segment.next_index].reshape(-1, *spec.obs_shape),
            segment.actions,
            segment.rewards,
            segment.terminated,
        )
        start, rows = 0, waiting.setdefault(stream, [])
        for end in segment.episodes:
            stop = end.step_in_segment + 1
            rows.append(tuple(column[start:stop] for column in columns))
            if stream not in cut:
                yield from _cut(*(np.concatenate(parts) for parts in zip(*rows, strict=True)))
            cut.discard(stream)
            start = stop
            rows.clear()
        rows.append(tuple(column[start:] for column in columns))


def _in_order(run_dir: Path, spec: EnvSpec) -> Iterator[tuple[tuple[int, int], Segment]]:
    """The segments of a journal, each with its stream, in the order in which the stream's emulator played them."""
    read, folder, run_id = SegmentReader(spec), run_dir / "journal", read_run_id(run_dir)
    early: dict[tuple[int, int], dict[int, Segment]] = {}
    following: dict[tuple[int, int], int] = {}
    for number in journal_files(folder):
        for entry in read_file(folder, number, run_id):
            if isinstance(entry, Lost):
                raise NotWholeError(entry.text)
            if entry.kind != SEGMENT:
                continue
            try:
                segment = read(wire.decode(entry.payload))
            except BadMessage as error:  # sealed, so not by chance
                raise NotWholeError(f"{folder}: {error}") from error
            stream = segment.incarnation, segment.stream
            held, sequence = early.setdefault(stream, {}), following.get(stream, 0)
            held[segment.sequence] = segment
            while sequence in held:
                yield stream, held.pop(sequence)
                sequence += 1
            following[stream] = sequence
    for stream, held in early.items():
        for sequence in sorted(held):
            yield stream, held[sequence]


def _cut(obs: Array, next_obs: Array, actions: Array, rewards: Array, terminated: Array) -> Iterator[Episode]:
    """Cut a whole episode behind each terminal transition, such as a lost life that the learner takes as one."""
    stops = [*(np.flatnonzero(terminated) + 1), len(actions)]
    for start, stop in zip([0, *stops], stops, strict=False):
        if start == stop:
            continue
        if not np.array_equal(obs[start + 1 : stop], next_obs[start : stop - 1]):
            raise NotWholeError("an observation is not the one that followed the step before")
        rows = slice(start, stop)
        observations = np.concatenate((obs[rows], next_obs[stop - 1 : stop]))
        yield Episode(observations, actions[rows], rewards[rows], bool(terminated[stop - 1]))
