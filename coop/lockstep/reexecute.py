"""Repeats a distributed run's training from its journal, in one process, and compares the parameters."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from coop.common.envs.make import env_spec
from coop.common.errors import RunError, UsageError
from coop.common.imports import hand_over
from coop.common.process.limits import use_threads
from coop.common.process.untrusted import check_links
from coop.common.settings.config import RunConfig
from coop.common.settings.resuming import settings_digest
from coop.learner.agent import Agent
from coop.learner.initial_networks import load_initial_networks
from coop.records.learner_checkpoints import fitting, load_learner
from coop.records.reading import read_run_config
from coop.records.resumption import Survey, survey
from coop.records.run_ids import read_run_id
from coop.records.summaries import read_summary
from coop.replay.core import ReplayCore
from coop.replay.persistence.checkpoints import ReplayCheckpoints
from coop.replay.persistence.journal import DRAW, Lost, journal_files, read_draw, read_file
from coop.replay.persistence.recovery import Replaying
from coop.replay.preload import preload


@dataclass(frozen=True, slots=True)
class Outcome:
    """The result of a re-execution.

    began: number of the checkpoint that it began from; 0 if the journal reaches back to the beginning of the run.
    updates: number of the checkpoint that it was compared with. not_checked: what it did not compare, in words.
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
    not_checked: tuple[str, ...]


def reexecute(run_dir: Path) -> Outcome:
    """Replay the journal of `run_dir` from its beginning, with every update of the learner.

    If a learner returned to a checkpoint and drew a batch again, the last draw of that number counts.

    Raises:
        UsageError: the folder holds no run with a journal and a finished checkpoint.
        RunError: the journal is incomplete, contains a segment twice or disagrees with the summary's transitions, or
            parameters, optimizers or random state differ in any bit.
    """
    check_links(run_dir)
    hand_over(run_dir)
    config = read_run_config(run_dir)
    folder = run_dir / "journal"
    if not journal_files(folder):
        raise UsageError(
            f"{run_dir}: no journal with a finished checkpoint; was the run started with --replay.journal?"
        )
    run_id = read_run_id(run_dir)
    found = survey(run_dir, replay=True, settings=settings_digest(config), load=load_learner, every=True)
    final = found.newest
    if final is None:
        raise UsageError(f"{run_dir}: no whole checkpoint to compare with; {found.passed_over or 'there is none'}")
    use_threads(config.learner.threads)
    with fitting(final.path):
        expected = final.state["agent"]
        agent, core, first = _beginning(config, found, folder, run_id)
    began = agent.updates
    closing = ReplayCore(config, core.table.spec)
    ReplayCheckpoints(run_dir, run_id).restore(closing, final.number)
    if closing.table.preload_sum != core.table.preload_sum:
        raise RunError(f"replay.preload = {config.replay.preload!r}: not the data set that the run began with")
    files = [number for number in journal_files(folder) if number >= first]
    counts = _last_draws(folder, files, run_id)
    waiting = {drawn.sequence: batch for batch, drawn in core.repeatable() if drawn.sequence not in counts}
    replaying = Replaying(core, folder, run_id)
    for place, (request, batch) in enumerate(replaying.draws(first, files)):
        _check_whole(replaying)
        if counts[request.sequence] == place:
            waiting[request.sequence] = batch.read()
        while agent.updates < expected["updates"] and agent.updates in waiting:
            agent.update(waiting.pop(agent.updates))
    _check_whole(replaying)
    if agent.updates < expected["updates"]:
        raise RunError(f"{folder}: lacks batch {agent.updates} of {expected['updates']}")
    if problem := _difference(agent.state(), expected, "agent"):
        raise RunError(f"{problem} differs from {final.path}")
    not_checked = _not_checked(found, began)
    accepted = read_summary(run_dir).get("transitions_accepted")
    if accepted is None:
        not_checked.append("the number of transitions, as there is no summary.json")
    elif accepted != core.table.inserted:
        raise RunError(f"{folder}: {core.table.inserted:,} transitions, but the run accepted {accepted:,}")
    digest = hashlib.sha256(b"".join(network.snapshot().tobytes() for network in agent.networks)).hexdigest()
    repeated, held = closing.table.repeated(), len(closing.table)
    return Outcome(
        began, agent.updates, core.table.inserted, core.missing_segments, repeated, held, digest, tuple(not_checked)
    )


def _check_whole(replaying: Replaying) -> None:
    """Raise RunError if something of the journal can't be read: what follows was trained on other batches."""
    if replaying.lost:
        raise RunError(f"{replaying.lost[0]}; nothing behind it can be compared")


def _not_checked(found: Survey, began: int) -> list[str]:
    lines = [f"checkpoint {number}: {why}" for number, why in sorted(found.problems.items())]
    if began:
        lines.insert(0, f"the updates before checkpoint {began}, which the journal does not reach back to")
    return lines


def _beginning(config: RunConfig, found: Survey, folder: Path, run_id: int) -> tuple[Agent, ReplayCore, int]:
    """Agent and core at the start of the journal's first file, or at the oldest checkpoint that it continues."""
    spec = env_spec(config.env)
    agent, core = Agent(config, spec), ReplayCore(config, spec)
    files = journal_files(folder)
    if files[0] == 1:
        load_initial_networks(agent)
        preload(core.table, config)
        return agent, core, 1
    for whole in sorted(found.whole, key=lambda each: each.number):
        first, _ = ReplayCheckpoints(found.run_dir, run_id).restore(core, whole.number)
        if first in files:
            agent.load_state(whole.state["agent"])
            return agent, core, first
        core = ReplayCore(config, spec)
    raise RunError(f"{folder}: begins at file {files[0]}, and no whole checkpoint precedes it")


def _last_draws(folder: Path, files: list[int], run_id: int) -> dict[int, int]:
    """For each batch number, the index of its last draw in the journal; raises RunError if a record can't be read."""
    last: dict[int, int] = {}
    place = 0
    for number in files:
        for entry in read_file(folder, number, run_id):
            if isinstance(entry, Lost):
                raise RunError(f"{entry.text}; nothing behind it can be compared")
            if entry.kind == DRAW:
                last[read_draw(entry.payload)[0].sequence] = place
                place += 1
    return last


def _difference(mine: Any, theirs: Any, name: str) -> str | None:  # noqa: ANN401 (nested state)
    """Describe the first place where nested states differ in any bit; None if they are equal."""
    if isinstance(mine, torch.Tensor):
        return None if mine.shape == theirs.shape and torch.equal(_bytes(mine), _bytes(theirs)) else name
    if isinstance(mine, dict) and mine.keys() == theirs.keys():
        pairs = [(mine[key], theirs[key], f"{name}.{key}") for key in mine]
    elif isinstance(mine, list | tuple) and len(mine) == len(theirs):
        pairs = [(a, b, f"{name}[{i}]") for i, (a, b) in enumerate(zip(mine, theirs, strict=True))]
    else:
        return None if mine == theirs else name
    return next((found for a, b, at in pairs if (found := _difference(a, b, at))), None)


def _bytes(tensor: torch.Tensor) -> torch.Tensor:
    """uint8 [bytes]; as numbers 0 and -0 would be equal, and nothing would equal NaN."""
    return tensor.reshape(-1).view(torch.uint8)
