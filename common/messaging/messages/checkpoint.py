"""The replay service's part of a checkpoint: begin it, and ask whether it is on disk."""

from __future__ import annotations

from typing import ClassVar

from coop.common.bounded import Updates
from coop.common.messaging.messages.body import Body
from coop.common.messaging.messages.join import Checkpoints


class Snapshot(Body, frozen=True):
    """Begins the part of checkpoint `number`; of the older checkpoints, only `keep` is kept."""

    kind: ClassVar[str] = "snapshot"

    number: Updates
    keep: Checkpoints


class Written(Body, frozen=True):
    """Asks whether the part of checkpoint `number` is on disk."""

    kind: ClassVar[str] = "written"

    number: Updates
