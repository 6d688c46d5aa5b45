"""Made-up time, processes that may be killed or frozen, and the conversations that they hold."""

from __future__ import annotations

import heapq
import random
from collections.abc import Callable
from typing import Any

from coop.common.errors import CoopError
from coop.common.messaging.conversation import Conversation
from coop.common.process.lifecycle import Stop


class Killed(BaseException):
    """The end of a process in the middle of what it does."""


class Violation(BaseException):
    """An invariant does not hold."""


class World:
    """Events in the order of their time, which is in seconds.

    Attributes:
        now: true time. trace: what happened, as (time, words), words being joined only if someone reads them.
        running: the process whose code runs at the moment.
    """

    def __init__(self, seed: int) -> None:
        self.seed = seed
        self.now = 0.0
        self.random = random.Random(seed)
        self.trace: list[tuple[float, tuple[Any, ...]]] = []
        self.events = 0
        self.running: Process | None = None
        self.processes: list[Process] = []
        self._queue: list[tuple[float, int, Callable[[], None]]] = []
        self._count = 0
        self.disk_delay: Callable[[Process], float] = lambda process: 0.0  # seconds that a flush takes
        self.broken: Violation | None = None  # the first one
        self.said: Callable[[Process, str], None] = lambda process, text: None

    def at(self, time: float, call: Callable[[], None]) -> None:
        """Call `call` at a time, after what was planned earlier for the same time."""
        self._count += 1
        heapq.heappush(self._queue, (time, self._count, call))

    def after(self, seconds: float, call: Callable[[], None]) -> None:
        """Call `call` in so many seconds."""
        self.at(self.now + seconds, call)

    def tell(self, *words: object) -> None:
        """Add to the trace."""
        self.trace.append((self.now, words))

    def run(self, until: Callable[[], bool], deadline: float) -> bool:
        """Let time pass until something has happened; False if it has not by the deadline."""
        queue = self._queue
        while queue and not until():
            time, _, call = heapq.heappop(queue)
            if time > deadline:
                return False
            self.now = time
            self.events += 1
            call()
            if self.broken is not None:  # what it was raised in may have more to say before it ends
                raise self.broken
        return until()


class Machine:
    """A machine with a clock and, if a process keeps files, a disk.

    Its clock, a monotonic one, runs at `rate` times true time and may leap forward.
    """

    def __init__(self, world: World, name: str, rate: float, offset: float) -> None:
        self.name = name
        self._world = world
        self._rate = rate
        self._offset = offset

    def clock(self) -> float:
        """What the clock shows."""
        return self._offset + self._world.now * self._rate

    def leap(self, seconds: float) -> None:
        """Move the clock forward."""
        self._offset += seconds


class SimStop(Stop):
    """A stop that cuts the pauses of a process's conversations short."""

    def __init__(self, process: Process) -> None:
        super().__init__()
        self._process = process

    def set(self, reason: str, failed: bool = False, exit_status: int = 0) -> None:
        """See `Stop`."""
        first = not self._set
        super().set(reason, failed, exit_status)
        if first:
            self._process.world.tell(self._process.name, "is to stop:", reason)
            for activity in list(self._process.activities):
                activity.cut_short()


class Process:
    """A process: its conversations run while it is neither frozen nor dead.

    Attributes:
        nodes: its places in the network. alive: until it has ended. frozen: it does nothing, but will.
        on_end: called when it has ended, with why; the reason is empty if it ended as it should.
    """

    def __init__(self, world: World, name: str, role: str, machine: Machine) -> None:
        self.world = world
        self.name = name
        self.role = role
        self.machine = machine
        self.alive = True
        self.frozen = False
        self.stop = SimStop(self)
        self.activities: list[Activity] = []
        self.nodes: list[Any] = []
        self.on_end: Callable[[str], None] = lambda reason: None
        self.state: dict[str, Any] = {}
        self.since = world.now  # when it began, or was thawed last
        self.number = len(world.processes) + 1
        self._backlog: list[Callable[[], None]] = []
        world.processes.append(self)

    def now(self) -> float:
        """The clock of its machine."""
        return self.machine.clock()

    def do(self, call: Callable[[], None]) -> None:
        """Call `call` as this process: at once, after a freeze, or never."""
        if not self.alive:
            return
        if self.frozen:
            self._backlog.append(call)
            return
        before, self.world.running = self.world.running, self
        try:
            call()
        except Killed:
            self.end("killed in the middle of a write")
        finally:
            self.world.running = before

    def start(self, name: str, conversation: Conversation[Any], stop: Stop | None = None) -> Activity:
        """Begin a conversation."""
        activity = Activity(self, name, conversation, stop)
        self.activities.append(activity)
        delay = self.world.disk_delay(self) if name.startswith("checkpoint") else 0.0
        self.world.after(delay, lambda: self.do(activity.step))
        return activity

    def freeze(self) -> None:
        """Stop doing anything."""
        self.frozen = True

    def thaw(self) -> None:
        """Go on with what has arrived meanwhile."""
        self.frozen, self.since = False, self.world.now
        backlog, self._backlog = self._backlog, []
        for call in backlog:
            self.world.after(0.0, lambda call=call: self.do(call))  # type: ignore[misc]

    def end(self, reason: str) -> None:
        """End it; the reason is empty if it has done what it should."""
        if not self.alive:
            return
        self.alive = False
        self.world.tell(self.name, "ends:" if reason else "ends as it should", reason)
        for node in list(self.nodes):
            node.gone()
        self.on_end(reason)


class Activity:
    """A conversation that a process holds: a `Task`."""

    def __init__(self, process: Process, name: str, conversation: Conversation[Any], stop: Stop | None) -> None:
        self.name = name
        self.on_result: Callable[[Any], None] = lambda result: None
        self._process = process
        self._conversation = conversation
        self._stop = stop
        self._waits = 0  # counts the waits, so that only the present one's end resumes the conversation
        self._pausing = False
        self._told = False
        self._begun = False
        self._over = False

    def is_alive(self) -> bool:
        """See `Task`."""
        return not self._over

    def join(self) -> None:
        """Nothing waits here: who joins a task has asked it to stop, and goes on meanwhile."""

    def cut_short(self) -> None:
        """The stop: end the pause, unless the conversation has been told of the stop before."""
        if self._pausing and not self._told and self._stop is not None:
            self._resume_in(0.0)

    def abandon(self) -> None:
        """Close the conversation of a dead process, whatever it says to that."""
        self._over = True
        for _ in range(100):
            try:
                self._conversation.close()
            except BaseException:
                continue
            return

    def step(self) -> None:
        """Go on until the next wait."""
        if self._over:
            return
        self._pausing, process = False, self._process
        try:
            if self._begun:
                self._told = self._stop is not None and self._stop.is_set()
                wait = self._conversation.send(self._told)
            else:
                self._begun = True
                wait = next(self._conversation)
        except StopIteration as end:
            self._over = True
            self.on_result(end.value)
        except CoopError as error:
            self._over = True
            process.end(f"{type(error).__name__}: {error}")
        else:
            if isinstance(wait, float | int):
                self._pausing = True
                self._resume_in(max(0.0, wait))
            else:
                self._waits += 1
                number = self._waits
                wait.then(lambda: self._resume(number))

    def _resume_in(self, seconds: float) -> None:
        self._waits += 1
        number = self._waits
        self._process.world.after(seconds, lambda: self._resume(number))

    def _resume(self, number: int) -> None:
        if number == self._waits and not self._over:
            self._waits += 1
            self._process.do(self.step)
