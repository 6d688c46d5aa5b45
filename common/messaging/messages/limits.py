"""Reads and changes the limiter's settings while a run goes on."""

from __future__ import annotations

from typing import Annotated, ClassVar

from msgspec import Meta

from coop.common.bounded import Counter, Real, Text
from coop.common.bounds import MAX_RATIO, MAX_TOLERANCE
from coop.common.messaging.messages.body import Body


class LimitsQuestion(Body, frozen=True):
    """Asks for the settings."""

    kind: ClassVar[str] = "limits"


class Limit(Body, frozen=True):
    """New settings; answered like the question.

    ratio: updates per environment step. tolerance: environment steps by which acting and learning may differ.
    """

    kind: ClassVar[str] = "limit"

    ratio: Annotated[float, Meta(gt=0, le=MAX_RATIO)]
    tolerance: Annotated[float, Meta(ge=0, le=MAX_TOLERANCE)]


class Limits(Body, frozen=True):
    """The state of a running replay service's limiter.

    ratio, tolerance: see `Limit`. inserted: transitions so far.
    drawn: batches so far, out of `planned` in the complete run.
    inserts_wait_for, samples_wait_for: why they wait, in words; empty if they do not.
    """

    kind: ClassVar[str] = "limits"

    ratio: Real
    tolerance: Real
    inserted: Counter
    drawn: Counter
    planned: Counter
    inserts_wait_for: Text
    samples_wait_for: Text
