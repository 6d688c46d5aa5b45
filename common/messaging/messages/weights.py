"""The learner's broadcasts of the networks' parameters and of the acting role."""

from __future__ import annotations

from functools import cache
from typing import Annotated, ClassVar, Self

from msgspec import Meta, Struct

from coop.common.bounded import Counter, Updates
from coop.common.messaging import wire
from coop.common.messaging.messages.body import Body, Layout, check_kind, to_struct
from coop.common.messaging.wire import Message
from coop.common.types import Array

Network = Annotated[int, Meta(ge=1, le=2)]


class Current(Body, frozen=True):
    """Asks for a key's latest broadcast."""

    kind: ClassVar[str] = "current"


class Weights(Struct, frozen=True):
    """One network's parameters, `flat`: float32 [P]."""

    network: Network
    version: Updates
    flat: Array

    def encode(self, run: str) -> bytearray:
        """Build the message."""
        return wire.encode("weights", run, {"network": self.network, "version": self.version}, {"flat": self.flat})

    @classmethod
    def decode(cls, message: Message, parameters: int) -> Self:
        """Read a network of `parameters` parameters; raises BadMessage."""
        layout = _layout(parameters)
        check_kind(message, "weights")
        layout.lengths(message.table)
        return to_struct(message, cls, layout)


@cache
def _layout(parameters: int) -> Layout:
    return Layout({"flat": ("float32", (parameters,))})


class Role(Body, frozen=True):
    """The acting network (1 or 2) and the newest version of each network.

    updates, env_step: updates and environment steps that the run had done when these networks were broadcast.
    """

    kind: ClassVar[str] = "role"

    acting: Network
    versions: tuple[Updates, Updates]
    updates: Updates
    env_step: Counter = 0
