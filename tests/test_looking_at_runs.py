"""`coop-eval` plays a checkpoint greedily; `coop-watch` follows a run that it has no part in, to its end."""

import re
import signal
import socket
import subprocess
import sysconfig
import time
from pathlib import Path

import pytest
import torch

from common.settings.sources import base_config
from experiments import evaluation_cli
from experiments.evaluation import evaluate_checkpoint
from experiments.lockstep import Lockstep
from learner.records.run_directory import RunDirectory

SCRIPTS = Path(sysconfig.get_path("scripts"))


def run_with(path: Path, acting: int, action: int) -> None:
    """A run directory whose network `acting` always prefers `action`, and whose other one the other action."""
    run = Lockstep(base_config(["--method", "coop"]))
    with RunDirectory(path, run.config) as directory:
        for _ in range(40):
            for effects in run.play():
                directory.record(effects.episodes, effects.metrics)
        run.agent.acting = acting
        for number, network in enumerate(run.agent.networks):
            flat = torch.zeros_like(network.flat)
            flat[-2 + (action if number == acting else 1 - action)] = 1.0  # the last two are the output's biases
            network.load(flat)
        run.save(directory)
    run.env.close()


@pytest.mark.parametrize(("acting", "action"), [(0, 1), (1, 0)])
def test_the_acting_network_plays_its_best_action(acting: int, action: int, tmp_path: Path) -> None:
    run_with(tmp_path / "run", acting, action)
    done = evaluate_checkpoint(tmp_path / "run", 30, 5)
    assert done.network == acting + 1
    # CartPole falls after 8 to 11 steps of the same push.
    assert len(done.returns) == 30
    assert {8.0, 9.0, 10.0} <= set(done.returns) <= {8.0, 9.0, 10.0, 11.0}
    assert evaluate_checkpoint(tmp_path / "run", 30, 5) == done
    assert evaluate_checkpoint(tmp_path / "run", 30, 6) != done


def test_eval_on_the_command_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    run_with(tmp_path / "run", 0, 0)
    monkeypatch.setattr("sys.argv", ["coop-eval", str(tmp_path / "run"), "--episodes", "4"])
    evaluation_cli.main()
    assert re.fullmatch(
        r"return of 4 greedy episodes: mean (8|9|10|11)\.\d\d, sd [01]\.\d\d, least \d+, most \d+; "
        r"network 1 of checkpoint 0 in .*/run\n",
        capsys.readouterr().out,
    )
    (tmp_path / "run" / "checkpoints" / "0" / "DONE").unlink()
    for flags, words in (
        ([str(tmp_path / "run")], "has no complete checkpoint"),
        ([str(tmp_path)], "holds no run"),
        ([str(tmp_path / "run"), "--episodes", "0"], "--episodes 0: must be at least 1"),
        ([str(tmp_path / "run"), "--seed", "-1"], "--seed -1: must be at least 0"),
    ):
        monkeypatch.setattr("sys.argv", ["coop-eval", *flags])
        with pytest.raises(SystemExit) as caught:
            evaluation_cli.main()
        told = capsys.readouterr()
        assert (caught.value.code, told.out) == (2, "")
        assert words in told.err
        assert told.err.count("\n") == 1


def test_watching_a_run_to_its_end(tmp_path: Path) -> None:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        endpoint = f"tcp/127.0.0.1:{probe.getsockname()[1]}"
    watch = [str(SCRIPTS / "coop-watch"), "--connect", endpoint]
    nobody = subprocess.run([*watch, "--join-timeout", "0.5"], capture_output=True, text=True, check=False)
    assert nobody.returncode == 1
    assert nobody.stderr == f"coop-watch: error: no learner of run 'coop' found at {endpoint} within 0.5 s\n"
    local = [
        str(SCRIPTS / "coop-local"),
        "--listen",
        endpoint,
        "--total-steps",
        "900",
        "--run-dir",
        str(tmp_path / "r"),
    ]
    with (
        subprocess.Popen(local, stdout=subprocess.DEVNULL) as run,
        subprocess.Popen(watch, stdout=subprocess.PIPE, text=True) as first,
        subprocess.Popen([*watch, "--patience", "90"], stdout=subprocess.PIPE, text=True) as second,
        subprocess.Popen([*watch, "--patience", "0.1"], stderr=subprocess.PIPE, text=True) as hasty,
    ):
        while not (tmp_path / "r" / "metrics.jsonl").exists():
            assert run.poll() is None
            time.sleep(0.1)
        second.send_signal(signal.SIGINT)
        assert "the run has ended" not in second.communicate(timeout=110)[0]
        # A learner tells its status twice a second.
        assert hasty.communicate(timeout=110)[1].endswith("the learner of run 'coop' has been silent for 0.1 s\n")
        out, _ = first.communicate(timeout=110)
        assert (first.returncode, second.returncode, hasty.returncode, run.wait(110)) == (0, 0, 1, 0)
    assert re.search(r"step \d+/900  return [\d.]+ \((last 100 of )?\d+ episodes?\)", out)
    assert out.endswith("the run has ended: complete\n")
