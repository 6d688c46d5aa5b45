"""Which runs compiled loops can play; numba is not needed to tell."""

from __future__ import annotations

from importlib.util import find_spec

from coop.common.errors import UsageError
from coop.common.settings.config import RunConfig
from coop.common.settings.environment import EnvSettings

CARTPOLE, MINATAR = "gymnasium.envs.classic_control.cartpole:CartPoleEnv", "minatar.gym:BaseEnv"
METHODS = ("dqn", "edql", "g-coop", "coop")


def why_not(config: RunConfig) -> str:
    """Why compiled loops can't play runs of this config; empty if they can."""
    if find_spec("numba") is None:
        return "numba is not installed: pip install 'coop-rl[fast]'"
    learner, replay, env, network = config.learner, config.replay, config.env, config.network
    plain = EnvSettings(env.id, max_episode_steps=env.max_episode_steps, time_limit_terminal=env.time_limit_terminal)
    pictures = env.id.startswith("MinAtar/")
    played = env.stack == 1 if pictures else env.id in ("CartPole-v0", "CartPole-v1") and env == plain
    kinds = (network.kind == "minatar", "minatar") if pictures else (
        network.kind == "mlp" and bool(network.hidden), "mlp with hidden layers"
    )  # fmt: skip
    # What weight-gradient draws is not known ahead, as that of s is.
    weights = ("weight-gradient",) if pictures and config.edl.noise == "constant" else ()
    feedbacks = ("transform", "weight-gradient with a constant s") if pictures else ("transform",)
    wanted = (
        ("env", played, "CartPole without further settings, and MinAtar without stacks"),
        ("method", config.method in METHODS, ", ".join(METHODS)),
        ("edl.feedback", config.feedback in ("none", "transform", *weights), ", ".join(feedbacks)),
        ("network.kind", *kinds),
        ("network.dtype", network.dtype == "float32", "float32"),
        ("replay.sampling", replay.sampling == "uniform" and replay.replacement, "uniform, with replacement"),
        ("replay.eviction", replay.eviction in ("fifo", "reservoir"), "fifo, reservoir"),
        ("replay.n_step", replay.n_step == 1 or pictures, "1 on CartPole"),
        ("replay.preload", not replay.preload, "none"),
        ("learner.device", learner.device == "cpu", "cpu"),
        ("learner.tau", learner.tau is None, "none"),
        ("learner.swap_unit", learner.swap_unit == "updates" and not learner.reset_role_at_episode, "updates"),
        ("learner.weight_decay", not any(learner.weight_decay), "0"),
        ("actor.num_envs", config.actor.num_envs == 1, "1"),
        ("eval_every", not config.eval_every, "0"), ("video_every", not config.video_every, "0"),
    )  # fmt: skip
    if refused := next((f"{name}: only {allowed}" for name, fits, allowed in wanted if not fits), ""):
        return refused
    from coop.common.envs.registry import find_registered  # noqa: PLC0415 (takes a while, and most have their answer)

    try:
        spec = find_registered(env)
    except UsageError as error:
        return str(error)
    own = spec.entry_point != MINATAR if pictures else spec.entry_point != CARTPOLE or spec.kwargs
    return f"env: {env.id} is registered as something else" if own or spec.additional_wrappers else ""
