"""Which runs compiled loops can play; numba is not needed to tell."""

from __future__ import annotations

from importlib.util import find_spec

from coop.common.settings.config import RunConfig
from coop.common.settings.environment import EnvSettings

CARTPOLE = "gymnasium.envs.classic_control.cartpole:CartPoleEnv"
METHODS = ("dqn", "edql", "g-coop", "coop")


def why_not(config: RunConfig) -> str:
    """Why compiled loops can't play runs of this config; empty if they can."""
    if find_spec("numba") is None:
        return "numba is not installed: pip install 'coop-rl[fast]'"
    learner, replay, env = config.learner, config.replay, config.env
    plain = EnvSettings(env.id, max_episode_steps=env.max_episode_steps, time_limit_terminal=env.time_limit_terminal)
    wanted = (
        ("env", env.id in ("CartPole-v0", "CartPole-v1") and env == plain, "CartPole without further settings"),
        ("method", config.method in METHODS, ", ".join(METHODS)),
        ("edl.feedback", config.feedback in ("none", "transform"), "transform"),
        ("network.kind", config.network.kind == "mlp" and bool(config.network.hidden), "mlp with hidden layers"),
        ("network.dtype", config.network.dtype == "float32", "float32"),
        ("replay.sampling", replay.sampling == "uniform" and replay.replacement, "uniform, with replacement"),
        ("replay.eviction", replay.eviction in ("fifo", "reservoir"), "fifo, reservoir"),
        ("replay.ratio", replay.ratio <= 1, "at most 1"), ("replay.n_step", replay.n_step == 1, "1"),
        ("replay.preload", not replay.preload, "none"),
        ("learner.device", learner.device == "cpu", "cpu"),
        ("learner.tau", learner.tau is None, "none"),
        ("learner.swap_unit", learner.swap_unit == "updates" and not learner.reset_role_at_episode, "updates"),
        ("learner.weight_decay", not any(learner.weight_decay), "0"),
        ("actor.num_envs", config.actor.num_envs == 1, "1"),
        ("eval_every", not config.eval_every, "0"), ("video_every", not config.video_every, "0"),
        ("total_updates", not config.total_updates, "0"), ("total_episodes", not config.total_episodes, "0"),
        ("target_return", config.target_return is None, "none"),
    )  # fmt: skip
    if refused := next((f"{name}: only {allowed}" for name, fits, allowed in wanted if not fits), ""):
        return refused
    import gymnasium  # noqa: PLC0415 (takes a while, and most who ask have their answer)

    spec = gymnasium.spec(env.id)
    own = spec.entry_point != CARTPOLE or spec.kwargs or spec.additional_wrappers
    return f"env: {env.id} is registered as something else" if own else ""
