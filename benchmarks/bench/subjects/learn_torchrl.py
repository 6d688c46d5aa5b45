"""One run of DQN by TorchRL to a mean return: learn_torchrl.py TASK SEED. Prints [steps, solved].

Collector, buffer, loss and target updater are TorchRL's, with the settings that Stable-Baselines3 has.
"""

from __future__ import annotations

import json
import sys
import warnings
from collections import deque

import gymnasium
import torch
from learn import TASKS
from learn_sb3 import ENVS, SETTINGS, Pictures
from tensordict.nn import TensorDictSequential
from torch import nn
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import Compose, DTypeCastTransform, GymWrapper, RewardSum, TransformedEnv
from torchrl.envs.transforms import MultiStepTransform
from torchrl.modules import EGreedyModule, QValueActor
from torchrl.objectives import DQNLoss, HardUpdate
from work import KINDS

from coop.common.networks.network import build_network

warnings.simplefilter("ignore")


class Single(nn.Module):
    """A network that also takes one picture, as its collector gives it."""

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network = network

    def forward(self, pictures: torch.Tensor) -> torch.Tensor:
        return self.network(pictures) if pictures.ndim == 4 else self.network(pictures[None])[0]


def main(task: str, seed: int) -> None:
    mean, most = TASKS[task]
    settings = SETTINGS[task]
    torch.set_num_threads(1)
    torch.set_flush_denormal(True)
    torch.manual_seed(seed)
    inner = gymnasium.make(ENVS[task])
    pictures = task.startswith("minatar")
    base = GymWrapper(Pictures(inner) if pictures else inner)
    base.set_seed(seed)
    cast = [DTypeCastTransform(torch.uint8, torch.float32, in_keys=["observation"])] if pictures else []
    env = TransformedEnv(base, Compose(*cast, RewardSum()))
    if pictures:
        network: nn.Module = Single(build_network("minatar", KINDS["minatar"][1], (), seed))
    else:
        layers = [nn.Linear(4, 256), nn.ReLU(), nn.Linear(256, 256), nn.ReLU(), nn.Linear(256, 2)]
        network = nn.Sequential(*layers)
    actor = QValueActor(network, spec=env.action_spec, in_keys=["observation"])
    explore = EGreedyModule(
        env.action_spec,
        eps_init=1.0,
        eps_end=settings["exploration_final_eps"],
        annealing_num_steps=int(settings["exploration_fraction"] * most),
    )
    loss = DQNLoss(actor, loss_function="smooth_l1", delay_value=True, double_dqn=False)
    loss.make_value_estimator(gamma=settings["gamma"])
    frames, each = max(8, settings["train_freq"]), settings["gradient_steps"]
    updates = frames * each // settings["train_freq"]
    # Between its trainings Stable-Baselines3 copies targets by steps; here the period counts updates.
    period = max(each, settings["target_update_interval"] * each // settings["train_freq"])
    targets = HardUpdate(loss, value_network_update_interval=period)
    optimizer = torch.optim.Adam(loss.parameters(), lr=settings["learning_rate"])
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(settings["buffer_size"]), batch_size=settings["batch_size"]
    )
    if (n_steps := settings.get("n_steps", 1)) > 1:
        # By default it takes `terminated` from a return's first step, and bootstraps behind ends in the later ones.
        buffer.append_transform(MultiStepTransform(n_steps, settings["gamma"], done_keys=[]))
    collector = Collector(
        env,
        TensorDictSequential(actor, explore),
        frames_per_batch=frames,
        total_frames=most,
    )
    returns: deque[float] = deque(maxlen=100)
    steps, solved = 0, False
    for data in collector:
        steps += data.numel()
        explore.step(data.numel())
        buffer.extend(data)
        ended = data["next", "done"]
        returns.extend(data["next", "episode_reward"][ended].tolist())
        solved = len(returns) == 100 and sum(returns) / 100 >= mean
        if solved:
            break
        if steps < settings["learning_starts"]:
            continue
        for _ in range(updates):
            loss(buffer.sample())["loss"].backward()
            optimizer.step()
            optimizer.zero_grad()
            targets.step()
    collector.shutdown()
    print(json.dumps([steps, solved]))


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]))
