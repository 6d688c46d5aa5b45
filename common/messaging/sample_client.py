"""The client that draws: prefetched batches, whose frames it may read in the replay service's memory.

It has no thread of its own: Zenoh works in the background, and the caller processes the answers.
"""

from __future__ import annotations

from collections import deque

import msgspec
import numpy as np
from numpy.typing import NDArray

from common.bounds import MAX_AHEAD
from common.errors import BadMessage
from common.messaging.keys import replay_key
from common.messaging.messages.answers import Retry
from common.messaging.messages.sample import BatchReader, Drawn, DrawRequest, Memory
from common.messaging.repeating import BAD_ANSWER, NO_ANSWER, Backoff
from common.messaging.shared_frames import SharedFrames
from common.messaging.transport import NoAnswer, Node, Pending
from common.messaging.wire import Message
from common.process.lifecycle import Stop
from common.types import Batch, EnvSpec


class SampleClient:
    """Draws batches, with `prefetch` requests in flight.

    Args:
        first: number of the first batch, the learner's count of updates at the start.
        episodes: number of episodes that the learner has received before.
        shared_memory: read the frames in the replay service's memory if it is on this machine and shares them.

    Attributes:
        episodes: number of episodes received so far.
        waiting: why no batch arrives, in words; empty while batches arrive.
    """

    def __init__(
        self,
        node: Node,
        stop: Stop,
        incarnation: int,
        spec: EnvSpec,
        batch_size: int,
        prefetch: int,
        first: int = 0,
        episodes: int = 0,
        *,
        shared_memory: bool = False,
    ) -> None:
        self.episodes = episodes
        self.waiting = ""
        self._node = node
        self._stop = stop
        self._incarnation = incarnation
        self._batch_size = batch_size
        self._prefetch = prefetch
        self._spec = spec
        self._read = BatchReader(spec)
        self._shares = shared_memory
        self._shared: SharedFrames | None = None
        self._key = replay_key(node, "sample")
        self._outstanding: deque[tuple[int, Pending]] = deque()
        self._next = first
        self._done = first
        self._pinned: int | None = None
        self._trained: list[tuple[int, float]] = []  # priorities that no request contains yet
        self._carried: dict[int, tuple[tuple[int, float], ...]] = {}  # by number of the request that contains them
        self._backoff = Backoff()

    def pin(self) -> int:
        """Keep all later batches repeatable until `release`; return the number of batches received."""
        self._pinned = self._done
        return self._done

    def release(self) -> None:
        """End `pin`."""
        self._pinned = None

    def prioritise(self, ids: NDArray[np.int64], priorities: NDArray[np.float32]) -> None:
        """Set the priorities, float32 [n], of the transitions numbered ids, int64 [n], with the next request."""
        self._trained.extend(zip(ids.tolist(), priorities.tolist(), strict=True))

    def next(self) -> tuple[Batch, Drawn] | None:
        """The next batch and the episodes that ended since the last one; None if no batch is available yet.

        Raises:
            Refused: the replay service rejected a request as invalid, or now serves another learner.
        """
        while len(self._outstanding) < self._prefetch and self._next < self._base + MAX_AHEAD:
            self._carried[self._next], self._trained = tuple(self._trained), []
            self._outstanding.append((self._next, self._request(self._next)))
            self._next += 1
        if not self._outstanding:
            self.waiting = "the replay service has not begun its part of the epoch"
            self._backoff.pause(self._stop)
            return None
        sequence, pending = self._outstanding[0]
        try:
            message = pending.wait()
            if message.kind == Memory.kind:
                self._share(Memory.decode(message).address)
                # All of them, in their order: the later ones have met the same answer, or will.
                self._outstanding = deque((number, self._request(number)) for number, _ in self._outstanding)
                return None
            if message.kind != Retry.kind:
                accepted = self._accept(message, sequence)
                self._outstanding.popleft()
                return accepted
            self.waiting = Retry.decode(message).reason
        except NoAnswer:
            self.waiting = NO_ANSWER
        except BadMessage as error:
            self.waiting = f"{BAD_ANSWER}: {error}"
        self._backoff.pause(self._stop)
        self._outstanding[0] = (sequence, self._request(sequence))
        return None

    @property
    def _base(self) -> int:
        return self._done if self._pinned is None else self._pinned

    def _request(self, sequence: int) -> Pending:
        priorities = self._carried[sequence]
        memory = self._shared.address if self._shared else "" if self._shares else None
        request = DrawRequest(
            self._incarnation, sequence, self._base, self._batch_size, self.episodes, priorities, memory
        )
        return self._node.begin(self._key, request.encode(self._node.run))

    def _share(self, address: str) -> None:
        """Read frames there from now on, or nowhere if this process does not reach them."""
        if self._shared is None or self._shared.address != address:
            try:
                self._shared = SharedFrames(address, self._spec)
            except OSError:
                self._shared, self._shares = None, False

    def _accept(self, message: Message, sequence: int) -> tuple[Batch, Drawn]:
        batch, drawn = self._read(message, self._shared)
        if drawn.sequence != sequence:
            raise BadMessage("fields.sequence", f"{drawn.sequence} instead of {sequence}")
        self._backoff.reset()
        self.waiting = ""
        self._done = sequence + 1
        del self._carried[sequence]
        first = max(self.episodes, drawn.first_episode)
        fresh = drawn.episodes[first - drawn.first_episode :]
        self.episodes = first + len(fresh)
        return batch, msgspec.structs.replace(drawn, first_episode=first, episodes=fresh)
