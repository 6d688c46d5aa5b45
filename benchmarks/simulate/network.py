"""The simulated network, in place of Zenoh: links that come and go, and messages on their way.

What is on its way may be late, overtake, arrive twice or not at all. A link lasts until one side ends, or until nothing
has come through for `LEASE`; then the tokens of the other side disappear and its questions have no answer.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from benchmarks.simulate.world import World
from coop.common.messaging.timing import LEASE

if TYPE_CHECKING:
    from benchmarks.simulate.node import SimAnswer, SimNode

FAIR = 0.002  # seconds of delay
RECONNECT = 0.2  # seconds between tries to connect


@dataclass
class Weather:
    """What happens to messages for now: seconds of delay at most, and shares that are lost or arrive twice."""

    delay: float = FAIR
    lost: float = 0.0
    twice: float = 0.0


@dataclass
class Link:
    """A connection of two nodes; endpoint: by which the first found the second."""

    ends: tuple[SimNode, SimNode]
    endpoint: str
    up: bool = True
    last: dict[str, float] = field(default_factory=dict)  # when the last message will arrive, by its sender's role
    questions: list[SimAnswer] = field(default_factory=list)

    def other(self, node: SimNode) -> SimNode:
        """The other end."""
        return self.ends[1] if self.ends[0] is node else self.ends[0]


class Network:
    """All links; cuts are of one direction between two machines.

    Attributes:
        delivered, dropped, doubled: counts of messages.
    """

    def __init__(self, world: World) -> None:
        self.world = world
        self.weather = Weather()
        self.listening: dict[str, SimNode] = {}
        self.cuts: dict[tuple[str, str], int] = {}
        self.disturbed = -100.0  # when the weather was bad last, or a cut or a freeze ended
        self.delivered = self.dropped = self.doubled = 0
        self._held: list[tuple[SimNode, SimNode, Link, Callable[[], None]]] = []

    def blocked(self, source: SimNode, target: SimNode) -> bool:
        """Whether nothing gets through in this direction now."""
        return (source.process.machine.name, target.process.machine.name) in self.cuts

    def dead(self, link: Link) -> bool:
        """Whether a link is silent in some direction."""
        one, two = link.ends
        gone = not (one.process.alive and two.process.alive) or one.process.frozen or two.process.frozen
        return gone or self.blocked(one, two) or self.blocked(two, one)

    def send(self, source: SimNode, link: Link, call: Callable[[], None]) -> None:
        """Let `call` happen in the process at the other end, some time."""
        target, weather, draw = link.other(source), self.weather, self.world.random.random
        if weather.lost and draw() < weather.lost:
            self.dropped += 1
            return
        copies = 1
        if weather.twice and draw() < weather.twice:
            self.doubled += 1
            copies = 2
        for _ in range(copies):
            arrives = self.world.now + 0.0002 + draw() ** 3 * weather.delay
            if weather.delay <= FAIR:  # in fair weather none overtakes another
                arrives = link.last[source.role] = max(arrives, link.last.get(source.role, 0.0))
            self.world.at(arrives, lambda: self._arrive(source, target, link, call))

    def _arrive(self, source: SimNode, target: SimNode, link: Link, call: Callable[[], None]) -> None:
        if not link.up:
            self.dropped += 1
        elif self.blocked(source, target):
            self._held.append((source, target, link, call))
        else:
            self.delivered += 1
            target.process.do(call)

    def cut(self, one: str, two: str) -> None:
        """Let nothing through from machine `one` to machine `two`."""
        self.cuts[one, two] = self.cuts.get((one, two), 0) + 1
        self.watch()

    def heal(self, one: str, two: str) -> None:
        """End a cut."""
        self.disturbed = self.world.now
        self.cuts[one, two] -= 1
        if not self.cuts[one, two]:
            del self.cuts[one, two]
        held, self._held = self._held, []
        for source, target, link, call in held:
            self.world.after(0.001, lambda a=(source, target, link, call): self._arrive(*a))  # type: ignore[misc]

    def watch(self) -> None:
        """Give up the links that are silent now, if they still are after `LEASE`."""
        for node in list(self.nodes()):
            for link in list(node.links):
                if node is link.ends[0] and self.dead(link):
                    self.world.after(LEASE, lambda link=link: self._give_up(link))  # type: ignore[misc]

    def _give_up(self, link: Link) -> None:
        if link.up and self.dead(link):
            self.take_down(link)

    def nodes(self) -> list[SimNode]:
        """The nodes of processes that live."""
        return [node for process in self.world.processes if process.alive for node in process.nodes]

    def connect(self, node: SimNode, endpoint: str) -> None:
        """Connect a node, or try again soon; also once the link is gone."""
        if not (node.open and node.process.alive):
            return
        target = self.listening.get(endpoint)
        if target is not None and target.open and target.process.alive and not node.linked(target):
            link = Link((node, target), endpoint)
            if not self.dead(link):
                for end in link.ends:
                    end.links.append(link)
                    self._token(end, link, there=True)
                return
        again = RECONNECT * (0.75 + self.world.random.random() / 2)
        self.world.after(again, lambda: self.connect(node, endpoint))

    def take_down(self, link: Link) -> None:
        """End a link: tokens disappear, and questions have no answer."""
        link.up = False
        for end in link.ends:
            if link in end.links:
                end.links.remove(link)
            self._token(end, link, there=False)
        for answer in link.questions:
            self.world.after(0.001, answer.lose)
        self.world.after(RECONNECT, lambda: self.connect(link.ends[0], link.endpoint))

    def _token(self, end: SimNode, link: Link, *, there: bool) -> None:
        other = link.other(end)

        def note() -> None:
            if end.open and (link.up or not there):
                end.presence.note(other.role, other.incarnation, there)

        if end.process.alive:
            self.world.after(0.001 if there else 0.003, lambda: end.process.do(note))
