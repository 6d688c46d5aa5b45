"""Whole runs: real processes through the console commands, over Zenoh on loopback, with kills and Ctrl-C."""

import csv
import json
import os
import re
import signal
import socket
import subprocess
import sysconfig
import time
import tomllib
from contextlib import suppress
from pathlib import Path

import pytest
import torch
from commands import Command, lines, run_command, wait_for

from benchmarks.chaos import children
from coop.common.errors import RunError
from coop.common.metrics import COLUMNS
from coop.learner.agent import Agent
from coop.lockstep.reexecute import reexecute
from coop.records.learner_checkpoints import load_learner

pytestmark = pytest.mark.timeout(300)  # whole runs, also on a busy machine

SCRIPTS = Path(sysconfig.get_path("scripts"))
EPISODES = "episode,env_step,update,actor,stream,return,length,epsilon,s,q1_mean,q2_mean,param_version"
METRICS = [
    *("time", "env_step", "update", "acting", "td_error", "loss", "s", "epsilon", "q_gap", "q1_mean", "q2_mean"),
    *("q_abs_mean", "archive_td_error", "archive_drift", "policy_churn", "dormant_share", "dormant_by_layer"),
    *("effective_rank", "effective_rank_by_layer", "q_bound", "updates_per_s", "env_steps_per_s", "replay_size"),
    *(
        "terminal_share",
        "sample_age_mean",
        "sample_age_p95",
        "sample_age_histogram",
        "reuse_mean",
        "reuse_histogram",
        "distinct_share",
    ),
    *("evicted_unsampled", "weight_lag_mean"),
]
SILENT = r"(?m)^\d\d:\d\d:\d\d replay service on \S+ \(pid \d+\) does not answer$"
SUMMARY = [
    *("method", "env", "seed", "env_steps", "updates", "episodes", "return_mean_100", "return_sd_100"),
    *("wall_seconds", "transitions_accepted", "transitions_lost", "duplicates_refused", "exit"),
    *("fallbacks", "records", "crc32"),
]


def run(name: str, *flags: str) -> subprocess.CompletedProcess[str]:
    return run_command(name, *flags, timeout=90)


def roles_of(pid: int) -> dict[str, int]:
    """The processes of a supervisor's roles by their command's name, the last one of each."""
    return {name: role for role, name in children(pid)}


def check_files(path: Path, steps: int, outcome: str = "complete") -> dict[str, object]:
    """The run directory is whole and its numbers agree with each other; the summary."""
    config = tomllib.loads((path / "config.toml").read_text())
    summary: dict[str, object] = json.loads((path / "summary.json").read_text())
    assert list(summary) == SUMMARY
    assert summary["exit"] == outcome
    assert summary["transitions_lost"] == 0
    rows = list(csv.DictReader((path / "episodes.csv").read_text().splitlines()))
    assert (path / "episodes.csv").read_text().splitlines()[0] == EPISODES
    assert len(rows) == summary["episodes"]
    assert [int(row["episode"]) for row in rows] == list(range(len(rows)))
    metrics = [json.loads(line) for line in (path / "metrics.jsonl").read_text().splitlines()]
    assert COLUMNS.issuperset(METRICS), "names stay"
    # What is compared with the last row begins with the second.
    assert metrics[0].keys() == COLUMNS - {"archive_drift", "policy_churn"}
    assert all(row.keys() == COLUMNS for row in metrics[1:])
    assert list((path / "tb").iterdir())
    if outcome == "complete":
        env_steps, updates = summary["env_steps"], summary["updates"]
        assert isinstance(env_steps, int)
        assert isinstance(updates, int)
        assert steps <= env_steps < steps + 64
        assert abs(updates - (steps - config["replay"]["learning_starts"])) <= 0.02 * steps
    checkpoints = sorted((path / "checkpoints").iterdir(), key=lambda folder: int(folder.name))
    assert 1 <= len(checkpoints) <= 2
    assert all((checkpoint / "DONE").exists() for checkpoint in checkpoints)
    state = load_learner(checkpoints[-1])
    assert state["agent"]["updates"] == summary["updates"]
    assert all(torch.isfinite(flat).all() for flat in state["agent"]["networks"])
    assert (checkpoints[-1] / "replay" / "frames.npy").exists()
    assert (path / "learning_curve.png").read_bytes().startswith(b"\x89PNG")
    return summary


def test_coop_local_end_to_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "run"
    flags = ("--preset", "cartpole", "--actors", "2", "--seed", "3", "--total-steps", "900", "--run-dir", str(path))
    flags += ("--network.hidden", "32")
    done = run("coop-local", *flags, "--replay.journal", "--checkpoint-every", "300")
    assert (done.returncode, done.stderr) == (0, "")
    check_files(path, 900)
    again = reexecute(path)
    assert (again.began, again.updates, again.missing_segments) == (600, 810, 0)
    rate = Agent._learning_rate
    monkeypatch.setattr(Agent, "_learning_rate", lambda agent: rate(agent) * (1.01 if agent.updates == 700 else 1))
    with pytest.raises(RunError, match=r"^agent\.networks\[[01]\] differs from .*checkpoints/810$"):
        reexecute(path)
    again = run("coop-local", *flags)
    assert again.returncode == 2
    assert again.stderr.count("\n") == 1
    assert "holds a run already" in again.stderr


def test_a_learner_reads_frames_in_the_memory_of_the_replay_service(tmp_path: Path) -> None:
    path = tmp_path / "run"
    flags = ("--preset", "catch", "--actors", "1", "--total-steps", "800", "--run-dir", str(path), "--shared-memory")
    flags += ("--learner.batch-size", "4")

    def shared(pid: int) -> set[str]:
        """The memories that a process has mapped."""
        with suppress(OSError):
            return set(re.findall(r"/memfd:(coop-\w+)", Path(f"/proc/{pid}/maps").read_text()))
        return set()

    with Command("coop-local", *flags, "--replay.journal", "--replay.journal-keep") as local:

        def same() -> bool:
            roles = roles_of(local.pid)
            learner, replay = (shared(roles.get(f"coop-{role}", 0)) for role in ("learner", "replay"))
            return bool(learner) and learner == replay

        wait_for("the learner reads the table", same)
        _, err = local.communicate(timeout=120)
        assert (local.returncode, err) == (0, "")
    assert reexecute(path).missing_segments == 0, "what it read is what the journal has, bit for bit"


def test_actors_that_all_run_elsewhere(tmp_path: Path, endpoint: str) -> None:
    local = ("--actors", "0", "--listen", endpoint, "--total-steps", "600", "--run-dir", str(tmp_path / "run"))
    with Command("coop-local", *local) as head, Command("coop-actor", "--connect", endpoint) as actor:
        out, err = head.communicate(timeout=80)
        assert (head.returncode, err, actor.wait(20)) == (0, "", 0)
        assert re.search(r"complete: 600 steps, \d+ updates", out)


def test_an_actors_emulators_act_in_groups(tmp_path: Path, endpoint: str) -> None:
    """All streams arrive, each whole: what it read is what the journal has, bit for bit."""
    path = tmp_path / "run"
    flags = ("--preset", "cartpole", "--total-steps", "1500", "--replay.journal", "--run-dir", str(path))
    flags += ("--network.hidden", "32", "--learner.mirror", "on")
    actor = ("--connect", endpoint, "--envs", "5", "--groups", "2")
    with (
        Command("coop-local", "--actors", "0", "--listen", endpoint, *flags) as head,
        Command("coop-actor", *actor) as group,
    ):
        _, err = head.communicate(timeout=80)
        assert (head.returncode, err, group.wait(20)) == (0, "", 0)
        assert "plays 5 emulators of CartPole-v0" in group.output()[0]
    rows = list(csv.DictReader((path / "episodes.csv").read_text().splitlines()))
    lengths = {stream: sum(int(row["length"]) for row in rows if row["stream"] == stream) for stream in "01234"}
    assert {row["stream"] for row in rows} == lengths.keys()
    assert max(lengths.values()) < 2 * min(lengths.values()), "in turn"
    assert reexecute(path).missing_segments == 0


@pytest.mark.parametrize(
    ("flag", "value", "words"), [("--device", "nowhere", " nowhere: "), ("--groups", "0", ": 0 is")]
)
def test_an_actor_refuses_what_it_can_t_have_at_once(flag: str, value: str, words: str) -> None:
    done = run("coop-actor", flag, value)
    assert done.returncode == 2
    assert done.stderr.startswith(f"coop-actor: error: {flag}{words}")
    assert done.stderr.count("\n") == 1


def test_an_actor_without_emulators_is_refused(tmp_path: Path, endpoint: str) -> None:
    local = ("--actors", "0", "--listen", endpoint, "--total-steps", "600", "--run-dir", str(tmp_path / "run"))
    with Command("coop-local", *local):
        done = run("coop-actor", "--connect", endpoint, "--envs", "-3")
    assert done.returncode == 2
    assert done.stderr == "coop-actor: error: envs: -3 is not allowed; at least 1\n"


def test_three_shells_a_late_actor_and_a_kill(tmp_path: Path) -> None:
    path = tmp_path / "run"
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        endpoint = f"tcp/127.0.0.1:{probe.getsockname()[1]}"
    joining = ("--run", "hand", "--connect", endpoint)
    learning = ("--run", "hand", "--listen", endpoint, "--total-steps", "2500", "--run-dir", str(path))
    with (
        Command("coop-actor", *joining) as first,
        Command("coop-replay", *joining, "--run-dir", str(path)) as replay,
        Command("coop-learner", *learning) as learner,
    ):
        wait_for("the first metrics", lambda: lines(path / "metrics.jsonl") >= 1)
        with Command("coop-actor", *joining) as second:
            wait_for("more metrics", lambda: lines(path / "metrics.jsonl") >= 4)
            printed = run("coop-limits", *joining, "--tolerance", "16")
            assert (printed.returncode, printed.stderr) == (0, "")
            assert printed.stdout.startswith("ratio 1, tolerance 16 steps\n")
            first.send_signal(signal.SIGKILL)
            out, err = learner.communicate(timeout=80)
            assert (learner.returncode, err) == (0, "")
            assert out.splitlines()[-1].startswith("complete: ")
            assert (second.wait(20), replay.wait(20)) == (0, 0)
    check_files(path, 2500)
    rows = csv.DictReader((path / "episodes.csv").read_text().splitlines())
    assert len({row["actor"] for row in rows}) == 2


def test_ctrl_c_a_killed_actor_and_resume(tmp_path: Path) -> None:
    path = tmp_path / "run"
    flags = ("--actors", "1", "--total-steps", "3000", "--run-dir", str(path))
    with Command("coop-local", *flags) as local:
        wait_for("the first metrics", lambda: lines(path / "metrics.jsonl") >= 1)
        roles = roles_of(local.pid)
        assert sorted(roles) == ["coop-actor", "coop-learner", "coop-replay"]
        os.kill(roles["coop-actor"], signal.SIGKILL)
        wait_for("the new actor", lambda: roles_of(local.pid).get("coop-actor", 0) != roles["coop-actor"])
        os.kill(roles["coop-replay"], signal.SIGSTOP)
        log = path / "logs" / "learner.log"
        wait_for("the frozen one's name", lambda: re.search(SILENT, log.read_text()))
        time.sleep(3)  # coop-local finds out by itself, and prints where this test can't look yet
        os.kill(roles["coop-replay"], signal.SIGCONT)
        before = lines(path / "metrics.jsonl")
        wait_for("metrics with the new actor", lambda: lines(path / "metrics.jsonl") > before + 1)
        local.send_signal(signal.SIGINT)
        out, err = local.communicate(timeout=40)
        assert (local.returncode, err) == (130, "")
    assert re.search(SILENT, out)
    assert re.search(SILENT.replace("does not answer", "is back"), out)
    assert re.search(r"actor process 1 \(pid \d+\) was killed by SIGKILL; starting it again", out)
    before = check_files(path, 3000, "interrupted")
    done = run("coop-local", *flags, "--resume")
    assert (done.returncode, done.stderr) == (0, "")
    after = check_files(path, 3000)
    assert int(str(after["episodes"])) > int(str(before["episodes"]))
    assert float(str(after["wall_seconds"])) > float(str(before["wall_seconds"]))
    refused = run("coop-local", *flags, "--resume", "--learner.gamma", "0.5")
    assert refused.returncode == 2
    assert "learner.gamma" in refused.stderr


def test_a_role_that_gives_up_ends_the_run_and_is_named(tmp_path: Path) -> None:
    done = run("coop-local", "--learner.weight-decay", "0.1", "0.2", "--run-dir", str(tmp_path / "run"))
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert "learner ended (exit status 2)" in done.stderr
    assert "learner.weight_decay" in done.stderr


def test_a_port_in_use(tmp_path: Path) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        endpoint = f"tcp/127.0.0.1:{taken.getsockname()[1]}"
        flags = ["--listen", endpoint, "--run-dir", str(tmp_path / "run")]
        alone, supervised = run("coop-learner", *flags), run("coop-local", *flags)
    for done in (alone, supervised):
        assert done.returncode == 1
        assert done.stderr.count("\n") == 1
        assert endpoint in done.stderr
    assert "learner ended (exit status 1)" in supervised.stderr


@pytest.mark.parametrize("name", ["coop-actor", "coop-replay"])
def test_no_learner(name: str) -> None:
    done = run(name, "--run", "nobody", "--connect", "tcp/127.0.0.1:9", "--join-timeout", "1")
    assert done.returncode == 1
    assert done.stderr == f"{name}: error: no learner of run 'nobody' found at tcp/127.0.0.1:9 within 1 s\n"


@pytest.mark.parametrize("name", ["coop-actor", "coop-replay", "coop-eval", "coop-limits", "coop-watch"])
@pytest.mark.parametrize(("flag", "words"), [("--join-timeout", "nan"), ("--patience", "-1.0")])
def test_what_is_no_time_to_wait(name: str, flag: str, words: str) -> None:
    done = run(name, "--connect", "tcp/127.0.0.1:9", f"{flag}={words}")
    assert (done.returncode, done.stderr) == (
        2,
        f"{name}: error: {flag} = {words}: must be a number of seconds from 0 on\n",
    )


def test_bad_flags_of_a_command() -> None:
    done = run("coop-local", "--preset", "cartpole", "--replay.capacity", "-1")
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == "coop-local: error: replay.capacity = -1: expected int >= 1\n"


def test_replay_runs_without_torch() -> None:
    code = "import sys, coop.replay.cli; sys.exit(bool({'torch', 'gymnasium'} & sys.modules.keys()))"
    assert subprocess.run([SCRIPTS / "python", "-c", code], check=False).returncode == 0
