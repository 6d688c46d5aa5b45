"""What must hold, after each event and at the end."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Collection
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from benchmarks.simulate.roles import STEPS
from benchmarks.simulate.sealed import Checkpoints
from benchmarks.simulate.strangers import Strangers, acting_of
from benchmarks.simulate.world import Process, Violation
from coop.common.messaging import wire
from coop.common.messaging.messages.evaluate import EvaluationRow
from coop.common.transitions import Batch, Drawn, DrawRequest, Segment
from coop.learner.trainer import Effects, Trainer
from coop.replay.core import ReplayCore, Reply
from coop.replay.persistence.journal import Journal

if TYPE_CHECKING:
    from benchmarks.simulate.cluster import Cluster

STALE = 6.0  # seconds of good weather after which an actor must know what the learner broadcast last
EXPECTED = (  # how processes end that meet faults, in words
    "killed",
    "its machine has died",
    "JoinError: ",
    "uses it",
    "No space left",
    "Input/output error",
    "serves this run",
    "has taken over from this one",
    "has been gone for",
    "the journal can't be flushed",
    "another learner",
    "no checkpoint to resume from",
    "; this is run ",
    "belongs to another run",
)


class Checks:
    """Knows what was promised: which segments have been acknowledged, what was drawn, broadcast and saved.

    Attributes:
        done: how often each invariant was looked at. checkpoints: looks at those that are sealed. strangers: knows who
            takes part in another run; what follows is about this one.
    """

    def __init__(self, cluster: Cluster) -> None:
        self.cluster = cluster
        self.done: Counter[str] = Counter()
        self.checkpoints = Checkpoints(self)
        self.strangers = Strangers(self)
        self._believed: Counter[int] = Counter()  # transitions acknowledged to each actor
        self.serving = -1  # incarnation of the replay service that the learner has admitted
        self.acked: dict[tuple[int, int], str] = {}  # segments, with when
        self.forgiven = 0
        self._sent: dict[tuple[int, int], int] = {}  # first transition of each segment
        self._forgive = False  # what was acknowledged may be lost: nothing says that it survives what has happened
        self._folder: object = None
        self._draws: dict[tuple[int, int], tuple[int, ...]] = {}
        self._owners: dict[int, tuple[Reply, int]] = {}
        self._evaluations: set[float] = set()
        self._bases: dict[int, int] = {}
        self._inserted = 0  # transitions, at most, of which a learner has heard
        self._learner, self._counted = -1, 0
        self._counting: object = None  # the core that draws for it
        self._last_ack = self._last_save = -1.0
        self._flats: dict[tuple[int, int], set[bytes]] = defaultdict(set)
        self._roles: list[tuple[float, int, tuple[int, int]]] = []  # when, who acts, and versions
        self._saved: dict[int, set[bytes]] = defaultdict(set)  # agents after so many updates
        self._trainer: Trainer | None = None
        self._core: ReplayCore | None = None
        self._began_at = 0.0

    def hold(self, what: str, holds: bool, words: str) -> None:
        """Count a look at an invariant; raise Violation if it does not hold."""
        self.done[what] += 1
        if not holds:
            self.broken(f"{what}: {words}")

    def broken(self, words: str) -> None:
        """Raise Violation, and make sure that it ends the run."""
        world = self.cluster.world
        world.broken = world.broken or Violation(words)
        raise world.broken

    # ------------------------------------------------------------------------------------------------------------------
    # Acknowledgements and the table

    def sent(self, segment: Segment) -> None:
        """An actor has made a segment."""
        self._sent[segment.incarnation, segment.sequence] = int(segment.rewards[0])

    def on_reply(self, node: Any, key: str, message: wire.Message, reply: bytes) -> None:  # noqa: ANN401
        """An answer leaves."""
        self.strangers.answers(node, key, message)
        if self.strangers.foreign(node.process):
            return
        if node.role == "learner" and key.endswith("/config/replay") and message.kind == "leave":
            self._departs(message.fields["incarnation"], wire.decode(reply).kind)
        if node.role != "replay" or not key.endswith(("/insert", "/sample")):
            return
        beginning = reply[:100]  # which holds the kind
        if b"\xa5retry" in beginning:
            return
        self.hold("one service", node.incarnation == self.serving, f"{node.process.name} serves, another was admitted")
        if b"\xa3ack" in beginning and key.endswith("/insert"):
            who = message.fields["incarnation"], message.fields["sequence"]
            self.hold("acknowledged", who in self._sent, "a segment that nobody sent")
            core = node.process.state["core"]
            self.hold(
                "acknowledged", core._seen.seen(who[0], 0, who[1]), f"segment {who[1]}, which is not in the table"
            )
            if who not in self.acked:
                self.acked[who] = f"{self.cluster.world.now:.3f}"
                self._believed[who[0]] += STEPS
            self._last_ack = self.cluster.world.now

    def _departs(self, incarnation: int, answer: str) -> None:
        """The learner answers a replay service that wants to leave."""
        if answer != "farewell" or incarnation != self.serving or self._trainer is None:
            return
        learner = self.cluster.learner
        assert learner is not None
        leaving = self.strangers.process(incarnation)
        if leaving is None or leaving.stop.failed or leaving.stop.reason.startswith("failed"):
            return  # another run's processes have refused it, or its learner
        if learner.stop.is_set() or self._trainer.outcome() or not self._trainer.agent.updates:
            return
        self.hold(
            "departure", self._last_save > self._last_ack, "a replay service leaves with what is in no checkpoint"
        )

    def said(self, process: Process, text: str) -> None:
        """A role has said something."""
        if process is self.cluster.learner and ("saved, " in text or "goes on without it" in text):
            self._last_save = self.cluster.world.now
            self.checkpoints.look_at_parts()

    def service_begins(self, process: Process, core: ReplayCore) -> None:
        """A replay service has restored what it holds."""
        process.state["core"] = core
        folder = process.state["folder"]
        if self._folder not in (None, folder):
            self._forgive = True
        unrecorded = self._core is not None and _lacks_draws(self._core)
        self._folder, self._core = folder, core
        for who, when in list(self.acked.items()):
            if not core._seen.seen(who[0], 0, who[1]):
                if self._forgive:
                    del self.acked[who]
                    self.forgiven += STEPS
                    continue
                text = f"segment {who[1]} of actor {who[0]:x}, acknowledged at {when} s, is not in the restored table"
                self.broken(f"acknowledged: {text}")
        if self._forgive or unrecorded:
            self._draws.clear()
        self._forgive = False
        self.look_at(core)
        self.checkpoints.look()

    def look_at(self, core: ReplayCore, promised: Collection[tuple[int, int]] | None = None) -> None:
        """Look at all that a table holds; promised: segments that must be there, by default those acknowledged."""
        promised = self.acked if promised is None else promised
        table = core.table
        size = len(table)
        accepted = 0
        for stream in core._seen._streams.values():
            accepted += stream.highest + 1 - sum(len(gap) for gap in stream.gaps)
        self.hold("exactly once", table.inserted == STEPS * accepted, f"{table.inserted} of {accepted} segments")
        self.hold("eviction", size == min(table.capacity, table.inserted), f"holds {size} of {table.inserted}")
        if not size:
            return
        rows = np.arange(size)
        columns = table._columns.read(rows)
        numbers, ids = columns["rewards"].astype(np.int64), np.sort(columns["ids"])
        obs, following = table._observations(rows, False)[:, 0], table._observations(rows, True)[:, 0]
        self.hold("content", bool((obs == numbers).all() and (following == numbers + 1).all()), "frames of others")
        self.hold("exactly once", len(set(numbers.tolist())) == size, "a transition twice")
        self.hold("eviction", ids[-1] == table.inserted - 1 and ids[0] == table.inserted - size, "not the newest")
        known = {first + step for first in self._sent.values() for step in range(STEPS)}
        self.hold("content", known.issuperset(numbers.tolist()), "a transition that nobody sent")
        for who in promised:
            self.hold("acknowledged", core._seen.seen(who[0], 0, who[1]), f"segment {who[1]} has disappeared")
        if table.capacity >= table.inserted:
            held = set(numbers.tolist())
            for who in promised:
                self.hold("acknowledged", self._sent[who] in held, f"segment {who[1]} was not evicted, but is gone")

    # ------------------------------------------------------------------------------------------------------------------
    # Draws and updates

    def asked(self, core: ReplayCore, request: DrawRequest) -> None:
        """A learner asks: it will not ask for batches below its base again.

        The ratio is promised for what each core draws and the learner counts. What an earlier core had drawn, but is
        lost with it, is no update: the learner asks for it again.
        """
        if request.incarnation != self._learner or core is not self._counting:
            follows = core._learners[-1:] == [request.incarnation]
            self._learner, self._counting = request.incarnation, core
            self._counted = core.drawn if follows else 0
        self._counted = max(self._counted, request.base)
        self._bases[request.incarnation] = max(self._bases.get(request.incarnation, 0), request.base)

    def drawn(self, core: Any, request: DrawRequest, reply: Reply, known: bool) -> None:  # noqa: ANN401
        """A batch has been drawn, or drawn again."""
        plan = self.cluster.plan
        self._counted = max(self._counted, request.base, request.sequence + 1)
        ids = tuple(reply.batch.columns["ids"].tolist())
        key = request.incarnation, request.sequence
        _, owner = self._owners.setdefault(id(reply), (reply, request.incarnation))
        self.hold("incarnation", owner == request.incarnation, f"draw {request.sequence} was another learner's")
        base = self._bases[request.incarnation]
        if key in self._draws and request.sequence >= base:  # below, a late copy, whose answer nobody awaits
            self.hold("repeated draw", self._draws[key] == ids, f"draw {request.sequence} is another one now")
        if request.sequence >= base:
            self._draws[key] = ids
        if not known and core.table.inserted < plan.total:
            ahead = core.limiter.ahead(core.table.inserted, self._counted)
            slack = max(plan.tolerance, 0.5 / plan.ratio)
            self.hold("ratio", ahead >= -slack - 1e-9, f"draws are {-ahead:.1f} steps ahead")

    def counted(self, core: ReplayCore) -> int:
        """Draws as the present learner counts them; as the core does before the learner has asked it."""
        # A core that was killed while it recorded a draw never answered it; the next one finds it in the journal.
        return self._counted if core is self._counting and self._learner in core._learners[-1:] else core.drawn

    def inserted(self, before: int, ahead: float) -> None:
        """A segment has come in; before: transitions until then. ahead: steps by which acting was ahead then."""
        plan = self.cluster.plan
        slack = max(plan.tolerance, 0.5 / plan.ratio)
        self.hold("ratio", before < plan.starts or ahead <= slack + 1e-9, f"inserted {ahead:.1f} steps ahead")
        self.hold("ratio", before < plan.total, "inserted beyond the run's end")

    def trainer_begins(self, trainer: Trainer) -> None:
        """A learner has made its trainer."""
        self._trainer = trainer

    def trains(self, incarnation: int, agent: Any, batch: Batch, drawn: Drawn) -> None:  # noqa: ANN401
        """A learner is about to train with a batch."""
        number = agent.updates
        self._inserted = max(self._inserted, drawn.inserted)
        self.hold("order", drawn.sequence == number, f"batch {drawn.sequence} in update {number}")
        expected = self._draws.get((incarnation, number))
        same = expected is None or expected == tuple(batch.ids.tolist())
        self.hold("batch", same, f"batch {number} is not the one that was drawn")
        obs, following = batch.frames[batch.obs_index[:, 0], 0], batch.frames[batch.next_index[:, 0], 0]
        self.hold("batch", bool((obs == batch.rewards).all()), "frames of others")
        self.hold("batch", bool((following == batch.rewards + 1).all()), "next frames of others")

    def trained(self, agent: Any, effects: Effects) -> None:  # noqa: ANN401
        """It has."""
        self._note(agent)
        if effects.broadcast:
            self._broadcast(agent)

    def restored(self, agent: Any) -> None:  # noqa: ANN401
        """A learner goes on from a checkpoint."""
        self.hold("checkpoint", _digest(agent) in self._saved[agent.updates], "a state that never was")

    def _note(self, agent: Any) -> None:  # noqa: ANN401
        self._saved[agent.updates].add(_digest(agent))
        for number, network in enumerate(agent.networks):
            self._flats[number, agent.versions[number]].add(network.flat.tobytes())

    def _broadcast(self, agent: Any) -> None:  # noqa: ANN401
        self._roles.append((self.cluster.world.now, agent.acting, (agent.versions[0], agent.versions[1])))

    # ------------------------------------------------------------------------------------------------------------------
    # Weights

    def evaluated(self, folder: Path, row: EvaluationRow) -> None:
        """The learner has recorded an evaluation, whose seconds no other has."""
        if self.strangers.foreign_folder(folder):
            return
        self.hold("evaluation", row.seconds not in self._evaluations, "recorded twice by one learner")
        self._evaluations.add(row.seconds)
        assert self._trainer is not None
        # The learner's count may be lower by now than it was: what nobody has acknowledged may be lost.
        self._inserted = max(self._inserted, self._trainer.drawn.inserted)
        self.hold("evaluation", row.env_step <= self._inserted, f"after {row.env_step} steps")

    def learner_begins(self, process: Process) -> None:
        """A learner's process has begun."""
        self._evaluations.clear()
        self._roles.clear()
        self._began_at = self.cluster.world.now
        self.checkpoints.look()

    def look(self, process: Process, weights: Any, policy: Any) -> None:  # noqa: ANN401
        """An actor has looked for weights: those that it acts with must be whole, and after a while the newest."""
        if self.strangers.foreign(process):
            return
        now, network = self.cluster.world.now, self.cluster.network
        acked = process.state["inserts"].acked
        given = self._believed[process.state["incarnation"]]
        self.hold("acknowledged", acked <= given, f"{process.name} counts {acked} acknowledged, but {given} were")
        if not weights.ready:
            return
        heard = [acting_of(raw) for raw in process.state.pop("roles", ())]
        own = [acting for run, acting in heard if run == process.nodes[0].run]
        told = [*process.state.get("role", [None]), *own]
        # Only the newest broadcast waits to be read: one of another run may have taken the place of its own learner's.
        missed = len(own) < len(heard) or (process.state.get("missed", False) and not own)
        process.state["missed"], process.state["role"] = missed, told if missed else told[-1:]
        self.hold("role", policy.acting in told, f"{process.name} acts with network {policy.acting + 1}")
        for number, each in enumerate(policy.networks):
            held = weights._held[number]
            expected = self._flats.get((number, held))
            if held and expected is not None:
                self.hold("weights", each.flat.tobytes() in expected, f"network {number + 1} is not version {held}")
        learner = self.cluster.learner
        calm = max(network.disturbed, process.since, 0.0 if learner is None else learner.since, self._began_at)
        node = process.nodes[0]
        others = (link.other(node) for link in node.links)
        linked = [other for other in others if other.role == "learner" and not self.strangers.foreign(other.process)]
        weather = network.weather
        if missed or now - calm < STALE or network.cuts or weather.lost or weather.delay > 0.01 or not linked:
            process.state.pop("calm", None)
            return
        if learner is None or learner.frozen or not learner.alive:
            return
        since = process.state.setdefault("calm", now)
        old = [each for each in self._roles if each[0] <= now - STALE]
        if now - since < STALE or not old:
            return
        recent = [old[-1], *(each for each in self._roles if each[0] > now - STALE)]
        acting = {role for _, role, _ in recent}
        self.hold("role", policy.acting in acting, f"{process.name} acts with network {policy.acting + 1}")
        newest = old[-1][2][policy.acting]
        held = weights._held[policy.acting]
        self.hold("role", held >= newest, f"{process.name} acts with version {held}, {newest} was broadcast")

    # ------------------------------------------------------------------------------------------------------------------
    # Ends

    def ended(self, process: Process, reason: str) -> None:
        """A process has ended."""
        expected = not reason or any(words in reason for words in EXPECTED)
        expected |= process.stop.is_set() and ("was not begun" in reason or "no answer to" in reason)
        self.hold("ends", expected, f"{process.name}: {reason}")
        foreign = self.strangers.foreign(process)
        if process.role == "replay" and self.cluster.plan.journal == "off" and not foreign:
            self._forgive = True

    def crashed(self, top: str) -> None:
        """A machine dies."""
        self._draws.clear()
        if self.cluster.plan.journal != "sync":
            self._forgive = True

    def concluded(self, summary: Any) -> None:  # noqa: ANN401
        """The run is complete."""
        plan = self.cluster.plan
        self.hold("end", summary.env_steps >= plan.total, f"complete after {summary.env_steps} steps")
        lost = summary.transitions_lost
        self.hold("end", not lost or self.forgiven > 0, f"{lost} transitions lost")

    def at_the_end(self) -> None:
        """Look at everything once more."""
        if self._core is not None:
            self.look_at(self._core)
        self.checkpoints.look()

    def state_of(self, process: Process) -> str:
        """What a process is about, in words."""
        if not process.alive:
            return "has ended"
        inserts = process.state.get("inserts")
        if inserts is not None:
            return f"has {inserts.acked} acknowledged, {inserts.waiting or 'waits for nothing'}"
        core = process.state.get("core")
        if core is not None:
            return (
                f"holds {core.table.inserted}, has drawn {core.drawn}: {core.inserts_wait_for}; {core.samples_wait_for}"
            )
        return "lives"


def _lacks_draws(core: ReplayCore) -> bool:
    """Whether draws that a core has answered are not in its journal: the disk was full, or failed a flush.

    Inserts wait then; draws do not. Nothing is promised for them: if the process ends, the learner, which asks for
    those that it has not received, gets others.
    """
    journal = core.recorder
    return isinstance(journal, Journal) and (journal._failed is not None or bool(journal._late))


def _digest(agent: Any) -> bytes:  # noqa: ANN401
    return b"".join(network.flat.tobytes() for network in agent.networks) + bytes([agent.acting])
