"""What the learner's mirror of the table's frames holds, according to the answers that it was sent. Without I/O.

It decides which frames an answer carries. It need not be right: the learner finds out what it lacks, see
`coop.common.messaging.mirror`, and asks for the same draw again.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from coop.common.transitions import DrawRequest
from coop.replay.table.frames import Slots


class MirroredFrames:
    """The frames in the mirror of the present learner, if every answer has arrived."""

    def __init__(self) -> None:
        self._numbers = np.zeros(0, np.int64)  # of the frame last sent in each slot; 0: none
        self._mirror = 0
        self._newest = -1

    def clear(self) -> None:
        """Forget it: another learner draws."""
        self._numbers = np.zeros(0, np.int64)
        self._mirror, self._newest = 0, -1

    def missing(self, request: DrawRequest, sequence: int, slots: Slots, numbers: NDArray[np.int64]) -> Slots:
        """Which frames the answer to draw number `sequence` must carry, and note that it does.

        All of them if that draw has been answered before: the answer may have been lost, or of no use.

        Args:
            slots, numbers: of the draw's frames, int [n].

        Returns:
            Indices of those to carry, ascending, intp [m].
        """
        if request.mirror > self._mirror:  # the learner has emptied it
            self.clear()
            self._mirror = request.mirror
        within = slots < request.mirror_slots
        inside = slots[within]
        if len(inside) and (highest := inside.item(inside.argmax())) >= len(self._numbers):
            larger = np.zeros(min(request.mirror_slots, 2 * highest + 1), np.int64)
            larger[: len(self._numbers)] = self._numbers
            self._numbers = larger
        lacks = np.ones(len(slots), np.bool_)
        if sequence > self._newest:
            lacks[within] = self._numbers[inside] != numbers[within]
            self._newest = sequence
        self._numbers[inside] = numbers[within]
        return lacks.nonzero()[0]
