"""An evaluator's results, which the learner keeps in the run directory; each is answered with a receipt."""

from __future__ import annotations

from typing import Annotated, ClassVar, Self

from msgspec import Meta, Struct

from coop.common.bounded import Count, Counter, Incarnation, Share, Updates
from coop.common.bounds import MAX_EVALUATED, MAX_RETURN, MAX_VIDEO
from coop.common.errors import BadMessage
from coop.common.messaging import wire
from coop.common.messaging.messages.body import Body, Layout, check_kind, to_struct
from coop.common.messaging.messages.weights import Network
from coop.common.messaging.wire import Message
from coop.common.types import Array

GIF = b"GIF8"  # the first bytes of every one
_GIF = Layout({"gif": ("uint8", ("bytes",))})


class EvaluationRow(Struct, frozen=True, forbid_unknown_fields=True):
    """Unclipped returns of full episodes that a network played; the columns of evaluations.csv.

    env_step, update: of the run when the network was broadcast. epsilon: probability of a random action; 0 is greedy
    play. seconds: that the episodes took.
    """

    env_step: Counter
    update: Updates
    network: Network
    episodes: Annotated[int, Meta(ge=1, le=MAX_EVALUATED)]
    return_mean: Annotated[float, Meta(ge=-MAX_RETURN, le=MAX_RETURN)]
    return_sd: Annotated[float, Meta(ge=0, le=MAX_RETURN)]
    epsilon: Share
    seconds: Annotated[float, Meta(ge=0, le=1e9)]


class Evaluated(Body, frozen=True):
    """A result; number: counts this evaluator's results from 0, so that a repetition is known as one."""

    kind: ClassVar[str] = "evaluated"

    incarnation: Incarnation
    number: Count
    result: EvaluationRow


class Video(Struct, frozen=True):
    """An episode that a network played greedily, as an animated GIF, uint8 [bytes]; the others as in `Evaluated`."""

    kind: ClassVar[str] = "video"

    incarnation: Incarnation
    number: Count
    env_step: Counter
    gif: Array

    def encode(self, run: str) -> bytearray:
        """Build the message."""
        fields = {"incarnation": self.incarnation, "number": self.number, "env_step": self.env_step}
        return wire.encode(self.kind, run, fields, {"gif": self.gif})

    @classmethod
    def decode(cls, message: Message) -> Self:
        """Read it; raises BadMessage."""
        check_kind(message, cls.kind)
        if _GIF.lengths(message.table)["bytes"] > MAX_VIDEO:
            raise BadMessage("arrays.gif", f"more than {MAX_VIDEO:,} bytes")
        if message.arrays["gif"][:4].tobytes() != GIF:
            raise BadMessage("arrays.gif", "not a GIF")
        return to_struct(message, cls, _GIF)
