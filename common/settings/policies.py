"""The policies of a replay table by name; their code is imported by the table that uses them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from coop.common.registry import Registry


@dataclass(frozen=True)
class Policy:
    """A policy of a replay table.

    Attributes:
        name: as the setting has it.
        make: its class, a function of a `coop.replay.table.policies.TableView`, or "module:Class" to import it in the
            replay service only.
        priorities: it uses the priorities of transitions, which the learner then sends.
        episodes: it uses the numbers of transitions' episodes, which the table then keeps.
    """

    name: str
    make: str | Callable[..., Any]
    priorities: bool = False
    episodes: bool = False


def _uses(policy: type) -> dict[str, bool]:
    """What a class on `coop.replay.table.policies.Eviction` or `Sampling` says that it uses."""
    return {name: getattr(policy, name, False) for name in ("priorities", "episodes")}


@dataclass(frozen=True)
class EvictionPolicy(Policy):
    """Chooses the transitions that a full table evicts.

    Attributes:
        in_order: transition i is always stored in row i modulo the capacity.
    """

    in_order: bool = False


@dataclass(frozen=True)
class SamplingPolicy(Policy):
    """Draws batches.

    Attributes:
        without_replacement: it can draw a batch that holds no transition twice.
    """

    without_replacement: bool = False


EVICTIONS = Registry(
    "replay.eviction",
    "coop.evictions",
    EvictionPolicy,
    {
        "fifo": EvictionPolicy("fifo", "coop.replay.table.selection:Fifo", in_order=True),
        "reservoir": EvictionPolicy("reservoir", "coop.replay.table.selection:Reservoir"),
        "prioritized": EvictionPolicy("prioritized", "coop.replay.table.selection:LowestPriority", priorities=True),
    },
    entry_of=lambda path, policy: EvictionPolicy(path, policy, **_uses(policy)),
)
SAMPLERS = Registry(
    "replay.sampling",
    "coop.samplers",
    SamplingPolicy,
    {
        "uniform": SamplingPolicy("uniform", "coop.replay.table.selection:Uniform", without_replacement=True),
        "prioritized": SamplingPolicy("prioritized", "coop.replay.table.selection:Proportional", priorities=True),
    },
    entry_of=lambda path, policy: SamplingPolicy(path, policy, **_uses(policy)),
)
