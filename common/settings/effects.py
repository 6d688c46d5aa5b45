"""Settings that have an effect only together with others; commands warn of flags without effect."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass

from common.settings.config import RunConfig


@dataclass(frozen=True)
class _Condition:
    """Settings that have an effect only if a condition holds.

    names: dotted; "edl." stands for the whole section.
    otherwise: why the settings have no effect if it does not hold, a format string over the config c.
    """

    names: tuple[str, ...]
    holds: Callable[[RunConfig], bool]
    otherwise: str

    def concerns(self, name: str) -> bool:
        """Whether the setting is one of these."""
        return name in self.names or f"{name.partition('.')[0]}." in self.names


_OPTIMIZER = "learner.optimizer = {c.learner.optimizer!r} has none"
# The warning gives the first condition that does not hold.
_CONDITIONS = (
    _Condition(("edl.",), lambda c: c.feedback != "none", "{c.method} takes the ordinary gradient"),
    _Condition(
        ("edl.rate", "edl.decay", "edl.decay_every", "edl.noise"),
        lambda c: c.edl.feedback != "random",
        "the matrices of edl.feedback = 'random' have no s",
    ),
    _Condition(
        ("edl.decay", "edl.decay_every", "edl.noise", "edl.polar_dtype"), lambda c: c.edl.rate > 0, "edl.rate = 0"
    ),
    _Condition(("edl.decay_every",), lambda c: c.edl.decay < 1, "edl.decay = 1"),
    _Condition(
        ("edl.polar_dtype",),
        lambda c: c.edl.feedback == "transform",
        "edl.feedback = {c.edl.feedback!r} has no such part",
    ),
    _Condition(("network.hidden",), lambda c: c.network.kind == "mlp", "{c.network.kind} has layers of its own"),
    _Condition(
        ("learner.swap_every",),
        lambda c: c.two_networks or c.learner.target_update_every is None,
        "{c.method} copies its network every learner.target_update_every",
    ),
    _Condition(
        ("learner.target_update_every",),
        lambda c: not c.two_networks,
        "{c.method} has no target network; its roles swap every learner.swap_every",
    ),
    _Condition(
        ("learner.reset_role_at_episode",), lambda c: c.two_networks, "in {c.method} it is always network 1 that acts"
    ),
    _Condition(("learner.alpha",), lambda c: c.learner.optimizer in ("rmsprop", "rmsprop-mnih"), _OPTIMIZER),
    _Condition(("learner.gradient_alpha",), lambda c: c.learner.optimizer == "rmsprop-mnih", _OPTIMIZER),
    _Condition(("learner.beta1", "learner.beta2"), lambda c: c.learner.optimizer == "adam", _OPTIMIZER),
    _Condition(("learner.eps",), lambda c: c.learner.optimizer != "sgd", _OPTIMIZER),
    _Condition(
        ("replay.priority_exponent", "replay.importance_exponent"),
        lambda c: c.replay.sampling == "prioritized",
        "replay.sampling = {c.replay.sampling!r}",
    ),
    _Condition(
        ("actor.epsilon_steps", "actor.epsilon_decay"),
        lambda c: c.actor.epsilon_start != c.actor.epsilon_final,
        "epsilon begins and ends at {c.actor.epsilon_final:g}",
    ),
    _Condition(
        (
            "env.noop_max",
            "env.episodic_life",
            "env.frame_skip",
            "env.repeat_action_probability",
            "env.full_action_space",
        ),
        lambda c: c.env.atari,
        "{c.env.id} is no ALE game",
    ),
)
_OF_PROCESSES = (
    "actor.segment_steps",
    "actor.window",
    "learner.prefetch",
    "learner.publish_every",
    "replay.journal",
    "replay.journal_keep",
    "replay.tolerance",
    "shared_memory",
    "zenoh_config",
)


def without_effect(config: RunConfig, given: Collection[str], *, lockstep: bool) -> Iterator[str]:
    """Yield a line for each setting in `given` (dotted names) that has no effect in a run of `config`."""
    for name in sorted(given):
        flag = f"--{name.replace('_', '-')}"
        if lockstep and name in _OF_PROCESSES:
            yield f"{flag} has no effect: a lockstep run is one process"
            continue
        for condition in _CONDITIONS:
            if condition.concerns(name) and not condition.holds(config):
                yield f"{flag} has no effect: {condition.otherwise.format(c=config)}"
                break
