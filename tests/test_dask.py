"""Sweeps on a Dask cluster: runs outlive their workers, Ctrl-C stops them, and what is wrong is said in one line."""

import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from commands import Command, run_command

from coop.studies.sweep.cli import main

pytestmark = pytest.mark.timeout(300)
GRID = 'methods = ["dqn"]\nseeds = {seeds}\n[fixed]\ntotal_steps = {steps}\n'
CLUSTER = """
import sys
from distributed import LocalCluster

with LocalCluster(n_workers=1, threads_per_worker=1, processes=False, host="127.0.0.1", protocol="tcp://",
                  dashboard_address=None) as cluster:
    print(cluster.scheduler_address, flush=True)
    for line in sys.stdin:
        cluster.scale(int(line))
"""


@pytest.fixture
def cluster() -> Iterator[subprocess.Popen[str]]:
    """A scheduler with one worker; prints its address, and reads how many workers it is to have."""
    pytest.importorskip("distributed", reason="needs the extra dask")
    with subprocess.Popen(
        [sys.executable, "-c", CLUSTER], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        yield process
        assert process.stdin is not None
        process.stdin.close()
        assert process.wait(60) == 0


def wait_for(command: Command, condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 200
    while not condition():
        assert command.returncode is None, command.output()
        assert time.monotonic() < deadline, command.output()
        time.sleep(0.05)


def test_a_run_goes_on_after_its_worker_and_stops_at_ctrl_c(cluster: subprocess.Popen[str], tmp_path: Path) -> None:
    (tmp_path / "g.toml").write_text(GRID.format(seeds=[0], steps=1_000_000))
    assert cluster.stdin is not None
    assert cluster.stdout is not None
    flags = (tmp_path / "g.toml", "--dask", cluster.stdout.readline().strip(), "--dir")
    run = tmp_path / "long" / "dqn-seed=0"
    nobody = Command("coop-sweep", flags[0], "--dir", tmp_path / "none", "--dask", "tcp://127.0.0.1:1")
    command = Command("coop-sweep", *flags, run.parent)
    wait_for(command, (run / "episodes.csv").exists)
    print(0, file=cluster.stdin, flush=True)
    wait_for(command, lambda: "\nworkers: 0, threads: 0; gone: tcp://127.0.0.1:" in command.output()[0])
    print(1, file=cluster.stdin, flush=True)
    wait_for(command, lambda: "resuming from checkpoint" in (run / "run.log").read_text())
    command.send_signal(signal.SIGINT)
    done = command.end(200)
    assert (done.returncode, done.stderr) == (
        130,
        "coop-sweep: error: interrupted with 0 of 1 cells finished, 0 running, 1 waiting; time left not known yet; "
        "the same command goes on from here\n",
    )
    assert (run / "run.log").read_text().splitlines()[-1].startswith(("interrupted: ", "coop-lockstep: interrupted"))

    # The worker is free again: one cell ends well, the other one can't begin.
    (tmp_path / "g.toml").write_text(GRID.format(seeds=[0, 1], steps=200))
    broken = tmp_path / "short" / "dqn-seed=1" / ".learner.lock"
    broken.mkdir(parents=True)
    done = run_command("coop-sweep", *flags, tmp_path / "short", timeout=200)
    assert done.stderr == "coop-sweep: error: 1 of 2 cells failed; the same command tries them again\n"
    assert "\ndqn-seed=0: return " in done.stdout
    why = f"run directory {broken.parent}: Is a directory, on {socket.gethostname()}"
    assert f"failed: dqn-seed=1: {why}\n" in done.stdout

    done = nobody.end(200)
    assert (done.returncode, done.stdout, done.stderr) == (
        1,
        "",
        "coop-sweep: error: --dask tcp://127.0.0.1:1: no Dask scheduler answers there within 10 s\n",
    )


@pytest.mark.parametrize(
    ("address", "words"),
    [
        ("head:8786", "not an address; allowed: tcp://HOST:PORT and tls://HOST:PORT"),
        ("tcp://head", "not an address; allowed: "),
        ("tls://head:8786", "Dask's settings name no certificates"),
    ],
)
def test_an_address_that_is_none_is_refused_in_one_line(
    address: str, words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("distributed", reason="needs the extra dask")
    assert refused(tmp_path, monkeypatch, capsys, "--dask", address).startswith(f"--dask {address}: {words}")


def test_what_dask_needs_is_checked_first(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    flags = ("--dask", "tcp://head:8786")
    assert refused(tmp_path, monkeypatch, capsys, *flags, "--slurm") == "--dask and --slurm: give one of them\n"
    monkeypatch.setitem(sys.modules, "distributed", None)
    printed = refused(tmp_path, monkeypatch, capsys, *flags)
    assert printed == "--dask: needs the extra 'dask': pip install 'coop-rl[dask]'\n"


def refused(folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], *flags: str) -> str:
    """What a sweep with these flags says, in one line, before it ends with an error."""
    (folder / "g.toml").write_text(GRID.format(seeds=[0], steps=200))
    monkeypatch.setattr("sys.argv", ["coop-sweep", str(folder / "g.toml"), "--dir", str(folder / "d"), *flags])
    with pytest.raises(SystemExit):
        main()
    printed = capsys.readouterr()
    assert printed.out == ""
    assert printed.err.count("\n") == 1
    return printed.err.removeprefix("coop-sweep: error: ")


def test_other_versions_are_named() -> None:
    dask = pytest.importorskip("coop.studies.sweep.dask", reason="needs the extra dask", exc_type=ImportError)
    here = {"packages": {"python": "3.11.7.final.0", "dask": "2026.8.0", "distributed": "2026.8.0", "coop-rl": "0.2.0"}}

    def other(**packages: str | None) -> dict[str, object]:
        return {"packages": {**here["packages"], **packages}}

    patch = other(python="3.11.2.final.0")
    for scheduler, workers, words in (
        (here, {"tcp://a:1": patch}, None),
        (other(dask="2026.7.0"), {}, "dask is 2026.7.0 at the scheduler, 2026.8.0 here"),
        (here, {"tcp://a:1": other(**{"coop-rl": None})}, "coop-rl is missing at tcp://a:1, 0.2.0 here"),
        (here, {"tcp://a:1": other(python="3.12.1.final.0")}, "python is 3.12 at tcp://a:1, 3.11 here"),
    ):
        assert dask.difference({"client": here, "scheduler": scheduler, "workers": workers}) == words
