"""Rules between the fields of a config; the types of single fields give their own bounds."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator
from dataclasses import replace
from typing import TypeVar

from coop.common.bounds import MAX_SEGMENT_STEPS
from coop.common.errors import UsageError
from coop.common.settings.config import NETWORK_KINDS, RunConfig
from coop.common.settings.environment import EnvSettings
from coop.common.settings.policies import SAMPLERS

ConfigT = TypeVar("ConfigT", bound=RunConfig)


def check_rules(config: RunConfig) -> None:
    """Raise UsageError for the first rule that the config breaks; names the field, its value and what is allowed."""
    if problem := next(_problems(config), None):
        raise UsageError(problem)


def fitted(config: ConfigT, given: Collection[str], *, lockstep: bool = False) -> ConfigT:
    """The config in which what nobody has asked for gives way to what somebody has.

    Learning starts with a full table at the latest, at once if the table is full from the start on, and a lockstep run
    plays one emulator.

    given: the settings asked for, as dotted names; those of a preset or a file are not among them.
    """
    replay, actor = config.replay, config.actor
    if "replay.learning_starts" not in given:
        latest = 1 if "replay.preload" in given and replay.preload else replay.capacity
        if replay.learning_starts > latest:
            config = replace(config, replay=replace(replay, learning_starts=max(replay.n_step, latest)))
    if lockstep and "actor.num_envs" not in given and actor.num_envs != 1:
        config = replace(config, actor=replace(actor, num_envs=1))
    return config


def _problems(config: RunConfig) -> Iterator[str]:
    replay, learner = config.replay, config.learner
    if config.network.kind not in NETWORK_KINDS and ":" not in config.network.kind:
        kinds = ", ".join(NETWORK_KINDS)
        yield f"network.kind = {config.network.kind!r}: allowed: {kinds}, or module:function"
    for name, most in (("replay.capacity", replay.capacity), ("total_steps", config.total_steps)):
        if replay.learning_starts > most and not replay.offline:
            yield f"replay.learning_starts = {replay.learning_starts}: must not exceed {name} = {most}"
    if replay.learning_starts < replay.n_step:
        yield f"replay.learning_starts = {replay.learning_starts}: allowed: at least replay.n_step = {replay.n_step}"
    if config.actor.segment_steps + replay.n_step - 1 > MAX_SEGMENT_STEPS:
        most = MAX_SEGMENT_STEPS - replay.n_step + 1
        asked = f"actor.segment_steps = {config.actor.segment_steps}"
        yield f"{asked}: allowed: at most {most} with replay.n_step = {replay.n_step}"
    if config.planned_updates < 1:
        least = (0 if replay.offline else replay.learning_starts) + math.ceil(0.5 / replay.ratio)
        yield (
            f"total_steps = {config.total_steps}: plans no update; allowed: at least {least} "
            f"with replay.learning_starts = {replay.learning_starts} and replay.ratio = {replay.ratio:g}"
        )
    if config.env.atari:
        plain = EnvSettings()
        for name in ("kwargs", "resize", "grayscale", "vectorization_mode"):
            if (value := getattr(config.env, name)) != getattr(plain, name):
                yield f"env.{name} = {value!r}: not for {config.env.id!r}; ALE's games show 84x84 grayscale pictures"
    if config.soft_targets is not None and learner.swap_unit == "steps":
        yield f"learner.tau = {learner.tau}: moves targets at each update; not with learner.swap_unit = 'steps'"
    if learner.initial_networks and config.streaming:
        yield f"learner.initial_networks = {learner.initial_networks!r}: not for method {config.method!r}"
    yield from _replay_problems(config)


def _replay_problems(config: RunConfig) -> Iterator[str]:
    replay = config.replay
    if not replay.replacement and not SAMPLERS.get(replay.sampling).without_replacement:
        able = ", ".join(repr(name) for name in SAMPLERS.names() if SAMPLERS.get(name).without_replacement)
        yield f"replay.sampling = {replay.sampling!r}: allowed: {able} with replay.replacement = False"
    if replay.journal_keep and replay.journal == "off":
        yield "replay.journal_keep = True: needs replay.journal = 'async' or 'sync'"
    if replay.offline and not replay.preload:
        yield "replay.offline = True: needs the data set that the run learns from, replay.preload"
    if replay.preload and config.streaming:
        yield f"replay.preload = {replay.preload!r}: not for method {config.method!r}, which has no replay buffer"
