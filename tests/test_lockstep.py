"""Lockstep runs: the same bytes for a seed, also through a kill -9, for every method."""

import json
import time
from dataclasses import replace
from pathlib import Path
from unittest.mock import patch

import pytest
from commands import Command, run_command
from table_reference import whole_state

from coop.lockstep.lockstep import Lockstep
from coop.records.learner_checkpoints import newest_checkpoint
from coop.records.run_directory import RunDirectory
from coop.records.run_options import base_config

pytestmark = pytest.mark.timeout(300)  # whole runs, also on a busy machine


def _run(path: Path, method: str, steps: int) -> Lockstep:
    run = Lockstep(base_config(["--method", method]))
    with RunDirectory(path, run.config) as directory:
        for _ in range(steps):
            _play(run, directory)
    run.env.close()
    return run


def _play(run: Lockstep, directory: RunDirectory) -> None:
    for effects in run.play():
        directory.record(effects.episodes, effects.metrics)


@pytest.mark.parametrize("method", ["coop", "medqn", "stream-q"])  # of others, test_single_file.py shows more
def test_the_same_bytes_for_a_seed(method: str, tmp_path: Path) -> None:
    first, second = (_run(tmp_path / name, method, 700) for name in "ab")
    content = (tmp_path / "a" / "episodes.csv").read_bytes()
    assert content.count(b"\n") > 10
    assert (tmp_path / "b" / "episodes.csv").read_bytes() == content
    started = 0 if first.config.streaming else first.config.replay.learning_starts
    assert first.agent.updates == second.agent.updates == 700 - started


@pytest.mark.parametrize("method", ["coop", "medqn", "stream-q"])
def test_killed_and_resumed_to_the_byte(method: str, tmp_path: Path) -> None:
    flags = ["--method", method, "--total-steps", "900", "--checkpoint-every", "200", "--seed", "4"]
    whole = run_command("coop-lockstep", *flags, "--run-dir", tmp_path / "a", check=True)
    assert "complete: 900 steps" in whole.stdout
    with Command("coop-lockstep", *flags, "--run-dir", tmp_path / "b") as process:
        while not (tmp_path / "b" / "checkpoints" / "400" / "DONE").exists():
            assert process.returncode is None
            time.sleep(0.01)
    assert not (tmp_path / "b" / "summary.json").exists()
    run_command("coop-lockstep", "--resume", "--run-dir", tmp_path / "b", check=True)  # the rest it finds there
    episodes = [(tmp_path / name / "episodes.csv").read_bytes() for name in "ab"]
    assert episodes[0] == episodes[1]


def test_a_run_without_an_ended_episode_says_so(tmp_path: Path) -> None:
    flags = ["--total-steps", "5", "--replay.learning_starts", "4", "--run-dir", tmp_path / "run"]
    done = run_command("coop-lockstep", *flags, check=True)
    assert "updates, no episode ended, " in done.stdout
    assert not (tmp_path / "run" / "learning_curve.png").exists()


def test_resume_starts_goes_on_or_refuses(tmp_path: Path) -> None:
    def resume(*flags: str) -> tuple[int, str, str]:
        done = run_command("coop-lockstep", "--resume", "--run-dir", tmp_path / "a", *flags)
        return done.returncode, done.stdout, done.stderr

    short = ("--total-steps", "300", "--replay.learning-starts", "40")
    status, out, _ = resume(*short)
    assert (status, out.splitlines()[0]) == (0, f"starts in {tmp_path / 'a'}: there is no run there yet")
    status, out, _ = resume(*short)
    assert (status, out.splitlines()[0]) == (0, "resuming from checkpoint 260")
    status, _, err = resume(*short, "--seed", "9")
    assert (status, err.count("\n")) == (1, 1)
    assert "another run's, whose seed is 0; here it is 9" in err
    status, _, err = resume(*short, "--learner.gamma", "0.5")
    assert (status, err.count("\n")) == (2, 1)
    assert "--resume: learner.gamma = 0.5, but 0.95" in err


def test_roles_swap_by_steps_and_start_anew_with_each_episode(tmp_path: Path) -> None:
    config = base_config(["--method", "coop"])
    learner = replace(config.learner, swap_unit="steps", swap_every=7, reset_role_at_episode=True)
    run = Lockstep(replace(config, learner=learner))
    acting, expected, swaps, resets = 0, [], 0, 0
    seen = []
    with RunDirectory(tmp_path / "run", run.config) as directory:
        for step in range(1, 400):
            episodes = run.trainer.telemetry.episodes
            _play(run, directory)
            seen.append(run.agent.acting)
            if step % 7 == 0:
                acting, swaps = 1 - acting, swaps + 1
            if run.trainer.telemetry.episodes > episodes:
                resets += acting
                acting = 0
            expected.append(acting)
    run.env.close()
    assert seen == expected
    assert swaps > 50
    assert resets > 0


@pytest.mark.parametrize("flags", [["--learner.swap-unit", "steps"], ["--learner.reset-role-at-episode"]])
@pytest.mark.parametrize("name", ["coop-learner", "coop-local"])
def test_roles_in_processes_have_no_plays(name: str, flags: list[str], tmp_path: Path) -> None:
    result = run_command(name, *flags, "--run-dir", tmp_path / "run")
    assert result.returncode == 2
    assert "in lockstep runs only" in result.stderr
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("flags", "column", "value"),
    [
        (["--total-episodes", "7"], "episodes", 7),
        (["--total-updates", "60"], "updates", 60),
        (["--target-return", "5", "--actor.epsilon-final", "0.9"], "episodes", 100),
    ],
)
def test_a_target_ends_the_run(flags: list[str], column: str, value: int, tmp_path: Path) -> None:
    method = ["--method", "dqn", "--total-steps", "4000", "--network.hidden", "16"]
    result = run_command("coop-lockstep", *method, *flags, "--run-dir", tmp_path / "run", check=True)
    name = flags[0].removeprefix("--").replace("-", "_")
    assert result.stdout.rstrip().splitlines()[-1].startswith(f"complete: {name} reached")
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert summary[column] == value
    assert summary["exit"] == f"complete: {name} reached"


@pytest.mark.parametrize("program", ["coop-lockstep", "coop-local"])
def test_a_run_that_diverges_ends_and_says_so(program: str, tmp_path: Path) -> None:
    flags = ["--total-steps", "2000", "--checkpoint-every", "100", "--learner.learning-rate", "1e30"]
    done = run_command(program, *flags, "--run-dir", tmp_path / "run")
    assert done.returncode == 1
    assert "diverged: " in done.stderr
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert summary["exit"].startswith("diverged: ")
    assert "not finite at update" in summary["exit"]
    assert summary["updates"] < 200  # one interval of metrics
    assert not list((tmp_path / "run").glob("checkpoints/*/DONE"))


@pytest.mark.parametrize("ratio", [1.0, 0.3])
def test_steps_that_wait_come_back_with_a_resumed_run(ratio: float, tmp_path: Path) -> None:
    """Steps are not in the table yet that wait for their n-step return, or for the next batch."""
    config = base_config(["--method", "dqn"])
    config = replace(config, replay=replace(config.replay, n_step=5, learning_starts=40, ratio=ratio))
    first, second = Lockstep(config), Lockstep(config)
    tables = []
    with RunDirectory(tmp_path, config) as directory:
        for _ in range(150):
            _play(first, directory)
        first.save(directory)
        checkpoint = newest_checkpoint(tmp_path)
        assert checkpoint is not None
        second.restore(checkpoint)
        for run in (first, second):
            for _ in range(30):
                for _ in run.play():
                    pass
            tables.append(whole_state(run.memory.table)[1])
            run.env.close()
    assert tables[0].keys() == tables[1].keys()
    for name, column in tables[0].items():
        assert column.tobytes() == tables[1][name].tobytes(), name


@pytest.mark.parametrize("n_step", [1, 3])
def test_steps_are_stored_some_at_a_time_before_each_batch(n_step: int) -> None:
    config = base_config(["--method", "dqn"])
    run = Lockstep(replace(config, replay=replace(config.replay, n_step=n_step, learning_starts=41, ratio=0.25)))
    table = run.memory.table
    with patch.object(table, "insert", wraps=table.insert) as insert:
        for _ in range(200):
            updates = run.agent.updates
            for _ in run.play():
                pass
            if run.agent.updates > updates:
                assert run.step - n_step < table.inserted <= run.step, "all whose return is complete"
    run.env.close()
    assert run.agent.updates == 40
    assert sum(call.args[0].steps for call in insert.call_args_list) == table.inserted
    assert insert.call_count < 60


def test_processes_do_not_go_on_with_a_lockstep_run(tmp_path: Path) -> None:
    flags = ["--total-steps", "300", "--run-dir", tmp_path / "run"]
    run_command("coop-lockstep", *flags, check=True)
    before = {path: path.read_bytes() for path in tmp_path.rglob("[!.]*") if path.is_file()}
    done = run_command("coop-learner", *flags, "--resume", cwd=tmp_path)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith("coop-learner: error: ")
    assert done.stderr.endswith("saved by a lockstep run; coop-lockstep --resume goes on with it\n")
    assert len(done.stderr.splitlines()) == 1
    assert {path: path.read_bytes() for path in tmp_path.rglob("[!.]*") if path.is_file()} == before
