"""The replay service's part of an epoch: have it begun, and ask whether it is on disk."""

from __future__ import annotations

from typing import ClassVar

from common.bounded import Updates
from common.messaging.messages.body import Body
from common.messaging.messages.join import Epochs


class Snapshot(Body, frozen=True):
    """Begin the part of epoch `number`; of older ones keep `keep` alone."""

    kind: ClassVar[str] = "snapshot"

    number: Updates
    keep: Epochs


class Written(Body, frozen=True):
    """Is the part of epoch `number` on disk?"""

    kind: ClassVar[str] = "written"

    number: Updates
