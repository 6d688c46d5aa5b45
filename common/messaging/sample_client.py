"""The client that draws: prefetched batches, whose frames it may read in a mirror or in the replay service's memory.

It has no thread of its own: Zenoh works in the background, and the caller processes the answers.
"""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from coop.common.bounds import MAX_AHEAD
from coop.common.errors import BadMessage
from coop.common.messaging.conversation import BAD_ANSWER, NO_ANSWER, Answer, Asker, Conversation, drive, pauses
from coop.common.messaging.keys import replay_key
from coop.common.messaging.messages.answers import Retry
from coop.common.messaging.messages.sample import (
    NAMED,
    BatchReader,
    Memory,
    NamedBatch,
    NamedBatchReader,
    encode_request,
)
from coop.common.messaging.mirror import FrameMirror
from coop.common.messaging.shared_frames import SharedFrames
from coop.common.messaging.transport import NoAnswer
from coop.common.messaging.wire import Message
from coop.common.process.lifecycle import Stop
from coop.common.settings.capacity import frame_bytes
from coop.common.transitions import Batch, Drawn, DrawRequest
from coop.common.types import EnvSpec

MANY = 4  # batches are asked for one by one if more than one of so many frames came with the last answer
TOGETHER = 1 << 24  # bytes of batches that are asked for in one request, unless it is a single one


_Priorities = tuple[NDArray[np.int64], NDArray[np.float32]]  # as in a `DrawRequest`


class _Asked(NamedTuple):
    """A request in flight, for `draws` batches from number `first` on."""

    first: int
    draws: int
    answer: Answer


class SampleClient:
    """Draws batches, with `prefetch` of them asked for ahead, several in one request where none will have to wait.

    Args:
        first: number of the first batch, the learner's count of updates at the start.
        episodes: number of episodes that the learner has received before.
        shared_memory: read the frames in the replay service's memory if it is on this machine and shares them.
        mirror: of the table's frames, so that each crosses once; None: each batch brings all its frames.

    Attributes:
        episodes: number of episodes received so far.
        waiting: why no batch arrives, in words; empty while batches arrive.
    """

    def __init__(
        self,
        node: Asker,
        stop: Stop,
        incarnation: int,
        spec: EnvSpec,
        batch_size: int,
        prefetch: int,
        first: int = 0,
        episodes: int = 0,
        *,
        shared_memory: bool = False,
        mirror: FrameMirror | None = None,
    ) -> None:
        self.episodes = episodes
        self.waiting = ""
        self._node = node
        self._stop = stop
        self._incarnation = incarnation
        self._batch_size = batch_size
        self._prefetch = prefetch
        batch_bytes = batch_size * (spec.stack + 1) * frame_bytes(spec)
        self._together = max(1, min(prefetch // 2, TOGETHER // batch_bytes))
        self._spec = spec
        self._read = BatchReader(spec)
        self._read_named = NamedBatchReader(spec)
        self._shares = shared_memory
        self._shared: SharedFrames | None = None
        self._mirror = mirror
        self._key = replay_key(node, "sample")
        self._outstanding: deque[_Asked] = deque()
        self._arrived: deque[tuple[Batch | NamedBatch, Drawn]] = deque()
        self._admitted = 0  # draws of lower numbers need not wait, and may be asked for together
        self._next = first
        self._done = first
        self._pinned: int | None = None
        self._trained: list[_Priorities] = []  # those that no request contains yet
        self._carried: dict[int, _Priorities] = {}  # by first number of the request with them
        self._pauses = pauses()

    def pin(self) -> int:
        """Keep all later batches repeatable until `release`; return the number of batches received."""
        self._pinned = self._done
        return self._done

    def release(self) -> None:
        """End `pin`."""
        self._pinned = None

    def prioritise(self, ids: NDArray[np.int64], priorities: NDArray[np.float32]) -> None:
        """Set the priorities, float32 [n], of the transitions numbered ids, int64 [n], with the next request."""
        self._trained.append((ids, priorities))

    def next(self) -> tuple[Batch, Drawn] | None:
        """The next batch and the episodes that ended since the last one; None if no batch is available yet.

        Raises:
            Refused: the replay service rejected a request as invalid, or now serves another learner.
        """
        return drive(self.drawing(), self._stop)

    def drawing(self) -> Conversation[tuple[Batch, Drawn] | None]:
        """See `next`."""
        self._ask_ahead()
        if not self._outstanding and not self._arrived:
            self.waiting = "the replay service has not begun its part of the checkpoint"
            yield next(self._pauses)
            return None
        try:
            if self._arrived or (yield from self._receive()):
                if (batch := self._frames_of(*self._arrived[0])) is not None:
                    return batch, self._accept()
                self._ask_again()  # and the answer will carry what the mirror lacks
            return None
        except NoAnswer:
            self.waiting = NO_ANSWER
        except BadMessage as error:
            self.waiting = f"{BAD_ANSWER}: {error}"
        yield next(self._pauses)
        self._ask_all_again()
        return None

    @property
    def _base(self) -> int:
        return self._done if self._pinned is None else self._pinned

    def _ask_ahead(self) -> None:
        """Ask for the batches up to `prefetch`; for several that need not wait together, or not yet."""
        while (room := min(self._done + self._prefetch, self._base + MAX_AHEAD) - self._next) > 0:
            count = max(1, min(self._together, self._admitted - self._next))
            if count > room and (self._outstanding or self._arrived):
                return
            count = min(count, room)
            if self._trained:
                ids, priorities = zip(*self._trained, strict=True)
                self._carried[self._next], self._trained = (np.concatenate(ids), np.concatenate(priorities)), []
            self._outstanding.append(self._request(self._next, count))
            self._next += count

    def _request(self, first: int, count: int) -> _Asked:
        memory = self._shared.address if self._shared else "" if self._shares else None
        mirror = self._mirror
        request = DrawRequest(
            self._incarnation,
            first,
            self._base,
            self._batch_size,
            self.episodes,
            memory,
            0 if mirror is None else mirror.number,
            0 if mirror is None else mirror.slots,
            count,
            *self._carried.get(first, ()),
        )
        return _Asked(first, count, self._node.begin(self._key, encode_request(self._node.run, request)))

    def _ask_again(self) -> None:
        """Ask again for the batches that have arrived, or else for those that were to arrive first."""
        if self._arrived:
            self._outstanding.appendleft(self._request(self._done, len(self._arrived)))
            self._arrived.clear()
        else:
            first, count, _ = self._outstanding[0]
            self._outstanding[0] = self._request(first, count)

    def _ask_all_again(self) -> None:
        """Ask again for all that has not arrived, in order: the later ones have met the same fate, or will.

        If only the first were asked for again, it would come behind the others for good, and wait for each of them.
        """
        if self._arrived:
            self._ask_again()
        self._outstanding = deque(self._request(first, count) for first, count, _ in self._outstanding)

    def _receive(self) -> Conversation[bool]:
        """Wait for the first answer; False if it is no batch, and batches have been asked for again."""
        first, count, answer = self._outstanding[0]
        while (message := answer.ready()) is None:
            yield answer
        if message.kind == Memory.kind:
            self._share(Memory.decode(message).address)
            self._ask_all_again()
            return False
        if message.kind == Retry.kind:
            self.waiting = Retry.decode(message).reason
            yield next(self._pauses)
            self._ask_again()
            return False
        arrived: list[tuple[Batch | NamedBatch, Drawn]] = []
        if message.kind == NAMED:
            draws, batches = self._read_named(message)
            few = MANY * len(message.arrays["frames"]) <= len(message.arrays["slots"])
            self._admitted = draws.admitted if few else 0  # two batches with all frames are slower than one by one
            arrived += zip(batches, draws.draws, strict=True)
            if not draws.memory:
                self._mirrored(message, draws.table)
        else:
            arrived.append(self._read(message))
        numbers = [drawn.sequence for _, drawn in arrived]
        if numbers != list(range(first, first + len(numbers))) or len(numbers) > count:
            raise BadMessage("fields.sequence", f"{numbers} instead of {count} from {first} on")
        self._outstanding.popleft()
        self._arrived.extend(arrived)
        if len(arrived) < count:
            self._outstanding.appendleft(self._request(first + len(arrived), count - len(arrived)))
        return True

    def _mirrored(self, message: Message, table: int) -> None:
        """Write the frames that an answer carries to the mirror."""
        if self._mirror is None:
            raise BadMessage("fields.memory", "none, and there is no mirror")
        carried = message.arrays["carried"]
        slots, numbers = message.arrays["slots"][carried], message.arrays["numbers"][carried]
        self._mirror.write(table, slots, numbers, message.arrays["frames"])

    def _frames_of(self, batch: Batch | NamedBatch, drawn: Drawn) -> Batch | None:
        """The batch with its frames; None if the mirror lacks some."""
        if isinstance(batch, Batch):
            return batch
        if not batch.memory:
            return None if self._mirror is None else self._mirror.read(batch)
        if self._shared is None or self._shared.address != batch.memory:
            raise BadMessage("fields.memory", f"{batch.memory!r}, which this process does not read")
        return Batch(frames=self._shared.read(batch.slots), **batch.columns)

    def _share(self, address: str) -> None:
        """Read frames there from now on, or nowhere if this process does not reach them."""
        if self._shared is None or self._shared.address != address:
            try:
                self._shared = SharedFrames(address, self._spec)
            except OSError:
                self._shared, self._shares = None, False

    def _accept(self) -> Drawn:
        """Note that the first batch has arrived; return what accompanies it, without episodes that have before."""
        _, drawn = self._arrived.popleft()
        self._pauses = pauses()
        self.waiting = ""
        self._done = drawn.sequence + 1
        self._carried.pop(drawn.sequence, None)
        first = max(self.episodes, drawn.first_episode)
        fresh = drawn.episodes[first - drawn.first_episode :]
        self.episodes = first + len(fresh)
        return msgspec.structs.replace(drawn, first_episode=first, episodes=fresh)
