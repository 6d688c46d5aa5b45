"""What may end a run before its last environment step."""

from __future__ import annotations

from common.settings.config import RunConfig
from learner.records.telemetry import Telemetry


def target_reached(config: RunConfig, updates: int, telemetry: Telemetry) -> str:
    """Which of total_updates, total_episodes and target_return is reached, in words; empty while none is."""
    if 0 < config.total_updates <= updates:
        return "complete: total_updates reached"
    if 0 < config.total_episodes <= telemetry.episodes:
        return "complete: total_episodes reached"
    target, full = config.target_return, len(telemetry.returns) == telemetry.returns.maxlen
    if target is not None and full and telemetry.return_mean >= target:
        return "complete: target_return reached"
    return ""
