"""Messages that ask for the limiter's settings and change them while a run goes on.

limits            a question, and its answer
limit             new settings; answered like the question
"""

from __future__ import annotations

from dataclasses import asdict, dataclass

from common.bounds import MAX_RATIO, MAX_TOLERANCE
from common.errors import BadMessage
from common.messaging import wire
from common.messaging.schema import Int, Real, Schema, Text
from common.messaging.wire import Message


@dataclass(frozen=True, slots=True)
class Limits:
    """The limiter of a running replay service.

    ratio: updates per environment step. tolerance: steps that acting and learning may drift apart.
    inserted: transitions so far. drawn: batches so far, of `planned` for the complete run.
    inserts_wait_for, samples_wait_for: why they wait, in words; empty where they do not.
    """

    ratio: float
    tolerance: float
    inserted: int
    drawn: int
    planned: int
    inserts_wait_for: str
    samples_wait_for: str


_LIMITS = Schema(
    "limits",
    {
        "ratio": Real(),
        "tolerance": Real(),
        "inserted": Int(),
        "drawn": Int(),
        "planned": Int(),
        "inserts_wait_for": Text(),
        "samples_wait_for": Text(),
    },
    {},
)
_LIMIT = Schema("limit", {"ratio": Real(), "tolerance": Real()}, {})


def encode_limits(run: str, limits: Limits) -> bytearray:
    """Build the answer to both."""
    return wire.encode("limits", run, asdict(limits))


def decode_limits(message: Message) -> Limits:
    """Read the answer; raises BadMessage."""
    _LIMITS.check(message)
    return Limits(**message.fields)


def encode_limit(run: str, ratio: float, tolerance: float) -> bytearray:
    """Build new settings."""
    return wire.encode("limit", run, {"ratio": ratio, "tolerance": tolerance})


def decode_limit(message: Message) -> tuple[float, float]:
    """Read (ratio, tolerance); raises BadMessage."""
    _LIMIT.check(message)
    ratio, tolerance = float(message.fields["ratio"]), float(message.fields["tolerance"])
    if not 0 < ratio <= MAX_RATIO:
        raise BadMessage("fields.ratio", f"{ratio:g}; above 0, at most 1,000,000")
    if not 0 <= tolerance <= MAX_TOLERANCE:
        raise BadMessage("fields.tolerance", f"{tolerance:g}; at least 0")
    return ratio, tolerance
