"""Shows whether the layers of a run's networks distinguish states: `python benchmarks/activity.py RUN_DIR`.

Evaluates the acting network of the newest epoch, and for comparison the same network at the run's beginning, on the
states in the replay service's part of the epoch. Prints, after every ReLU, the share of positive units and the standard
deviation of a unit over states (mean over units); then that of the greatest Q-value, and how often each action is best.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from common.envs.make import env_spec
from common.networks.inputs import preprocess
from common.networks.network import FlatNetwork
from common.process.checkpoints import REPLAY
from common.process.run_ids import read_run_id
from common.process.threads import use_threads
from common.settings.tables import load_tables, resolve
from learner.agent import Agent
from learner.records.epochs import newest_epoch
from replay.core import ReplayCore
from replay.persistence.storage import load_snapshot


def show(network: FlatNetwork, x: Tensor) -> None:
    """Print a line for each ReLU, and one for the output."""
    relus = 0
    for layer in network.module:
        x = layer(x)
        if isinstance(layer, nn.ReLU):
            relus += 1
            units = x.flatten(1)
            active, spread = (units > 0).float().mean(), units.std(0).mean()
            print(f"  ReLU {relus}: {units.shape[1]:,} units, {active:.1%} active, sd over states {spread:.5f}")
    best = np.bincount(x.argmax(1).numpy(), minlength=x.shape[1]).tolist()
    print(f"  Q: mean {x.mean():.4f}, sd of the greatest over states {x.amax(1).std():.5f}; best action: {best}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run_dir", type=Path)
    parser.add_argument("--states", type=int, default=500)
    options = parser.parse_args()
    use_threads(1)
    epoch = newest_epoch(options.run_dir)
    if epoch is None:
        sys.exit(f"{options.run_dir}: no finished epoch")
    config = resolve(load_tables(None, options.run_dir / "config.toml"))
    spec = env_spec(config.env)
    core = ReplayCore(config, spec)
    load_snapshot(core, epoch.path / REPLAY, read_run_id(options.run_dir), epoch.number)
    batch = core.table.sample(options.states)
    fresh, trained = Agent(config, spec), Agent(config, spec)
    trained.load_state(epoch.state["agent"])
    acting = trained.acting
    with torch.inference_mode():
        x = preprocess(torch.from_numpy(batch.frames[batch.obs_index]).view(-1, *spec.obs_shape), spec)
        print(f"{epoch.path}: network {acting + 1} acts")
        show(trained.networks[acting], x)
        print("as the run began")
        show(fresh.networks[acting], x)


if __name__ == "__main__":
    main()
