"""Settings that have an effect only together with others; commands warn of flags without effect."""

from __future__ import annotations

from collections.abc import Collection, Iterator

from coop.common.settings.conditions import Condition
from coop.common.settings.config import RunConfig
from coop.common.settings.methods import METHODS, table_of
from coop.common.settings.policies import SAMPLERS

_OPTIMIZER = "learner.optimizer = {c.learner.optimizer!r} has none"
# The warning gives the first condition that does not hold.
_CONDITIONS = (
    Condition(("edl.",), lambda c: c.feedback != "none", "{c.method} takes the ordinary gradient"),
    Condition(
        ("edl.rate", "edl.decay", "edl.decay_every", "edl.noise"),
        lambda c: c.edl.feedback != "random",
        "the matrices of edl.feedback = 'random' have no s",
    ),
    Condition(("edl.decay", "edl.decay_every", "edl.noise"), lambda c: c.edl.rate > 0, "edl.rate = 0"),
    Condition(("edl.decay_every",), lambda c: c.edl.decay < 1, "edl.decay = 1"),
    Condition(("network.hidden",), lambda c: c.network.kind == "mlp", "{c.network.kind} has layers of its own"),
    Condition(
        ("learner.swap_every",),
        lambda c: c.two_networks or c.learner.target_update_every is None,
        "{c.method} copies its network every learner.target_update_every",
    ),
    Condition(
        ("learner.target_update_every",),
        lambda c: not c.two_networks,
        "{c.method} has no target network; its roles swap every learner.swap_every",
    ),
    Condition(("learner.tau",), lambda c: not c.two_networks, "{c.method} has no target network"),
    Condition(
        ("learner.swap_every", "learner.target_update_every", "learner.swap_unit"),
        lambda c: c.soft_targets is None,
        "the target network follows at each update, learner.tau = {c.learner.tau}",
    ),
    Condition(
        ("learner.reset_role_at_episode",), lambda c: c.two_networks, "in {c.method} it is always network 1 that acts"
    ),
    Condition(("learner.alpha",), lambda c: c.learner.optimizer in ("rmsprop", "rmsprop-mnih"), _OPTIMIZER),
    Condition(("learner.gradient_alpha",), lambda c: c.learner.optimizer == "rmsprop-mnih", _OPTIMIZER),
    Condition(("learner.beta1", "learner.beta2"), lambda c: c.learner.optimizer == "adam", _OPTIMIZER),
    Condition(("learner.tf32",), lambda c: c.learner.device != "cpu", "learner.device = 'cpu'"),
    Condition(("learner.eps",), lambda c: c.learner.optimizer != "sgd", _OPTIMIZER),
    Condition(
        ("replay.priority_exponent", "replay.importance_exponent"),
        lambda c: SAMPLERS.get(c.replay.sampling).priorities,
        "replay.sampling = {c.replay.sampling!r}",
    ),
    Condition(("actor.", "replay.learning_starts"), lambda c: not c.replay.offline, "nobody acts, replay.offline"),
    Condition(
        ("actor.epsilon_steps", "actor.epsilon_decay"),
        lambda c: c.actor.epsilon_start != c.actor.epsilon_final,
        "epsilon begins and ends at {c.actor.epsilon_final:g}",
    ),
    Condition(
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
    "actor.max_in_flight",
    "learner.mirror",
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
    others = tuple(f"{table_of(name)}." for name in METHODS.names() if name != config.method)
    own = Condition(others, lambda c: False, "the method is {c.method}")
    conditions = (own, *_CONDITIONS, *METHODS.get(config.method).conditions)
    for name in sorted(given):
        flag = f"--{name.replace('_', '-')}"
        if lockstep and name in _OF_PROCESSES:
            yield f"{flag} has no effect: a lockstep run is one process"
            continue
        for condition in conditions:
            if condition.concerns(name) and not condition.holds(config):
                yield f"{flag} has no effect: {condition.otherwise.format(c=config)}"
                break
