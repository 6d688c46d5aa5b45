"""Conversations: what a role says and awaits, as generators without threads, sleep or sockets.

A conversation sends by its node, which only hands messages over, and yields whenever it must wait: a number of seconds,
or the `Answer` that it awaits. It is resumed after these seconds, or once the answer is there or can't come any more,
with True if this process has been asked to stop. What it returns is its result. `drive` runs one in a thread over
Zenoh; a simulator runs the same ones in made-up time (`benchmarks/simulate`).
"""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable, Generator, Iterator
from concurrent.futures import ThreadPoolExecutor, wait
from functools import partial
from typing import Protocol, TypeAlias, TypeVar

from coop.common.messaging.keys import KeySpace
from coop.common.messaging.timing import ASK_TIMEOUT, LOOKS, PAUSES
from coop.common.messaging.wire import Message
from coop.common.process.lifecycle import Stop

NO_ANSWER = "the replay service does not answer"
BAD_ANSWER = "the replay service's answer is bad"

T = TypeVar("T")
RESTING = "resting"  # name of a thread that waits for its next task
_THREADS = ThreadPoolExecutor(16)


class Answer(Protocol):
    """The answer to a question that is on its way."""

    def ready(self) -> Message | None:
        """The answer if it has arrived, else None; raises `NoAnswer` if it can't come any more, or `Refused`."""

    def settled(self) -> bool:
        """Whether `ready` has something to say."""

    def settle(self) -> None:
        """Wait until it has."""


Wait: TypeAlias = "float | Answer"
Conversation: TypeAlias = Generator[Wait, bool, T]


class Asker(KeySpace, Protocol):
    """What carries questions, and has a clock: a `Node`, or an actor's route to the replay service."""

    run: str

    def begin(self, key: str, payload: bytearray, timeout: float = ASK_TIMEOUT) -> Answer:
        """Send a question and return at once."""

    def now(self) -> float:
        """Seconds of a clock that never goes back."""


class Task(Protocol):
    """Something under way beside its caller; a thread is one."""

    def is_alive(self) -> bool:
        """True until it has ended."""

    def join(self) -> None:
        """Wait for its end."""


def asking(node: Asker, key: str, payload: bytearray, timeout: float = ASK_TIMEOUT) -> Conversation[Message]:
    """Ask a question and return its answer; raises as `Answer.ready`."""
    answer = node.begin(key, payload, timeout)
    while (message := answer.ready()) is None:
        yield answer
    return message


def pauses(bounds: tuple[float, float] = PAUSES) -> Iterator[float]:
    """Pauses that double, from the first up to the longest."""
    pause, longest = bounds
    while True:
        yield pause
        pause = min(longest, 2 * pause)


def ended(task: Task | None) -> Conversation[None]:
    """Wait for a task's end."""
    looks = pauses(LOOKS)
    while task is not None and task.is_alive():
        yield next(looks)


def drive(conversation: Conversation[T], stop: Stop | None = None, on_wait: Callable[[], None] | None = None) -> T:
    """Run a conversation in this thread.

    stop: cuts one pause short, and is told then; later pauses last. None: it never learns of a stop.
    on_wait: called repeatedly while an answer is awaited, which the stop then cuts short too.
    """
    told = False
    step: Callable[[], Wait] = partial(next, conversation)
    while True:
        try:
            wait = step()
        except StopIteration as end:
            result: T = end.value
            return result
        try:
            if not isinstance(wait, float | int):
                _await(wait, stop, on_wait)
            elif stop is None or told:
                time.sleep(wait)
            else:
                stop.wait(wait)
            told = stop is not None and stop.is_set()
            step = partial(conversation.send, told)
        except BaseException as error:  # a second SIGINT, which must find the conversation where it waits
            step = partial(conversation.throw, error)


def _await(answer: Answer, stop: Stop | None, on_wait: Callable[[], None] | None) -> None:
    if stop is None or on_wait is None:
        answer.settle()
        return
    looks = pauses(LOOKS)
    while not answer.settled() and not stop.wait(next(looks)):
        on_wait()


def drive_held(conversation: Conversation[T], changed: threading.Condition) -> T:
    """Run a conversation that waits for changes of what a condition guards, which it holds otherwise."""
    with changed:
        try:
            wait = next(conversation)
            while True:
                assert isinstance(wait, float | int)
                changed.wait(wait)
                wait = conversation.send(False)
        except StopIteration as end:
            result: T = end.value
            return result


class _Started:
    """A task in a thread of `_THREADS`."""

    def __init__(self, name: str, conversation: Conversation[None]) -> None:
        self._future = _THREADS.submit(self._run, name, conversation)

    def is_alive(self) -> bool:
        """See `Task`."""
        return not self._future.done()

    def join(self) -> None:
        """See `Task`."""
        wait([self._future])

    @staticmethod
    def _run(name: str, conversation: Conversation[None]) -> None:
        thread = threading.current_thread()
        thread.name = name
        try:
            drive(conversation)
        except BaseException:  # reported as what ends any other thread
            threading.excepthook(threading.ExceptHookArgs((*sys.exc_info(), thread)))
        finally:
            thread.name = RESTING


def start(name: str, conversation: Conversation[None], stop: Stop | None = None) -> Task:
    """Run a conversation in another thread; the process waits for it, unless a stop ends it.

    Threads of those that end are used again: glibc gives each new one memory of its own, which is not given back.
    """
    if stop is None:
        return _Started(name, conversation)
    thread = threading.Thread(target=drive, args=(conversation, stop), name=name, daemon=True)
    thread.start()
    return thread
