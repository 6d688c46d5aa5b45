"""TorchRL's DQNLoss, an Adam step and its target updater, on one batch in memory: update_torchrl.py KIND BATCH."""

import sys

import torch
from tensordict import TensorDict
from torchrl.data import OneHot
from torchrl.modules import QValueActor
from torchrl.objectives import DQNLoss, HardUpdate
from turns import attend, rate
from work import KINDS

from coop.common.networks.forward import preprocess
from coop.common.networks.network import build_network, sample_observations

kind, batch_size = sys.argv[1], int(sys.argv[2])
torch.set_num_threads(1)
spec = KINDS[kind][1]
network = build_network(kind, spec, (128, 128, 128), 0)
actor = QValueActor(network, spec=OneHot(spec.num_actions), in_keys=["observation"], action_space="one-hot")
loss = DQNLoss(actor, loss_function="smooth_l1", delay_value=True, double_dqn=False, action_space="one-hot")
loss.make_value_estimator(gamma=0.99)
targets = HardUpdate(loss, value_network_update_interval=10_000)
optimizer = torch.optim.Adam(loss.parameters(), lr=1e-4)
observations = sample_observations(spec, 2 * batch_size).view(2 * batch_size, *spec.input_shape)
column = (batch_size, 1)
actions = torch.nn.functional.one_hot(torch.randint(spec.num_actions, (batch_size,)), spec.num_actions)
batch = TensorDict(
    {
        "observation": observations[:batch_size],
        "action": actions,
        "next": TensorDict(
            {
                "observation": observations[batch_size:],
                "reward": torch.rand(column),
                "done": torch.zeros(column, dtype=torch.bool),
                "terminated": torch.zeros(column, dtype=torch.bool),
            },
            [batch_size],
        ),
    },
    [batch_size],
)


def update() -> None:
    work = batch.clone(recurse=False)
    work["next"] = batch["next"].clone(recurse=False)
    for part in (work, work["next"]):  # bytes to floats, as a transform of its collector does
        part["observation"] = (
            preprocess(part["observation"], spec) if spec.frame_dtype != "float32" else part["observation"]
        )
    loss(work)["loss"].backward()
    optimizer.step()
    optimizer.zero_grad()
    targets.step()


attend(lambda seconds: {"updates/s": rate(update, seconds)})
