"""What can't be played or held is refused at the start, in one line with the numbers, through the console command."""

import os
from pathlib import Path

import pytest
from commands import run_command


@pytest.mark.parametrize(
    ("flags", "words"),
    [
        ("--env.id brekout", ["env.id", "unknown game 'brekout'", "breakout"]),
        ("--env.id Blackjack-v1", ["env.id", "observation space Tuple", "allowed is a Box"]),
        ("--env.id CartPole-v0", ["network.kind = 'nature': needs pictures; CartPole-v0 has frames [4]"]),
        (
            "--replay.capacity 1000000000 --total-steps 1000000000",
            ["replay.capacity = 1,000,000,000: needs up to 6647.8 GiB, this machine has"],
        ),
        ("--actors 0", ["--actors 0: must be at least 1, or 0 with --listen"]),
        ("--actors=-1 --listen tcp/127.0.0.1:0", ["--actors -1: must be at least 1, or 0 with --listen"]),
    ],
)
def test_refused(flags: str, words: list[str], tmp_path: Path) -> None:
    check(flags.split(), tmp_path / "run", words)


def test_more_actors_than_the_memory_holds_are_refused(tmp_path: Path) -> None:
    line = "--actors 4: need 0.1 GiB and more; Slurm's job has (SLURM_MEM_PER_NODE) 0.1 GiB"
    check(["--actors", "4"], tmp_path / "run", [line], {"SLURM_MEM_PER_NODE": "100"})


def test_a_missing_rom_is_refused(tmp_path: Path) -> None:
    check([], tmp_path / "run", ["the ROM of 'breakout'"], {"ALE_ROMS_DIR": str(tmp_path)})


def check(flags: list[str], run_dir: Path, words: list[str], environment: dict[str, str] | None = None) -> None:
    variables = {**os.environ, **(environment or {})}
    done = run_command("coop-local", "--preset", "breakout", *flags, "--run-dir", run_dir, environment=variables)
    assert done.returncode == 2, done.stderr
    assert done.stderr.count("\n") == 1
    assert done.stderr.startswith("coop-local: error: ")
    assert not [word for word in words if word not in done.stderr], done.stderr
    assert not run_dir.exists() or "learner ended" in done.stderr, "anything else is found before the start"
