"""Settings that have an effect only if a condition holds."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Condition:
    """Settings that have an effect only if a condition holds.

    names: dotted; "edl." stands for the whole section.
    holds: of the run's config.
    otherwise: why the settings have no effect if it does not hold, a format string over the config c.
    """

    names: tuple[str, ...]
    holds: Callable[[Any], bool]
    otherwise: str

    def concerns(self, name: str) -> bool:
        """Whether the setting is one of these."""
        return name in self.names or f"{name.partition('.')[0]}." in self.names
