"""Takes the results of evaluators, for the learner's loop to write."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from queue import Empty, SimpleQueue

from coop.common.bounds import MAX_QUESTION, MAX_VIDEO
from coop.common.errors import RunError
from coop.common.messaging.keys import evaluations_key
from coop.common.messaging.messages.answers import Ack
from coop.common.messaging.messages.evaluate import Evaluated, EvaluationRow, Video
from coop.common.messaging.transport import Node
from coop.common.messaging.wire import Message


class EvaluationInbox:
    """Answers evaluators, in a thread of its own, and keeps their results until they are taken.

    Args:
        env_step: returns the environment steps of the run so far.
    """

    def __init__(self, node: Node, env_step: Callable[[], int]) -> None:
        self._run = node.run
        self._env_step = env_step
        self._results: SimpleQueue[EvaluationRow | Video] = SimpleQueue()
        self._next: dict[int, int] = {}  # number of the result that follows, by incarnation
        node.serve(evaluations_key(node), self._answer, most=MAX_QUESTION + MAX_VIDEO)

    def take(self) -> Iterator[EvaluationRow | Video]:
        """Yield the results and videos that have arrived since the last call."""
        while True:
            try:
                yield self._results.get_nowait()
            except Empty:
                return

    def _answer(self, message: Message) -> bytearray:
        given = (Video if message.kind == Video.kind else Evaluated).decode(message)
        result = given if isinstance(given, Video) else given.result
        steps = self._env_step()
        if result.env_step > steps:  # of a learner that has been killed and has gone back to its checkpoint since
            raise RunError(f"an evaluation after {result.env_step:,} steps; this run has done {steps:,}")
        if given.number >= self._next.get(given.incarnation, 0):
            self._next[given.incarnation] = given.number + 1
            self._results.put(result)
        return Ack(steps).encode(self._run)
