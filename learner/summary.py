"""How a run ends, as its trainer knows."""

from __future__ import annotations

from coop.learner.trainer import Trainer
from coop.records.summaries import Summary


def summarise(
    trainer: Trainer, outcome: str, now: float, env_steps: int, lost: int | None = 0, duplicates: int | None = 0
) -> Summary:
    """Summarise a run that ends at `now`, in seconds of the trainer's clock."""
    config, telemetry = trainer.config, trainer.telemetry
    env_steps = 0 if config.replay.offline else env_steps
    return Summary(
        method=config.method,
        env=config.env.id,
        seed=config.seed,
        env_steps=env_steps,
        updates=trainer.agent.updates,
        episodes=telemetry.episodes,
        return_mean_100=telemetry.return_mean,
        return_sd_100=telemetry.return_sd,
        wall_seconds=round(trainer.seconds(now), 3),
        transitions_accepted=env_steps,
        transitions_lost=lost,
        duplicates_refused=duplicates,
        exit=outcome,
    )
