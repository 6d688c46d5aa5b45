"""The training methods: what tells them apart. What only a learner needs is imported there, when it trains."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from coop.common.registry import Registry
from coop.common.settings.conditions import Condition


@dataclass(frozen=True)
class Method:
    """One training method.

    Attributes:
        name: as `--method` has it.
        summary: what it is, in a few words.
        two_networks: two independent networks, each of which gives the other's targets; their roles swap every C
            updates. If False, the second network is a copy of the first, made every C updates, and gives the targets.
        error_driven: error-driven learning feeds the error back; if False, the ordinary gradient does.
        rule: of the targets and the extra cost: a `coop.learner.methods.rule.UpdateRule`, or
            "module:Class" to import it in the learner only.
        network: makes the Q-network, with the arguments and result of `coop.common.networks.network.build_network`;
            "module:function" to import it where networks are made.
        stream: for a method without a replay buffer, its agent, a class like
            `coop.learner.methods.stream_q:StreamAgent`, or "module:Class"; such a method runs in lockstep only. None:
            updates with batches from a replay table.
        settings: a frozen dataclass of the method's own settings, which a config holds in the table `Method.table`.
        conditions: on which these settings have an effect.
        colour: in figures; None: the next one that is free.
    """

    name: str
    summary: str
    two_networks: bool = False
    error_driven: bool = False
    rule: str | Callable[..., Any] = "coop.learner.methods.rule:UpdateRule"
    network: str | Callable[..., Any] = "coop.common.networks.network:build_network"
    stream: str | Callable[..., Any] | None = None
    settings: type[Any] | None = None
    conditions: tuple[Condition, ...] = ()
    colour: str | None = None

    @property
    def table(self) -> str:
        """The name of its settings in TOML and in flags."""
        return table_of(self.name)


def table_of(method: str) -> str:
    """The name of a method's own settings in TOML and in flags."""
    return METHODS.get(method).table if ":" in method else method.replace("-", "_")


# The first four in the order of the paper's table, in the palette of Okabe and Ito, which colour-blind readers can
# distinguish.
METHODS = Registry(
    "method",
    "coop.methods",
    Method,
    {
        "dqn": Method("dqn", "one network and its copy, gradient", colour="#E69F00"),
        "edql": Method("edql", "one network and its copy, error-driven", error_driven=True, colour="#009E73"),
        "g-coop": Method("g-coop", "two networks, gradient", two_networks=True, colour="#56B4E9"),
        "coop": Method("coop", "two networks, error-driven", True, True, colour="#D55E00"),
        "medqn": "coop.common.settings.medqn:MEDQN",
        "stream-q": "coop.common.settings.stream_q:STREAM_Q",
    },
    entry_of=lambda path, rule: Method(path.partition(":")[2], f"one network and its copy, {path}", rule=rule),
    meant={
        **dict.fromkeys(("double-dqn", "ddqn"), "dqn with learner.double = true (--learner.double)"),
        **dict.fromkeys(("per", "prioritized-dqn"), "dqn with replay.sampling = 'prioritized'"),
    },
)


def register_method(method: Method) -> None:
    """Add a training method in this process; raises UsageError for a name in use.

    The processes of distributed runs and of sweeps know only the methods of installed packages, which add them by an
    entry point of the group `coop.methods`, and those that the setting itself names as "module:name".
    """
    METHODS.register(method)
