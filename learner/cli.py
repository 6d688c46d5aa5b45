"""`coop-learner`: the learner of a run, which all other roles join."""

from __future__ import annotations

from dataclasses import dataclass

from coop.common.envs.make import env_spec
from coop.common.errors import UsageError
from coop.common.imports import importing
from coop.common.process.lifecycle import run_main
from coop.common.process.ports import check_can_listen
from coop.common.settings.capacity import check_messages
from coop.common.settings.config import check_distributed
from coop.common.settings.options import HealthOptions
from coop.records.run_options import LearnerRunOptions, parse_run


@dataclass(frozen=True)
class LearnerOptions(LearnerRunOptions, HealthOptions):
    """Flags of `coop-learner`."""

    listen: tuple[str, ...] = ("tcp/127.0.0.1:7447",)
    """Endpoints to listen on; tcp/0.0.0.0:7447 opens the run to other machines."""


def main() -> None:
    """Entry point."""
    run_main("coop-learner", _run)


def _run() -> None:
    options = parse_run(
        LearnerOptions, "coop-learner", "Train the networks of a run; the other roles join it through this process."
    )
    if options.restart and not options.resume:
        raise UsageError("--restart: needs --resume; it applies where that finds no checkpoint to continue from")
    for flag, address in (("--prometheus", options.prometheus), ("--health", options.health)):
        if address:
            check_can_listen(flag, address)
    config = options.run_config()
    check_distributed(config)
    spec = env_spec(config.env)
    check_messages(config, spec)
    with importing():
        from coop.learner.process import learn  # noqa: PLC0415 (torch takes seconds; wrong flags should not)

    learn(options, config, spec)
