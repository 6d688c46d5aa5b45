"""Repeats a distributed run's training from its journal, in one process, and compares the parameters."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from common.envs.make import env_spec
from common.errors import RunError, UsageError
from common.imports import hand_over
from common.messaging.messages.sample import DrawRequest
from common.process.run_ids import read_run_id
from common.process.summaries import read_summary
from common.process.threads import use_threads
from common.process.untrusted import check_links
from common.settings.config import RunConfig
from common.settings.tables import load_tables, resolve
from learner.agent import Agent
from learner.initial_networks import load_initial_networks
from learner.records.epochs import complete_epochs, load_learner, newest_epoch
from replay.core import ReplayCore
from replay.persistence.epochs import ReplayEpochs
from replay.persistence.journal import DRAW, TornFile, journal_files, read_draw, read_file
from replay.persistence.recovery import following_files, replay_file
from replay.table.table import PinnedBatch


@dataclass(frozen=True, slots=True)
class Outcome:
    """The result of a re-execution.

    began: number of the first update; 0 if the journal reaches back to the beginning of the run.
    missing_segments: segments missing in the journal although it contains later ones of their stream.
    repeated, held: transitions of the closing table that equal another one there, and all that it holds.
    digest: SHA-256 over both networks' parameters.
    """

    began: int
    updates: int
    transitions: int
    missing_segments: int
    repeated: int
    held: int
    digest: str


def reexecute(run_dir: Path) -> Outcome:
    """Replay the journal of `run_dir` from its beginning, with every update of the learner.

    If a learner returned to an epoch and drew a batch again, the last draw of that number counts.

    Raises:
        UsageError: the folder holds no run with a journal and a finished epoch.
        RunError: the journal is incomplete, contains a segment twice or disagrees with the summary's transitions, or
            parameters, optimizers or random state differ in any bit.
    """
    check_links(run_dir)
    hand_over(run_dir)
    config = resolve(load_tables(None, run_dir / "config.toml"))
    final, folder, run_id = newest_epoch(run_dir), run_dir / "journal", read_run_id(run_dir)
    if final is None or not journal_files(folder):
        raise UsageError(f"{run_dir}: no journal with a finished epoch; was the run started with --replay.journal?")
    expected = load_learner(final)["agent"]
    use_threads(config.learner.threads)
    agent, core, first = _beginning(config, run_dir, folder, run_id)
    began = agent.updates
    files = following_files(folder, first)
    counts = _last_draws(folder, files, run_id)
    waiting = {drawn.sequence: batch for batch, drawn in core.repeatable() if drawn.sequence not in counts}
    for place, (request, batch) in enumerate(_draws(core, folder, files, run_id)):
        if counts[request.sequence] == place:
            waiting[request.sequence] = batch.read()
        while agent.updates < expected["updates"] and agent.updates in waiting:
            agent.update(waiting.pop(agent.updates))
    if agent.updates < expected["updates"]:
        raise RunError(f"{folder}: lacks batch {agent.updates} of {expected['updates']}")
    if problem := _difference(agent.state(), expected, "agent"):
        raise RunError(f"{problem} differs from {final}")
    accepted = read_summary(run_dir).get("transitions_accepted")
    if accepted != core.table.inserted:
        raise RunError(f"{folder}: {core.table.inserted:,} transitions, but the run accepted {accepted:,}")
    digest = hashlib.sha256(b"".join(network.snapshot().tobytes() for network in agent.networks)).hexdigest()
    closing = ReplayCore(config, core.table.spec)
    ReplayEpochs(run_dir, run_id).restore(closing, int(final.name))
    repeated, held = closing.table.repeated(), len(closing.table)
    return Outcome(began, agent.updates, core.table.inserted, core.missing_segments, repeated, held, digest)


def _beginning(config: RunConfig, run_dir: Path, folder: Path, run_id: int) -> tuple[Agent, ReplayCore, int]:
    """Agent and core at the start of the journal's first file, or at the oldest epoch that the journal continues."""
    spec = env_spec(config.env)
    agent, core = Agent(config, spec), ReplayCore(config, spec)
    files = journal_files(folder)
    if files[0] == 1:
        load_initial_networks(agent)
        return agent, core, 1
    for number in complete_epochs(run_dir):
        first, _ = ReplayEpochs(run_dir, run_id).restore(core, number)
        if first in files:
            agent.load_state(load_learner(run_dir / "checkpoints" / str(number))["agent"])
            return agent, core, first
        core = ReplayCore(config, spec)
    raise RunError(f"{folder}: begins at file {files[0]}, and no epoch precedes it")


def _last_draws(folder: Path, files: list[int], run_id: int) -> dict[int, int]:
    """For each batch number, the index of its last draw in the journal."""
    last: dict[int, int] = {}
    place = 0
    for number in files:
        try:
            for kind, payload in read_file(folder, number, run_id):
                if kind == DRAW:
                    last[read_draw(payload)[0].sequence] = place
                    place += 1
        except TornFile:
            if number != files[-1]:  # a kill leaves an incomplete record only at the end of the journal
                raise
    return last


def _draws(core: ReplayCore, folder: Path, files: list[int], run_id: int) -> Iterator[tuple[DrawRequest, PinnedBatch]]:
    for number in files:
        try:
            yield from replay_file(core, folder, number, run_id)
        except TornFile:
            if number != files[-1]:
                raise


def _difference(mine: Any, theirs: Any, name: str) -> str | None:  # noqa: ANN401 (nested state)
    """Describe the first place where nested states differ in any bit; None if they are equal."""
    if isinstance(mine, torch.Tensor):
        return None if torch.equal(mine, theirs) else name
    if isinstance(mine, dict):
        pairs = [(mine[key], theirs[key], f"{name}.{key}") for key in mine]
    elif isinstance(mine, list | tuple):
        pairs = [(a, b, f"{name}[{i}]") for i, (a, b) in enumerate(zip(mine, theirs, strict=True))]
    else:
        return None if mine == theirs else name
    return next((found for a, b, at in pairs if (found := _difference(a, b, at))), None)
