"""The limiter's settings, asked for and changed while a run goes on."""

from __future__ import annotations

from typing import Annotated, ClassVar

from msgspec import Meta

from common.bounded import Counter, Real, Text
from common.bounds import MAX_RATIO, MAX_TOLERANCE
from common.messaging.messages.body import Body


class LimitsQuestion(Body, frozen=True):
    """Asks for the settings."""

    kind: ClassVar[str] = "limits"


class Limit(Body, frozen=True):
    """New settings; answered like the question.

    ratio: updates per environment step. tolerance: steps that acting and learning may drift apart.
    """

    kind: ClassVar[str] = "limit"

    ratio: Annotated[float, Meta(gt=0, le=MAX_RATIO)]
    tolerance: Annotated[float, Meta(ge=0, le=MAX_TOLERANCE)]


class Limits(Body, frozen=True):
    """The limiter of a running replay service.

    ratio, tolerance: see `Limit`. inserted: transitions so far.
    drawn: batches so far, of `planned` for the complete run.
    inserts_wait_for, samples_wait_for: why they wait, in words; empty where they do not.
    """

    kind: ClassVar[str] = "limits"

    ratio: Real
    tolerance: Real
    inserted: Counter
    drawn: Counter
    planned: Counter
    inserts_wait_for: Text
    samples_wait_for: Text
