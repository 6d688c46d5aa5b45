"""Offline learning: a run collects episodes, they become a Minari data set, and another run learns from that alone.

    python examples/offline.py --steps 20000      # in runs/offline; needs the extra minari

Both are runs as any other: coop-watch, coop-report and coop.load read them.
"""

import argparse
from pathlib import Path

import minari
import numpy as np

import coop
from coop.evaluation.dataset import export_to


def main():
    """Collect, export, learn."""
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("--folder", type=Path, default=Path("runs/offline"))
    options.add_argument("--steps", type=int, default=20_000)
    given = options.parse_args()
    folder, steps = given.folder, given.steps

    # A table that holds every step of the run, the oldest first, so that its episodes are whole.
    every_step = {"capacity": steps, "eviction": "fifo"}
    behaviour = coop.train("cartpole", "dqn", total_steps=steps, run_dir=folder / "behaviour", replay=every_step)
    print(behaviour.wait()["return_mean_100"])

    print(export_to(folder / "behaviour", folder / "episodes"))  # coop-export RUN --dataset FOLDER
    episodes = list(minari.MinariDataset(folder / "episodes" / "data").iterate_episodes())
    buffer = coop.load(folder / "behaviour").buffer()
    rewards = np.concatenate([episode.rewards for episode in episodes])
    assert np.array_equal(rewards, buffer.rewards[: len(rewards)]), "the transitions are the same"

    offline = coop.train(
        "cartpole",
        "dqn",
        actors=0,  # nobody acts: the table stays as it is
        total_steps=steps,
        run_dir=folder / "offline",
        replay={"preload": str(folder / "episodes"), "capacity": steps, "eviction": "fifo"},
        eval_every=steps // 4,
    )
    offline.wait()
    print(coop.load(folder / "offline").evaluations[["update", "return_mean"]].to_string(index=False))


if __name__ == "__main__":
    main()
