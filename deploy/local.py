"""`coop-local`: a whole run on this machine, one process per role."""

from __future__ import annotations

import socket
import time
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path

from coop.common.envs.make import check_filmed, env_spec
from coop.common.errors import RunError, UsageError
from coop.common.messaging.transport import new_incarnation
from coop.common.places import absolute, shown
from coop.common.process.console import say, stamped
from coop.common.process.files import make_folder, write_atomic
from coop.common.process.flags import HttpAddress
from coop.common.process.lifecycle import Stop, run_main
from coop.common.process.limits import MIB, check_processes
from coop.common.process.ports import check_can_listen, check_loopback
from coop.common.process.processes import ChildProcess, command, reserve_endpoint
from coop.common.settings.capacity import check_memory, check_messages
from coop.common.settings.config import RunConfig, check_distributed
from coop.common.settings.resuming import settings_digest
from coop.common.settings.tables import to_toml
from coop.deploy.supervisor import RestartPolicy
from coop.monitor.watch import Display, Page, RunStatus, live_page
from coop.records.datasets import check_data_set
from coop.records.growing import Evaluations
from coop.records.locks import RunLock
from coop.records.run_options import LearnerRunOptions, parse_run

TICK = 0.1  # seconds
GRACE = 30.0  # seconds for a role's clean stop
LAST_WORDS = 5.0  # seconds for the news that the run is over, which has reached another role
JOIN_TIMEOUT = 3600.0  # seconds; this process notices the learner's end itself, and a busy machine may start it slowly
ACTOR_BYTES = 32 * MIB  # the least that an actor process takes


@dataclass(frozen=True)
class LocalOptions(LearnerRunOptions):
    """Flags of `coop-local`."""

    actors: int = 1
    """Actor processes; 0 with --listen, for actors that all run elsewhere, or to learn from --replay.preload alone."""
    listen: str | None = None
    """Endpoint of the learner, for actors on other machines; a free port on loopback if not given."""
    web: HttpAddress = ""
    """Show the run's screen as a web page too: PORT, on loopback, or HOST:PORT."""


class Topology:
    """The processes of one run, restarted when they are killed.

    Args:
        directory: run directory, with the roles' logs in logs/.
        locks: descriptors of its locks, which learner and replay service hold too.
    """

    def __init__(self, options: LocalOptions, config: RunConfig, directory: Path, locks: tuple[int, ...]) -> None:
        logs = directory / "logs"
        try:
            make_folder(logs)
            resolved = logs / "config.toml"  # the run's own is the learner's to write
            write_atomic(resolved, to_toml(config).encode())
        except OSError as error:
            raise RunError(f"run directory {directory}: {error.strerror or error}") from error
        self._ports: list[socket.socket] = []
        self.endpoint = options.listen or self._reserve()
        common = [f"--zenoh-config={options.zenoh_config}"] if options.zenoh_config else []
        common += ["--shared-memory"] if options.shared_memory else []
        joining = [f"--run={config.run}", "--connect", self.endpoint, f"--join-timeout={JOIN_TIMEOUT}", *common]
        # --resume also at the first start, so that a restarted role continues from the newest checkpoint.
        files = [f"--run-dir={directory}", "--resume", *common]
        learning = [f"--config={resolved}", "--listen", self.endpoint, *files]
        learning += [f"--log={options.log}", *(["--restart"] if options.restart else [])]
        modules = [path.partition(":")[0] for path in config.imports.values()]
        learning += ["--allow-import", *modules] if modules else []
        learning += [f"--prometheus={options.prometheus}"] if options.prometheus else []
        self.learner = ChildProcess("learner", command("coop-learner", *learning), logs / "learner.log", locks)
        playing = [*joining, "--allow-import", *modules] if modules else joining
        serving = [*playing, "--listen", self._reserve(self.endpoint), f"--run-dir={directory}", "--resume"]
        self._others = [ChildProcess("replay", command("coop-replay", *serving), logs / "replay.log", locks)]
        self._others += [
            ChildProcess(f"actor process {number}", command("coop-actor", *playing), logs / f"actor-{number}.log")
            for number in range(1, 1 + (0 if config.replay.offline else options.actors))
        ]
        if config.eval_every or config.video_every:
            evaluating = command("coop-eval", *playing)
            self._others.append(ChildProcess("evaluator", evaluating, logs / "evaluator.log"))
        self._policies = {process.name: RestartPolicy() for process in self._all()}
        self._given_up: set[ChildProcess] = set()
        self._left_at: dict[ChildProcess, float] = {}  # when a process was found that has ended with status 0
        self._interrupted = False

    def start(self) -> None:
        """Start every role."""
        for process in self._all():
            process.start()

    def check(self, display: Display) -> bool:
        """Restart killed roles; return True once the learner has ended properly or by a signal.

        Raises:
            RunError: a role failed by itself, an actor twice in the same way; or was killed too often.
            UsageError: a role rejected the config.
        """
        status = self.learner.exit_status()  # once: it may end while this looks at the others
        if status == 0 or self.learner.was_interrupted():
            return True
        for process in self._all():
            if process.exit_status() is not None and not self._interrupted and process not in self._given_up:
                self._restart(process, display)
        if self._interrupted and status is not None:
            raise RunError(f"{self.learner.why()}; interrupted before it was back, --resume goes on")
        return False

    def interrupt(self) -> None:
        """Ask the learner to stop cleanly; the other roles follow it, and none is restarted."""
        self._interrupted = True
        self.learner.interrupt()

    def _restart(self, process: ChildProcess, display: Display) -> None:
        """Start an ended process again when it is time, or give up: it, if the run can do without it, or the run."""
        policy, now = self._policies[process.name], time.monotonic()
        if policy.at is not None:
            if policy.due(now):
                process.start()
            return
        status = process.exit_status() or 0
        if status == 0:  # a stop may have reached it sooner than this process, and the learner follows
            waited = now - self._left_at.setdefault(process, now)
            if waited < (GRACE if display.run_is_over else LAST_WORDS):
                return
            del self._left_at[process]
        in_vain = policy.ended(now, process.own_words(), for_memory=process.was_killed_for_memory())
        at_once = status == UsageError.exit_status or (status > 0 and process.name in ("learner", "replay"))
        if not in_vain and not (at_once and process.own_words()):
            display.say(stamped(f"{process.why()}; starting it again"))
        elif process.name == "evaluator":
            self._given_up.add(process)
            display.say(stamped(f"{process.why()}; the run goes on without it"))
        else:
            failure = UsageError if status == UsageError.exit_status else RunError
            raise failure("; ".join(filter(None, (process.why(), in_vain))))

    def finish(self) -> None:
        """Wait for every role to stop; the other roles follow the learner."""
        for process in self._all():
            process.end(GRACE)

    def abort(self) -> None:
        """Ask every role to stop, and wait."""
        for process in self._all():
            process.interrupt()
        self.finish()

    def close(self) -> None:
        """Give the ports back."""
        for port in self._ports:
            port.close()

    def _all(self) -> list[ChildProcess]:
        return [self.learner, *self._others]

    def _reserve(self, like: str = "") -> str:
        """A free endpoint that nobody else gets before its role listens there, or while that is started again."""
        endpoint, port = reserve_endpoint(like)
        self._ports.append(port)
        return endpoint


def main() -> None:
    """Entry point."""
    run_main("coop-local", _run)


def _run() -> None:
    options = parse_run(LocalOptions, "coop-local", "Run a learner, a replay service and actors on this machine.")
    if options.actors == 0 and options.replay.preload and not options.listen:
        options = replace(options, replay=replace(options.replay, offline=True))
    if options.actors < (0 if options.listen or options.replay.offline else 1):
        raise UsageError(f"--actors {options.actors}: must be at least 1, or 0 with --listen or --replay.preload")
    check_processes("--actors", options.actors, ACTOR_BYTES)
    config = options.run_config()
    check_distributed(config)
    check_loopback()
    spec = env_spec(config.env)  # refuses invalid environments before anything starts
    check_memory(config, spec)
    check_messages(config, spec)
    if (given := config.replay.preload) and not options.start.goes_on:
        check_data_set(absolute(given, "replay.preload"), spec, f"replay.preload = {given!r}")
    if config.video_every:
        check_filmed(config.env)
    directory = options.directory()
    stop = Stop()
    stop.on_signals()
    with live_page(config.run, options.web) as page:
        if options.prometheus:
            check_can_listen("--prometheus", options.prometheus)
        with RunLock(directory, "coop-local", ("learner", "replay")) as lock:
            # Before anything is written; what the roles find, they find by the same code.
            _, notices = options.start.prepare(directory, replay=not options.restart, settings=settings_digest(config))
            for line in (*notices, options.settings):
                say(line)
            lock.sign()
            with closing(Topology(options, config, directory, lock.descriptors)) as topology:
                _supervise(topology, options, config, directory, stop, page)


def _supervise(
    topology: Topology, options: LocalOptions, config: RunConfig, directory: Path, stop: Stop, page: Page | None
) -> None:
    """Run the processes to the end of the run."""
    evaluations = Evaluations(directory)
    title = f"{config.env.id}, {config.method}, seed {config.seed}: {shown(directory)}"
    interrupted = False
    try:
        topology.start()
        status = RunStatus(
            config.run, topology.endpoint, new_incarnation(), options.zenoh_config, evaluations=evaluations.points
        )
        with closing(status), Display(status, page) as display:
            display.say(title)
            while not topology.check(display):
                display.update()
                if stop.wait(TICK) and not interrupted:
                    interrupted = True
                    topology.interrupt()
                elif interrupted:
                    time.sleep(TICK)
    except BaseException:
        topology.abort()
        raise
    if topology.learner.was_interrupted():
        topology.abort()
        say(f"{topology.learner.last_line()}; coop-local --resume --run-dir {shown(directory)} goes on")
        stop.raise_for_status()
        raise RunError(topology.learner.why())  # the learner alone was interrupted
    topology.finish()
    say(topology.learner.last_line())
    curve = directory / "learning_curve.png"
    if curve.exists():
        say(f"learning curve: {shown(curve)}")
