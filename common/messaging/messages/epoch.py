"""The replay service's part of an epoch: begin it, and ask whether it is on disk."""

from __future__ import annotations

from typing import ClassVar

from coop.common.bounded import Updates
from coop.common.messaging.messages.body import Body
from coop.common.messaging.messages.join import Epochs


class Snapshot(Body, frozen=True):
    """Begins the part of epoch `number`; of the older epochs, only `keep` is kept."""

    kind: ClassVar[str] = "snapshot"

    number: Updates
    keep: Epochs


class Written(Body, frozen=True):
    """Asks whether the part of epoch `number` is on disk."""

    kind: ClassVar[str] = "written"

    number: Updates
