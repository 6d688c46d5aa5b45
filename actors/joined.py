"""What a process makes of the learner's answer to its request to join: the networks that it follows."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np

from coop.actors.policy import EpsilonGreedy
from coop.common.errors import JoinError
from coop.common.imports import check_allowed
from coop.common.messaging.messages.join import JoinReply
from coop.common.networks.acting import acting_network


def make_policy(reply: JoinReply, allow_import: Collection[str], rng: np.random.Generator) -> EpsilonGreedy:
    """A policy with networks of the run's layout, whose parameters the learner will send.

    Raises:
        JoinError: the run needs a module that this process may not import, or this process builds another layout than
            the learner does.
    """
    for field, path in reply.config.imports.items():
        check_allowed(path, allow_import, field)
    first, second = (acting_network(reply.config.network, reply.spec) for _ in range(2))
    if first.layout_digest() != reply.layout:
        raise JoinError(f"network layout here {first.layout_digest()}, the learner's {reply.layout}")
    return EpsilonGreedy((first, second), reply.spec, rng)
