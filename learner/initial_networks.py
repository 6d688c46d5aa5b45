"""The networks with which a run begins, if they are those of another run."""

from __future__ import annotations

from coop.common.errors import UsageError
from coop.common.places import absolute
from coop.common.process.untrusted import check_links
from coop.learner.protocol import AnyAgent
from coop.records.learner_checkpoints import fitting, newest_checkpoint


def load_initial_networks(agent: AnyAgent) -> None:
    """Give a new run's agent the networks of the run `learner.initial_networks`; leave it as it is if that is empty.

    Raises:
        UsageError: the folder holds no complete checkpoint, or networks of another size.
    """
    folder = agent.config.learner.initial_networks
    if not folder:
        return
    path = absolute(folder, "learner.initial_networks")
    check_links(path)
    setting, checkpoint = f"learner.initial_networks = {folder!r}", newest_checkpoint(path)
    if checkpoint is None:
        raise UsageError(f"{setting}: holds no complete checkpoint of a run")
    with fitting(checkpoint.path):
        networks, size = checkpoint.state["agent"]["networks"], agent.networks[0].size
        if networks[0].numel() != size:
            own = networks[0].numel()
            raise UsageError(f"{setting}: its networks have {own:,} parameters; this run's have {size:,}")
        agent.load_state({**agent.state(), "networks": networks})
