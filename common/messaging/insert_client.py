"""The client that inserts: segments in a bounded window, each sent until it is acknowledged.

It has no thread of its own: Zenoh works in the background, and the caller processes the answers.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

import msgspec

from coop.common.errors import BadMessage
from coop.common.messaging.conversation import BAD_ANSWER, NO_ANSWER, Answer, Asker, Conversation, drive, pauses
from coop.common.messaging.keys import replay_key
from coop.common.messaging.messages.answers import Ack, Retry
from coop.common.messaging.messages.insert import encode_segment
from coop.common.messaging.timing import INSERT_TIMEOUT
from coop.common.messaging.transport import NoAnswer
from coop.common.messaging.wire import Message
from coop.common.process.lifecycle import Stop
from coop.common.transitions import Segment


@dataclass(slots=True)
class _Sent:
    payload: bytearray
    steps: int
    answer: Answer


class InsertClient:
    """Sends each segment until it is acknowledged, with at most `window` segments in flight.

    The first one goes alone; each acknowledgement says how many the replay service permits from then on.

    Args:
        on_wait: called repeatedly while inserts wait.

    Attributes:
        acked: transitions acknowledged.
        inserted: the table's count of accepted transitions, as of the last acknowledgement.
        waiting: why inserts wait, in words; empty while they do not.
    """

    def __init__(self, node: Asker, stop: Stop, window: int, on_wait: Callable[[], None] = lambda: None) -> None:
        self.acked = 0
        self.inserted = 0
        self.waiting = ""
        self._node = node
        self._stop = stop
        self._window = window
        self._permitted = 1
        self._on_wait = on_wait
        self._key = replay_key(node, "insert")
        self._outstanding: deque[_Sent] = deque()
        self._spare: list[bytearray] = []  # memory of acknowledged segments, for the next ones: sending copies
        self._pauses = pauses()

    def submit(self, segment: Segment) -> bool:
        """Send a segment once there is room in the window; return False if a stop was requested first.

        Raises:
            Refused: the replay service rejected a segment as invalid.
        """
        return drive(self.submitting(segment), self._stop, self._on_wait)

    def drain(self) -> bool:
        """Wait until all segments are acknowledged; return False if a stop was requested first."""
        return drive(self._until(lambda: 1), self._stop, self._on_wait)

    def submitting(self, segment: Segment) -> Conversation[bool]:
        """See `submit`."""
        self._collect_acks()
        if not (yield from self._until(lambda: self._permitted)):
            return False
        memory = self._spare.pop() if self._spare else None
        payload = encode_segment(self._node.run, msgspec.structs.replace(segment, acked=self.acked), memory)
        self._outstanding.append(_Sent(payload, segment.steps, self._send(payload)))
        return True

    def _until(self, fewer_than: Callable[[], int]) -> Conversation[bool]:
        """Wait until fewer segments are in flight; return False if a stop was requested first."""
        while len(self._outstanding) >= fewer_than():
            if not (yield from self._acknowledged(self._outstanding[0])):
                return False
            self._end_first()
        return True

    def _collect_acks(self) -> None:
        """Process the acknowledgements that have arrived, without waiting."""
        while self._outstanding:
            sent = self._outstanding[0]
            try:
                message = sent.answer.ready()
                if message is None:
                    return
                accepted = self._accept(message, sent)
            except (NoAnswer, BadMessage):
                return  # it is sent again when the window is full
            if not accepted:
                sent.answer = self._send(sent.payload)
                return
            self._end_first()

    def _end_first(self) -> None:
        self._spare.append(self._outstanding.popleft().payload)

    def _acknowledged(self, sent: _Sent) -> Conversation[bool]:
        """Wait for one acknowledgement, sending again as often as necessary; return False if a stop was requested."""
        while True:
            try:
                while (message := sent.answer.ready()) is None:
                    if (yield sent.answer):
                        return False
                if self._accept(message, sent):
                    return True
            except NoAnswer:
                self.waiting = NO_ANSWER
            except BadMessage as error:
                self.waiting = f"{BAD_ANSWER}: {error}"
            self._on_wait()
            if (yield next(self._pauses)):
                return False
            sent.answer = self._send(sent.payload)

    def _send(self, payload: bytearray) -> Answer:
        return self._node.begin(self._key, payload, INSERT_TIMEOUT)

    def _accept(self, message: Message, sent: _Sent) -> bool:
        if message.kind == Retry.kind:
            self.waiting = Retry.decode(message).reason
            return False
        ack = Ack.decode(message)
        self.inserted = max(self.inserted, ack.inserted)
        self._permitted = min(self._window, ack.window or self._window)
        self.acked += sent.steps
        self.waiting = ""
        self._pauses = pauses()
        return True
