"""The summary at a run's end: summary.json, and one line."""

from __future__ import annotations

from dataclasses import dataclass

from coop.common.process.console import averaged_over
from coop.learner.trainer import Trainer


@dataclass(frozen=True, slots=True)
class Summary:
    """The fields of summary.json.

    return_mean_100, return_sd_100: over the last 100 episodes; 0 if none has ended. transitions_lost,
    duplicates_refused: None if the replay service did not answer. exit: why the run ended.
    """

    method: str
    env: str
    seed: int
    env_steps: int
    updates: int
    episodes: int
    return_mean_100: float
    return_sd_100: float
    wall_seconds: float
    transitions_accepted: int
    transitions_lost: int | None
    duplicates_refused: int | None
    exit: str

    @property
    def title(self) -> str:
        """A short title of the run."""
        return f"{self.env}, {self.method}, seed {self.seed}"

    def __str__(self) -> str:
        returns = f"return of {averaged_over(self.episodes)} {self.return_mean_100:.1f} ({self.return_sd_100:.1f})"
        return (
            f"{self.exit}: {self.env_steps:,} steps, {self.updates:,} updates, "
            f"{returns if self.episodes else 'no episode ended'}, {self.wall_seconds:.0f} s"
        )


def summarise(
    trainer: Trainer, outcome: str, now: float, env_steps: int, lost: int | None = 0, duplicates: int | None = 0
) -> Summary:
    """Summarise a run that ends at `now`, in seconds of the trainer's clock."""
    config, telemetry = trainer.config, trainer.telemetry
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
