"""Numbers next to 0, with which products take long, do not stay in what a learner computes with."""

from pathlib import Path

import numpy as np
import pytest
from commands import run_command

from experiments.reexecute import reexecute
from learner.records.epochs import load_learner, newest_epoch

TINY = np.finfo(np.float32).tiny
# At this rate the ReLUs of a hidden layer are soon off for every state, and its moments fall by half at each update.
FLAGS = ("--learner.learning-rate", "1", "--learner.beta1", "0.5", "--learner.beta2", "0.5")
SHORT = ("--learner.optimizer", "adam", "--total-steps", "600", "--replay.learning-starts", "100")


@pytest.mark.parametrize("command", [("coop-lockstep",), ("coop-local", "--actors", "1", "--replay.journal")])
def test_moments_of_parameters_without_a_gradient_become_0(command: tuple[str, ...], tmp_path: Path) -> None:
    path = tmp_path / "run"
    run_command(*command, *FLAGS, *SHORT, "--run-dir", path, check=True)
    epoch = newest_epoch(path)
    assert epoch is not None
    for optimizer in load_learner(epoch)["agent"]["optimizers"]:
        for name in ("mean", "square"):
            moments = np.abs(optimizer[name].numpy().astype(np.float64))
            assert (moments == 0).any()
            assert not ((moments > 0) & (moments < TINY)).any()
    if "--replay.journal" in command:
        assert reexecute(path).updates == 500
        assert np.float32(TINY) * np.float32(0.5) > 0, "this thread's arithmetic is as it was"
