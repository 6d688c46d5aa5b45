"""`coop-local`: a whole run on this machine, one process a role."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path

from common.config import RunConfig, to_toml
from common.environments import env_spec
from common.errors import RunError, UsageError
from common.lifecycle import Stop, run_main
from common.options import RunOptions, parse_run
from common.processes import ChildProcess, command, free_endpoint
from common.transport import new_incarnation
from deploy.status import Display, RunStatus

TICK = 0.1  # seconds
GRACE = 30.0  # seconds that a role gets for a clean stop
RESTART_PAUSE = 1.0  # seconds
RESTARTS = 20  # of one actor


@dataclass(frozen=True)
class LocalOptions(RunOptions):
    """Flags of `coop-local`."""

    actors: int = 1
    """Actor processes."""
    listen: str | None = None
    """Endpoint of the learner, so that actors elsewhere can join; a free port on loopback if not given."""


class Topology:
    """The processes of one run and what to do when one of them ends.

    Args:
        directory: run directory; the roles' logs go to its logs/.
    """

    def __init__(self, options: LocalOptions, config: RunConfig, directory: Path) -> None:
        logs = directory / "logs"
        try:
            logs.mkdir(parents=True, exist_ok=True)
            resolved = directory / "config.toml"
            resolved.write_text(to_toml(config), encoding="utf-8")
        except OSError as error:
            raise RunError(f"run directory {directory}: {error.strerror or error}") from error
        self.endpoint = options.listen or free_endpoint()
        common = [f"--zenoh-config={options.zenoh_config}"] if options.zenoh_config else []
        common += ["--shared-memory"] if options.shared_memory else []
        joining = [f"--run={config.run}", "--connect", self.endpoint, *common]
        files = [f"--config={resolved}", f"--run-dir={directory}", "--listen", self.endpoint, *common]
        self.learner = ChildProcess("learner", command("coop-learner", *files), logs / "learner.log")
        self._replay = ChildProcess(
            "replay",
            command("coop-replay", *joining, "--listen", free_endpoint(self.endpoint), f"--run-dir={directory}"),
            logs / "replay.log",
        )
        self._actors = [
            ChildProcess(f"actor {number}", command("coop-actor", *joining), logs / f"actor-{number}.log")
            for number in range(1, options.actors + 1)
        ]
        self._restart_at: dict[str, float] = {}
        self._restarts: dict[str, int] = {}

    def start(self) -> None:
        """Start every role."""
        for process in self._all():
            process.start()

    def check(self, display: Display) -> bool:
        """Look after the processes; True once the learner has ended well.

        Raises:
            RunError: learner or replay service died, or an actor dies again and again.
        """
        status = self.learner.exit_status()
        if status is not None:
            if status:
                raise RunError(self.learner.why())
            return True
        if self._replay.exit_status():
            raise RunError(self._replay.why())
        for actor in self._actors:
            if actor.exit_status():
                self._revive(actor, display)
        return False

    def _revive(self, actor: ChildProcess, display: Display) -> None:
        now = time.monotonic()
        if actor.name not in self._restart_at:
            self._restarts[actor.name] = self._restarts.get(actor.name, 0) + 1
            if self._restarts[actor.name] > RESTARTS:
                raise RunError(f"{actor.why()}; it has been restarted {RESTARTS} times")
            display.say(f"{actor.why()}; starting it again")
            self._restart_at[actor.name] = now + RESTART_PAUSE
        elif now >= self._restart_at[actor.name]:
            del self._restart_at[actor.name]
            actor.start()

    def finish(self) -> None:
        """Wait for every role to stop; the others follow the learner."""
        for process in self._all():
            process.end(GRACE)

    def abort(self) -> None:
        """Ask every role to stop, and wait."""
        for process in self._all():
            process.interrupt()
        self.finish()

    def _all(self) -> list[ChildProcess]:
        return [self.learner, self._replay, *self._actors]


def main() -> None:
    """Entry point."""
    run_main("coop-local", _run)


def _run() -> None:
    options = parse_run(LocalOptions, "coop-local", "Run a learner, a replay service and actors on this machine.")
    if options.actors < 1:
        raise UsageError(f"--actors {options.actors}: must be at least 1")
    config = options.run_config()
    env_spec(config.env)  # refuses what can't be played before anything starts
    directory = options.directory()
    stop = Stop()
    stop.on_signals()
    topology = Topology(options, config, directory)
    topology.start()
    status = RunStatus(config.run, topology.endpoint, new_incarnation(), options.zenoh_config)
    title = f"{config.env.id}, {config.method}, seed {config.seed}: {directory}"
    interrupted = False
    try:
        with Display(status) as display:
            display.say(title)
            while not topology.check(display):
                display.update()
                if stop.wait(TICK) and not interrupted:
                    interrupted = True
                    topology.learner.interrupt()
                elif interrupted:
                    time.sleep(TICK)
    except BaseException:
        topology.abort()
        raise
    finally:
        status.close()
    topology.finish()
    print(topology.learner.last_line())
    curve = directory / "learning_curve.png"
    if curve.exists():
        print(f"learning curve: {curve}")
