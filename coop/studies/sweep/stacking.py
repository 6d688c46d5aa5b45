"""Which cells of a grid are played side by side in one process: those that differ in nothing but their seeds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from importlib.util import find_spec

from coop.common.settings.config import RunConfig
from coop.common.settings.environment import EnvSettings
from coop.studies.stacked.settings import TWO_NETWORKS
from coop.studies.sweep.folder import CellFolder
from coop.studies.sweep.grid import GridFile


def why_not(config: RunConfig) -> str:
    """Why runs of this config can't be played side by side; empty if they can."""
    if find_spec("numba") is None:
        return "numba is not installed: pip install 'coop-rl[fast]'"
    learner, replay, env = config.learner, config.replay, config.env
    plain = EnvSettings(env.id, max_episode_steps=env.max_episode_steps, time_limit_terminal=env.time_limit_terminal)
    wanted = (
        ("env", env.id in ("CartPole-v0", "CartPole-v1") and env == plain, "CartPole without further settings"),
        ("method", config.method in TWO_NETWORKS, ", ".join(TWO_NETWORKS)),
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
    return next((f"{name}: only {allowed}" for name, fits, allowed in wanted if not fits), "")


Stacks = Mapping[str, tuple[CellFolder, ...]]
"""The cells that share a process, by the name of each."""

MOST = 32  # cells of a process, if nothing else is asked for


def stacks_of(
    grid: GridFile, cells: Sequence[CellFolder], jobs: int, most: int | None
) -> tuple[dict[str, tuple[CellFolder, ...]], list[str]]:
    """The cells that each cell shares a process with, itself among them, by its name; and why others are alone.

    Cells that can't share one, or have none to share it with, are left out.

    most: cells of a process; as many as keep `jobs` processes busy if None, and at most MOST.
    """
    groups: dict[RunConfig, list[CellFolder]] = {}
    for cell in cells:
        groups.setdefault(replace(cell.cell.config, seed=0), []).append(cell)
    reasons: dict[str, int] = {}
    fitting: list[list[CellFolder]] = []
    for config, group in groups.items():
        reason = why_not(config) if grid.mode == "lockstep" else "mode: only lockstep"
        if reason:
            reasons[reason] = reasons.get(reason, 0) + len(group)
        else:
            fitting.append(group)
    found: dict[str, tuple[CellFolder, ...]] = {}
    for group in fitting:
        parts = max(1, -(-jobs // len(fitting)))
        size = most or min(MOST, -(-len(group) // parts))
        for start in range(0, len(group), size):
            part = tuple(group[start : start + size])
            found |= dict.fromkeys((cell.cell.name for cell in part), part) if len(part) > 1 else {}
    return found, [f"{count} cells run by themselves: {reason}" for reason, count in reasons.items()]
