"""`coop-watch DIR`: runs and sweeps by their folders, while they grow and when they have ended."""

import json
import os
import re
import signal
import subprocess
import time
import urllib.request
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import pytest
from commands import Command, run_command

from coop.common.process.processes import command
from coop.lockstep.lockstep import Lockstep
from coop.monitor.live_page import LivePage
from coop.records.following import Following
from coop.records.growing import GrowingTable
from coop.records.locks import RunLock
from coop.records.run_directory import RunDirectory
from coop.records.run_options import base_config
from coop.records.summaries import summary_text
from coop.studies.watch.run import RunFolder
from coop.studies.watch.screen import SweepPage, time_line
from coop.studies.watch.sweep import SweepFolder

GRID = """
title = "Two methods"
methods = ["coop", "dqn"]
preset = "cartpole"
[fixed]
total_steps = 600
replay.learning_starts = 100
"""


def wait_until(reached: Callable[[], bool], seconds: float = 100) -> None:
    deadline = time.monotonic() + seconds
    while not reached():
        assert time.monotonic() < deadline
        time.sleep(0.2)


def test_rows_are_read_once_when_they_are_whole_and_anew_after_a_resumption(tmp_path: Path) -> None:
    path = tmp_path / "rows.csv"
    table = GrowingTable(path)
    assert list(table.rows()) == [], "there is no file yet"
    path.write_text("a,b\n1,2\n3,")
    assert list(table.rows()) == [{"a": "1", "b": "2"}]
    path.write_text("a,b\n1,2\n3,4\n5\n")
    assert list(table.rows()) == [{"a": "3", "b": "4"}], "the half line, once whole; not the torn one"
    assert not table.restarted
    path.write_text("a,b\n9,9\n")
    assert list(table.rows()) == [{"a": "9", "b": "9"}]
    assert table.restarted
    path.write_text("a,b\n8,8\n7,7\n")
    assert list(table.rows()) == [{"a": "8", "b": "8"}, {"a": "7", "b": "7"}], "longer than before, with other lines"
    assert table.restarted
    path.write_text("")
    assert list(table.rows()) == []
    path.write_text("c\n6\n")
    assert list(table.rows()) == [{"c": "6"}], "emptied before its header was written"


@pytest.mark.parametrize("between", ["", "env_step,upd"])
def test_rows_are_followed_through_a_file_that_is_emptied_and_written_again(between: str, tmp_path: Path) -> None:
    path = tmp_path / "evaluations.csv"
    following = Following(tmp_path, path.name)
    assert following.rows() == []
    path.write_text(between)
    assert following.rows() == []
    header = "env_step,update,network,episodes,return_mean,return_sd,epsilon,seconds\n"
    row = "{},150,1,4,12.5,1,0,1\n"
    path.write_text(header + row.format(200) + row.format(300))
    assert [found["env_step"] for found in following.rows()] == [200, 300]
    path.write_text(between)
    assert following.rows() == []
    path.write_text(header + row.format(200) + row.format(250) + row.format(400))
    assert [found["env_step"] for found in following.rows()] == [400], "each step once"


def test_a_run_by_its_files_while_they_grow(tmp_path: Path) -> None:
    run = Lockstep(base_config(["--method", "coop", "--replay.learning-starts", "50"]))
    with RunDirectory(tmp_path / "r", run.config) as directory:
        watched, rows = RunFolder(tmp_path / "r"), 0
        watched.refresh()
        assert watched.learner is not None
        assert (watched.learner.env_steps, watched.learner.episodes, watched.points()) == (0, 0, [])
        episodes = returns = 0.0
        while rows < 2:
            for effects in run.play():
                directory.record(effects.episodes, effects.metrics)
                rows += bool(effects.metrics)
                episodes += len(effects.episodes)
                returns += sum(row.record.end.episode_return for row in effects.episodes)
        with (tmp_path / "r" / "metrics.jsonl").open("a") as file:
            file.write('{"time": 1, "upd')  # as a reader may find a row that is being written
        (tmp_path / "r" / "evaluations.csv").write_text(
            "env_step,update,network,episodes,return_mean,return_sd,epsilon,seconds\n200,150,1,4,12.5,1,0,1\n"
        )
        watched.refresh()
        first, second = watched.points()
        before, row = map(json.loads, (tmp_path / "r" / "metrics.jsonl").read_text().splitlines()[:2])
    run.env.close()
    status = watched.learner
    assert (status.updates, status.episodes) == (row["update"], episodes)
    assert status.return_mean_100 == pytest.approx(returns / episodes), "fewer than 100"
    assert (first["env_steps"], second["env_steps"]) == (before["env_step"], row["env_step"])
    assert second["archive_drift"] == row["archive_drift"]
    assert status.measured is not None
    assert status.measured.sample_age_histogram == row["sample_age_histogram"]
    assert watched.evaluations() == [[200.0, 12.5]]
    assert watched.over() == "no process works in its folder"
    with closing(LivePage("r", "0")) as page:
        page.show(status, [], 0.0, "", [first, second], watched.evaluations())
        with urllib.request.urlopen(f"{page.url}page.json", timeout=20) as answer:
            told = json.load(answer)
    assert [point[0] for point in told["points"]] == [before["env_step"], row["env_step"]]
    assert told["evaluations"] == [[200.0, 12.5]]
    assert told["ages"] == row["sample_age_histogram"]
    assert {"Forgetting: the first 64 transitions drawn", "Share of terminal transitions"} <= {
        chart["title"] for chart in told["charts"]
    }


def test_rows_that_can_t_be_read_are_left_out(tmp_path: Path) -> None:
    with RunDirectory(tmp_path / "r", base_config(["--method", "coop"]), log="none"):
        pass
    rows = [{"env_step": 100 + n, "update": n, "updates_per_s": speed} for n, speed in ((200, 50), (250, 0), (300, 25))]
    lines = ['{"env_step": 3}', "nonsense", *map(json.dumps, rows)]
    (tmp_path / "r" / "metrics.jsonl").write_text("".join(f"{line}\n" for line in lines))
    watched = RunFolder(tmp_path / "r")
    watched.refresh()
    assert watched.learner is not None
    assert (watched.learner.updates, watched.learner.env_steps, watched.learner.seconds) == (300, 400, 4 + 2)
    assert len(watched.points()) == 3
    assert watched.points() == [], "each once"


@pytest.mark.timeout(400)  # on a busy machine
def test_a_run_of_a_process_that_is_killed(tmp_path: Path) -> None:
    flags = ["--preset", "cartpole", "--total-steps", "1000000", "--run-dir", str(tmp_path / "r")]
    with subprocess.Popen(command("coop-lockstep", *flags), stdout=subprocess.DEVNULL) as process:
        try:
            wait_until((tmp_path / "r" / "metrics.jsonl").exists)
            watched = RunFolder(tmp_path / "r")
            wait_until(lambda: (watched.refresh() or watched.learner) is not None and watched.learner.updates > 0)
            assert watched.over() == ""
            (member,) = watched.learner.members
            assert (member.name, member.pid, member.state) == ("coop-lockstep", process.pid, "training")
            assert watched.learner.seconds_left
        finally:
            process.send_signal(signal.SIGKILL)
            process.wait()
    watched.refresh()
    assert watched.over() == "no process works in its folder"
    assert [member.state for member in watched.learner.members] == ["lost"]
    done = run_command("coop-watch", tmp_path / "r", cwd=tmp_path)
    assert done.returncode == 0, "a run that nobody goes on with is not followed"
    assert done.stdout.endswith("the run has ended: no process works in its folder\n")


def ended(cell: Path, outcome: str) -> None:
    """Write how the run of a cell has ended."""
    cell.mkdir(exist_ok=True)
    (cell / "summary.json").write_text(summary_text({"exit": outcome}))


def played(cell: Path, steps: int) -> None:
    """Write an episode of a cell's run, of return 7."""
    cell.mkdir(exist_ok=True)
    (cell / "episodes.csv").write_text(f"episode,env_step,return\n0,{steps},7.0\n1,9")


def test_the_states_of_cells(tmp_path: Path) -> None:
    (tmp_path / "sweep.toml").write_text(GRID.replace("[fixed]", "seeds = [0, 1, 2, 3]\n[fixed]"))
    sweep, cells = SweepFolder(tmp_path), [tmp_path / f"{m}-seed={n}" for m in ("coop", "dqn") for n in range(4)]
    ended(cells[0], "complete: target_return reached")
    ended(cells[1], "diverged: TD errors are not finite at update 3")
    ended(cells[2], "failed: ValueError: no luck")
    played(cells[3], 90)
    (cells[3] / "run.log").write_text("step 90/600\ncoop-lockstep: error: the disk is full\n\n")
    ended(cells[4], "interrupted")
    played(cells[4], 200)
    played(cells[5], 100)
    row = {"env_step": 150, "env_steps_per_s": 30.0}
    (cells[5] / "metrics.jsonl").write_text(f'{{"env_step": 4}}\n{json.dumps(row)}\n{{"env_step": 180, "env')
    cells[6].mkdir()
    lock = RunLock(cells[5], "coop-lockstep", ("learner",)).sign()
    try:
        sweep.refresh()
        now = {cell.name: cell for cell in sweep.cells}
    finally:
        lock.release()
    states = ["finished", "diverged", "failed", "failed", "stopped", "running", "waiting", "waiting"]
    assert [now[cell.name].state for cell in cells] == states
    running = now[cells[5].name]
    assert now[cells[0].name].step == 600, "it has no episode behind its last one"
    assert list(sweep.counts().items()) == [
        ("finished", 1), ("running", 1), ("waiting", 2), ("stopped", 1), ("diverged", 1), ("failed", 2),
    ]  # fmt: skip
    assert (running.group, running.seed, running.step, running.total) == ("dqn", "1", 150, 600)
    assert (running.mean_return, running.speed) == (7.0, 30.0)
    assert sweep.steps() == (4 * 600 + 200 + 150, 8 * 600)
    assert sweep.seconds_left() == (8 * 600 - 2750) / 30
    assert [cell.why for cell in sweep.failures()] == [
        "diverged: TD errors are not finite at update 3",
        "failed: ValueError: no luck",
        "coop-lockstep: error: the disk is full",
    ]
    assert not sweep.over
    sweep.refresh()
    assert sweep.counts()["stopped"] == 2, "its process is gone"
    assert (sweep.speed(), sweep.seconds_left(), sweep.over) == (0, None, False)
    assert time_line(sweep) == "no cell runs now"
    lock = RunLock(cells[6], "coop-lockstep", ("learner",)).sign()
    try:
        sweep.refresh()
        assert (sweep.counts()["running"], time_line(sweep)) == (1, "time left not known yet"), "it has no row yet"
    finally:
        lock.release()
    for cell in cells[3:]:
        ended(cell, "complete")
    played(cells[3], 600)
    sweep.refresh()
    assert (sweep.counts(), sweep.over) == ({"finished": 6, "diverged": 1, "failed": 1}, True)
    ended(cells[0], "interrupted")  # made longer, and stopped
    os.utime(cells[0] / "summary.json", (1, 1))
    sweep.refresh()
    assert (sweep.counts(), sweep.over) == ({"finished": 5, "stopped": 1, "diverged": 1, "failed": 1}, False)


def test_a_folder_of_runs_without_a_grid(tmp_path: Path) -> None:
    for name, outcome in (("a", "complete"), ("b", "interrupted")):
        with RunDirectory(tmp_path / name, base_config(["--method", "coop", "--total-steps", "700"]), log="none"):
            ended(tmp_path / name, outcome)
    sweep = SweepFolder(tmp_path)
    sweep.refresh()
    assert [(cell.name, cell.state, cell.group) for cell in sweep.cells] == [
        ("a", "finished", "CartPole-v0, coop"), ("b", "stopped", "CartPole-v0, coop"),
    ]  # fmt: skip
    assert (sweep.steps(), sweep.over) == ((700, 1400), True), "no command goes on with it"
    (tmp_path / "sweep.toml").write_text('methods = ["coop", "dqn", "edql"]')
    (tmp_path / "a").rename(tmp_path / "coop-seed=0")
    sweep = SweepFolder(tmp_path)
    sweep.refresh()
    assert [cell.total for cell in sweep.cells] == [700, None, None], "a grid need not say it"
    assert sweep.steps() == (700, 3 * 700), "those that have not begun count as the others"


@pytest.mark.timeout(600)  # on a busy machine
def test_a_sweep_by_its_folder(tmp_path: Path) -> None:
    (tmp_path / "grid.toml").write_text(GRID)
    folder = tmp_path / "sweep"
    run_command("coop-sweep", "grid.toml", "--dir", folder, "--cell", "0", cwd=tmp_path, check=True, timeout=300)
    sweep = SweepFolder(folder)
    sweep.refresh()
    assert sweep.counts() == {"finished": 1, "waiting": 1}
    assert (sweep.steps(), sweep.over) == ((600, 1200), False)
    (folder / "dqn-seed=0").mkdir()
    (folder / "dqn-seed=0" / "run-id").write_text("none\n")  # its run can't start
    failed = run_command("coop-sweep", "grid.toml", "--dir", folder, cwd=tmp_path, timeout=300)
    assert failed.returncode == 1
    sweep.refresh()
    assert sweep.counts() == {"finished": 1, "failed": 1}
    assert sweep.over
    (failure,) = sweep.failures()
    assert "run-id" in failure.why
    done = run_command("coop-watch", folder, cwd=tmp_path, check=True)
    flat = re.sub(r"\s+", " ", done.stdout)
    assert "2 cells: 1 finished, 1 failed; 1,200 of 1,200 steps (100%); nothing is left to do" in flat
    assert "dqn-seed=0: failed: " in flat
    told = json.loads(run_command("coop-watch", folder, "--once", "--json", check=True).stdout)
    assert [(cell["name"], cell["state"]) for cell in told["cells"]] == [
        ("coop-seed=0", "finished"), ("dqn-seed=0", "failed"),
    ]  # fmt: skip
    with closing(SweepPage(sweep, "0")) as page, urllib.request.urlopen(f"{page.url}page.json", timeout=20) as answer:
        shown = json.load(answer)
    (panel,) = shown["panels"]
    assert panel["title"] == "coop"
    (name, _, points) = panel["lines"][0]
    episodes = (folder / "coop-seed=0" / "episodes.csv").read_text().splitlines()
    assert (name, points[-1][0]) == ("seed 0", float(episodes[len(points)].split(",")[1]))
    assert shown["events"][0].startswith("dqn-seed=0: failed: ")


@pytest.mark.parametrize(
    ("flags", "words"),
    [
        (["empty"], "neither a run, with its config.toml, nor a sweep, with its sweep.toml"),
        (["nowhere"], "no such folder"),
        (["file"], "no folder"),
        (["starting", "--once"], "the run there is only starting"),
        (["empty", "--connect", "tcp/127.0.0.1:1"], "--connect: for a run that is found by its learner"),
    ],
)
def test_what_is_no_folder_of_a_run(flags: list[str], words: str, tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "file").touch()
    (tmp_path / "starting" / "logs").mkdir(parents=True)
    (tmp_path / "starting" / "logs" / "config.toml").touch()
    done = run_command("coop-watch", *flags, cwd=tmp_path)
    assert (done.returncode, done.stdout) == (2, "")
    assert words in done.stderr
    assert done.stderr.count("\n") == 1


def test_a_run_that_is_only_starting_is_waited_for(tmp_path: Path) -> None:
    run_command("coop-lockstep", "--total-steps=60", "--network.hidden=8", f"--run-dir={tmp_path / 'run'}", check=True)
    (tmp_path / "run" / "logs").mkdir()
    (tmp_path / "run" / "logs" / "config.toml").touch()
    (tmp_path / "run" / "config.toml").rename(tmp_path / "config.toml")
    with Command("coop-watch", "run", cwd=tmp_path) as watching:
        wait_until(lambda: "only starting" in "".join(watching.output()))
        (tmp_path / "config.toml").rename(tmp_path / "run" / "config.toml")
        assert watching.wait(60) == 0
        assert "60/60" in "".join(watching.output())
