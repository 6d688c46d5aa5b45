"""One simulated run: its processes, who starts them again, its faults, and its end."""

from __future__ import annotations

import contextlib
import os
import random
import shutil
from collections import Counter
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

import msgspec

from benchmarks.simulate import quick, roles
from benchmarks.simulate.agent import NoDiagnostics, Plain
from benchmarks.simulate.checks import Checks
from benchmarks.simulate.disk import Disk
from benchmarks.simulate.network import Network, Weather
from benchmarks.simulate.plan import Fault, Plan
from benchmarks.simulate.watched import watched, watched_trainer
from benchmarks.simulate.world import Machine, Process, Violation, World
from coop.common.errors import RunError
from coop.common.settings.config import ActorSettings, LearnerSettings, ReplaySettings, RunConfig
from coop.common.settings.tables import to_tables
from coop.learner.trainer import Trainer

ENDS_WITHIN = 240.0  # seconds after the last fault: a lost acknowledgement alone takes a minute to be missed
LEAVES_WITHIN = 90.0  # seconds that other roles may take once the run is complete: their patience is 60
DESCRIPTORS = Path("/proc/self/fd")
DRIFT = 5e-5  # clocks of two machines differ by a ten-thousandth at most


class Cluster:
    """A learner, a replay service, two actors and an evaluator, on machines of their own.

    Attributes:
        complete: the learner has said that the run is complete. met: faults by kind.
    """

    def __init__(self, seed: int, plan: Plan, root: Path) -> None:
        self.plan = plan
        self.root = root
        self.world = World(seed)
        self.network = Network(self.world)
        self.disk = Disk(self.world, root, {fault.target for fault in plan.faults if fault.kind == "crash"})
        self.config = make_config(plan)
        self._tables = msgspec.msgpack.decode(msgspec.msgpack.encode(to_tables(self.config)))
        self.complete = False
        self.met: Counter[str] = Counter()
        self.slow: dict[str, float] = {}
        self.roles: dict[str, Process] = {}
        self.learner: Process | None = None  # of this run, the last one that has got its folder
        self._heads = [roles.LEARNER, *[roles.STRANGER] * plan.strangers]  # endpoints that the others know
        self.locks: dict[Path, Process] = {}
        self._numbers = random.Random(f"ids {seed}")
        self._actors = 0
        self._services = 0
        drift = [self.world.random.uniform(-DRIFT, DRIFT) for _ in range(4)]
        self.machines = {
            name: Machine(self.world, name, 1 + rate, 1000.0 * index)
            for index, (name, rate) in enumerate(zip(("learner", "replay", "actors", "elsewhere"), drift, strict=True))
        }
        self.checks = Checks(self)
        self.world.said = self.checks.said
        self.world.disk_delay = self._disk_delay

    def _disk_delay(self, process: Process) -> float:
        return self.world.random.random() ** 3 * self.slow.get(process.machine.name, 0.004)

    def incarnation(self) -> int:
        """A random id."""
        return self._numbers.getrandbits(63)

    def run(self) -> None:
        """Run to the end; raises Violation."""
        if self.root.exists():
            shutil.rmtree(self.root)
        for name in ("learner", "replay", "elsewhere"):
            (self.root / name).mkdir(parents=True)
            self.disk.adopt(name)
        before = set(DESCRIPTORS.iterdir())
        try:
            with self._product(), self.disk.installed():
                names = ["learner", "replay", "actor 0", "actor 1"][: 2 + self.plan.actors]
                for index, name in enumerate([*names, "evaluator"][: len(names) + self.plan.evaluator]):
                    self.world.after(0.01 * index, partial(self.begin, name))
                for fault in self.plan.faults:
                    self.world.at(fault.at, partial(self._meet, fault))
                self._to_the_end()
        finally:
            self._clear(before)

    def _to_the_end(self) -> None:
        last = max((fault.at + fault.length for fault in self.plan.faults), default=0.0)
        world = self.world
        if not world.run(lambda: self.complete, last + ENDS_WITHIN):
            raise Violation(f"the run is not complete {ENDS_WITHIN:g} s after the last fault: {self._waiting()}")
        self.checks.at_the_end()
        left = max(world.now, last) + LEAVES_WITHIN
        if not world.run(lambda: not any(process.alive for process in world.processes), left):
            there = ", ".join(process.name for process in world.processes if process.alive)
            if there:
                raise Violation(f"{LEAVES_WITHIN:g} s after the run's end there still is {there}")

    def _waiting(self) -> str:
        return "; ".join(f"{process.name} {self.checks.state_of(process)}" for process in self.roles.values())

    # ------------------------------------------------------------------------------------------------------------------

    def begin(self, name: str, place: str = "") -> None:
        """Start a role's process; `place`: another folder than usual, for a second replay service or learner."""
        present = self.roles.get(name)
        if self.complete or (present is not None and present.alive):
            return
        role = name.split(" ", maxsplit=1)[0]
        machine = self.machines[place or {"learner": "learner", "replay": "replay"}.get(role, "actors")]
        process = Process(self.world, name, role, machine)
        self.roles[name] = process
        process.on_end = partial(self._ended, name, process)
        incarnation = self.incarnation()
        process.state["incarnation"] = incarnation
        self.checks.strangers.begins(process, stranger=role == "learner" and bool(place))
        self.world.tell(name, "starts, incarnation", f"{incarnation:x}")
        process.do(lambda: self._hold(process, role, incarnation, place or machine.name))

    def _hold(self, process: Process, role: str, incarnation: int, place: str) -> None:
        network, plan, heads = self.network, self.plan, self._heads
        if role == "learner":
            own = place == "learner"
            path = self.root / place / ("run" if own else process.name)
            at = roles.LEARNER if own else roles.STRANGER
            kind = watched_trainer(self.checks, incarnation) if own else Trainer
            lock = partial(self._locked, process, path)
            conversation: Any = roles.learner(network, process, self.config, path, at, lock, kind, incarnation)
        elif role == "replay":
            self._services += 1
            at, path = f"tcp/replay:{self._services}", self.root / place / "table"
            process.state["folder"] = path
            conversation = roles.replay(network, process, path, at, heads, incarnation)
        elif role == "actor":
            number, self._actors = self._actors, self._actors + 1
            look, sent = self.checks.look, self.checks.sent
            conversation = roles.actor(
                network, process, heads, number, incarnation, plan.every, plan.window, look, sent
            )
        else:
            conversation = roles.evaluator(network, process, heads, incarnation, 0.5)
        activity = process.start(role, conversation, process.stop)
        activity.on_result = lambda result: self._done(process, result)

    def _locked(self, process: Process, path: Path) -> _Lock:
        """The lock of a learner's folder."""
        lock = _Lock(self, path, process.name, ("learner",))
        self.checks.strangers.took(process, path)
        if not self.checks.strangers.foreign(process):
            self.learner = process
            self.checks.learner_begins(process)
        return lock

    def _done(self, process: Process, result: Any) -> None:  # noqa: ANN401
        if process is self.learner and result is not None:
            self.world.tell("learner", "concludes:", result.exit)
            if result.exit.startswith("complete"):
                self.checks.concluded(result)
                self.complete = True
        process.end("" if not process.stop.failed else process.stop.reason)

    def _ended(self, name: str, process: Process, reason: str) -> None:
        self.disk.deadly.pop(name, None)
        self.checks.ended(process, reason)
        if not self.complete and " second " not in name:
            # A run goes on from the newest checkpoint that both hold. If its part is elsewhere, the service here is
            # refused by a line that names what is missing, and whoever runs it starts one there.
            refused = "no checkpoint to resume from" in reason and name == "replay"
            place = self.checks.checkpoints.place_of_part() if refused else ""
            self.world.after(self.world.random.uniform(0.25, 2.0), partial(self.begin, name, place))

    # ------------------------------------------------------------------------------------------------------------------

    def _meet(self, fault: Fault) -> None:
        """Let a fault happen."""
        if self.complete:
            return
        self.met[fault.kind] += 1
        self.world.tell("FAULT:", str(fault).split("s  ", 1)[1])
        getattr(self, f"_{fault.kind.replace(' ', '_')}")(fault)

    def _present(self, fault: Fault) -> Process | None:
        """The process that a fault is meant for, if it is there and not frozen."""
        process = self.roles.get(fault.target)
        return process if process is not None and process.alive and not process.frozen else None

    def _kill(self, fault: Fault) -> None:
        process = self.roles.get(fault.target)
        if process is not None:
            process.end("killed")

    def _freeze(self, fault: Fault) -> None:
        if (process := self._present(fault)) is not None:
            process.freeze()
            self.network.watch()
            self.world.after(fault.length, partial(self._thaw, process))

    def _stop(self, fault: Fault) -> None:
        if (process := self._present(fault)) is not None:
            process.do(lambda: process.stop.set("interrupted", exit_status=143))

    def _deadly(self, fault: Fault) -> None:
        self.disk.deadly[fault.target] = int(fault.number)

    def _cut(self, fault: Fault) -> None:
        ways = [(fault.target, fault.other), (fault.other, fault.target)]
        for one, two in ways[: 1 + (fault.kind == "partition")]:
            self.network.cut(one, two)
            self.world.after(fault.length, partial(self.network.heal, one, two))

    _partition = _cut

    def _weather(self, fault: Fault) -> None:
        worse = {"late": (fault.number, 0, 0), "lost": (0.05, 0.25, 0), "doubled": (fault.number, 0, 0.4)}
        self.network.weather = Weather(*worse.get(fault.target, (fault.number, 0.15, 0.2)))
        self.world.after(fault.length, self._clear_up)

    def _full(self, fault: Fault) -> None:
        self.disk.full.add(fault.target)
        self.world.after(fault.length, lambda: self.disk.full.discard(fault.target))

    def _bad_flush(self, fault: Fault) -> None:
        self.disk.failing.add(fault.target)

    def _slow(self, fault: Fault) -> None:
        self.slow[fault.target] = fault.number
        self.world.after(fault.length, lambda: self.slow.pop(fault.target, None))

    def _leap(self, fault: Fault) -> None:
        self.machines[fault.target].leap(fault.number)

    def _second(self, fault: Fault) -> None:
        place = "elsewhere" if fault.other == "elsewhere" else "replay"
        self.begin(f"replay second {self.met['second']}", place)

    def _second_learner(self, fault: Fault) -> None:
        name = f"learner second {self.met[fault.kind]}"
        elsewhere = fault.other == "elsewhere"
        self.begin(name, "elsewhere" if elsewhere else "")
        if elsewhere:  # while it is there, restarted roles may join its run for good
            self.world.after(fault.length, partial(self._end_second, name, told=bool(fault.number)))

    def _end_second(self, name: str, *, told: bool) -> None:
        process = self.roles[name]
        if told:
            process.do(lambda: process.stop.set("interrupted", exit_status=143))
        else:
            process.end("killed")

    def _second_actor(self, fault: Fault) -> None:
        self.begin(f"actor {2 + self.met[fault.kind]}")

    def _thaw(self, process: Process) -> None:
        self.network.disturbed = self.world.now
        if process.alive:
            process.thaw()
        else:
            process.frozen = False

    def _clear_up(self) -> None:
        self.network.weather = Weather()
        self.network.disturbed = self.world.now

    def _crash(self, fault: Fault) -> None:
        top, machine = fault.target, self.machines[fault.target]
        self.checks.crashed(top)
        for process in list(self.world.processes):
            if process.machine is machine:
                process.end("its machine has died")
        self.disk.crash(top, self.world.random)

    # ------------------------------------------------------------------------------------------------------------------

    @contextlib.contextmanager
    def _product(self) -> Iterator[None]:
        """Hand the product what it takes from the system: random ids, locks, and what has no part in the protocol."""
        checks, ids = self.checks, self._numbers
        kinds = watched(checks)
        with contextlib.ExitStack() as stack:
            quick.install(stack)
            replace = partial(quick.replace, stack)
            replace("coop.replay.cli.ReplayCore", kinds.core)
            replace("coop.replay.cli.ReplayService", kinds.service)
            replace("coop.learner.process.Roster", kinds.roster)
            replace("coop.learner.process.RunDirectory", partial(roles.Directory, checks.evaluated))
            replace("coop.learner.process.claim_run_directory", partial(roles.claim_directory, ids))
            replace("coop.learner.process.load_initial_networks", lambda agent: None)
            replace("coop.learner.trainer.METRICS_EVERY", 1 << 40)
            replace("coop.replay.core.check_memory", lambda config, spec: None)
            replace("coop.replay.service.new_incarnation", self.incarnation)
            replace("coop.records.learner_checkpoints.torch", Plain)
            replace("coop.records.learner_checkpoints.check_torch_file", lambda path: None)
            replace("coop.learner.telemetry.Diagnostics", NoDiagnostics)
            replace("coop.replay.persistence.folder.RunLock", partial(_Lock, self))
            replace(
                "coop.common.process.files.secrets",
                SimpleNamespace(token_hex=lambda n: f"{ids.getrandbits(8 * n):0{2 * n}x}"),
            )
            replace("coop.common.messaging.members.os", SimpleNamespace(getpid=lambda: self._present_process().number))
            where = SimpleNamespace(gethostname=lambda: self._present_process().machine.name)
            replace("coop.common.messaging.members.socket", where)
            replace("coop.common.process.files.time", SimpleNamespace(strftime=lambda form: "moved"))
            # All have the same settings, which take long to send, read and compare.
            replace("coop.learner.join_service.to_tables", lambda config: self._tables)
            replace("coop.common.messaging.messages.control.validated", self._read)
            replace("coop.common.messaging.messages.control._modules", lambda tables: ())
            replace("coop.common.messaging.joining.identity", lambda config: {})
            replace("benchmarks.simulate.node.SimNode.on_reply", staticmethod(checks.on_reply))
            replace("benchmarks.simulate.node.SimNode.on_heard", staticmethod(checks.strangers.heard))
            yield

    def _read(self, tables: dict[str, Any]) -> RunConfig:
        """The settings that a message holds."""
        if tables != self._tables:
            raise Violation("a message holds other settings")
        return self.config

    def _present_process(self) -> Process:
        assert self.world.running is not None
        return self.world.running

    def _clear(self, before: set[Path]) -> None:
        """End what is left of dead processes, whose files and conversations nothing else closes."""
        with self.disk.installed(), patch("sys.unraisablehook", lambda *_: None):
            for process in self.world.processes:
                process.alive = False
                self.world.running = process
                for activity in process.activities:
                    activity.abandon()
        for descriptor in set(DESCRIPTORS.iterdir()) - before:
            with contextlib.suppress(OSError):
                if descriptor.readlink().is_relative_to(self.root):
                    os.close(int(descriptor.name))
        shutil.rmtree(self.root, ignore_errors=True)


class _Lock:
    """A lock of a folder: the kernel frees it when its process ends."""

    def __init__(self, cluster: Cluster, path: Path, program: str, parts: tuple[str, ...]) -> None:
        running = cluster.world.running
        assert running is not None
        holder = cluster.locks.get(path)
        if holder is not None and holder.alive and holder is not running:
            raise RunError(f"{path}: {holder.name} uses it")
        cluster.locks[path] = running
        self._release = lambda: cluster.locks.pop(path, None)

    def sign(self) -> None:
        """Nobody reads the name."""

    def release(self) -> None:
        """Free it."""
        self._release()

    def __enter__(self) -> _Lock:
        return self

    def __exit__(self, *_: object) -> None:
        self.release()


def make_config(plan: Plan) -> RunConfig:
    """The settings of a run."""
    return RunConfig(
        run="run",
        total_steps=plan.total,
        checkpoint_every=plan.checkpoint,
        actor=ActorSettings(segment_steps=roles.STEPS),
        learner=LearnerSettings(
            batch_size=plan.batch,
            prefetch=plan.prefetch,
            swap_every=plan.swap,
            publish_every=plan.publish,
            mirror=plan.mirror,
        ),
        replay=ReplaySettings(
            capacity=plan.capacity,
            ratio=plan.ratio,
            tolerance=plan.tolerance,
            learning_starts=plan.starts,
            journal=plan.journal,
            sampling=plan.sampling,
        ),
    )
