"""The parts of `gpu.py` beyond updates: acting, the tests, and a whole run over processes."""

from __future__ import annotations

import argparse
import json
import os
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from gpu_figures import figure, per_second


def part_acting(options: argparse.Namespace) -> None:
    """Decisions/s of the nature network for 64 emulators; steps/s of two groups of them, with it and without."""
    import numpy as np
    from work import ATARI

    from coop.actors.player import Player
    from coop.actors.policy import EpsilonGreedy
    from coop.common.envs.make import make_vector_env
    from coop.common.networks.acting import acting_network
    from coop.common.settings.config import NetworkSettings
    from coop.common.settings.tables import load_tables, resolve

    game, nature = resolve(load_tables("breakout", None) | {"methods": {}}, "dqn").env, NetworkSettings("nature")
    network = acting_network(nature, ATARI, options.device)
    obs = np.random.default_rng(0).integers(0, 256, (64, 4, 84, 84)).astype(np.uint8)
    rate = per_second(lambda: network.q_values(obs, ATARI).argmax(1), 0.2 if options.quick else 1.5, options.device, 64)
    figure(what="decisions/s", emulators=64, value=rate)
    each = 2 if options.quick else 32
    for greedy in (False, True, False, True, False, True):
        envs = [make_vector_env(game, each, group) for group in range(2)]
        acts = acting_network(nature, envs[0].spec, options.device)
        policy = EpsilonGreedy((acts, acts), envs[0].spec, np.random.default_rng(0))
        players = [Player(env, policy, lambda _, greedy=greedy: 0.05 if greedy else 1.0) for env in envs]
        for player in players:
            player.begin()
            player.send(0, 0)

        def turn(players: list[Player] = players) -> None:
            for player in players:
                player.recv()
                player.send(0, 0)

        rate = per_second(turn, 0.5 if options.quick else 2.0, "cpu", 2 * each)
        what = "steps/s, the network acts" if greedy else "steps/s, emulators alone"
        figure(what=what, emulators=2 * each, value=rate)
        for player, env in zip(players, envs, strict=True):
            player.recv()
            env.close()


def part_tests(options: argparse.Namespace) -> None:
    """The tests of a GPU, and those of recorded updates."""
    tests = ["tests/test_recorded.py"] if options.device == "cpu" else ["tests/test_cuda.py", "tests/test_recorded.py"]
    command = [
        sys.executable,
        "-m",
        "pytest",
        "-q",
        "-x" if options.quick else "--maxfail=20",
        "-p",
        "no:cacheprovider",
    ]
    done = subprocess.run([*command, *tests], capture_output=True, text=True, check=False)
    (options.out / "tests.txt").write_text(done.stdout[-40_000:] + done.stderr[-10_000:])
    figure(what="tests", status=done.returncode, last=done.stdout.strip().splitlines()[-1] if done.stdout else "")
    for line in re.findall(r"^(?:FAILED|ERROR) .*", done.stdout, re.MULTILINE)[:12]:
        figure(what="tests", failed=line[:200])


def part_run(options: argparse.Namespace) -> None:
    """A whole run of Breakout over processes."""
    seconds = 20 if options.quick else 60
    actors = max(1, min(10, (os.cpu_count() or 2) - 4))
    with tempfile.TemporaryDirectory() as folder:
        flags = [
            "--preset",
            "breakout",
            "--method",
            "coop",
            "--learner.device",
            options.device,
            "--total-steps",
            "100000000",
        ]
        flags += ["--replay.learning-starts", "1000", "--replay.capacity", "10000", "--actors", str(actors)]
        if options.quick:
            flags += ["--network.kind", "nips2013"]
        command = [sys.executable, "-m", "coop.deploy.commands", "coop-local", *flags, "--run-dir", f"{folder}/run"]
        process = subprocess.Popen(command, stdout=sys.stderr, stderr=subprocess.STDOUT)
        busy, rows = [], []
        began = time.monotonic()
        metrics = Path(folder, "run", "metrics.jsonl")
        while time.monotonic() - began < seconds and process.poll() is None:
            time.sleep(1)
            if options.device != "cpu":
                busy.append(_busy())
        if metrics.exists():
            rows = [json.loads(line) for line in metrics.read_text().splitlines()]
        process.send_signal(2)
        try:
            process.wait(25)
        except subprocess.TimeoutExpired:
            process.kill()
        for log in sorted(Path(folder, "run", "logs").glob("*.log")):
            print(f"--- {log.name}", log.read_text(errors="replace")[-1500:], file=sys.stderr)
        later = rows[len(rows) // 2 :]
        mean = lambda name: round(sum(row[name] for row in later) / max(1, len(later)), 1)  # noqa: E731
        figure(
            what="run", rows=len(rows), actors=actors,
            **{name: mean(name) for name in ("updates_per_s", "env_steps_per_s", "weight_lag_mean") if later},
            gpu_busy=round(sum(busy[len(busy) // 2 :]) / len(busy[len(busy) // 2 :]), 1) if busy else None,
        )  # fmt: skip


def _busy() -> float:
    command = ["nvidia-smi", "--query-gpu=utilization.gpu", "--format=csv,noheader,nounits"]
    try:
        return float(subprocess.run(command, capture_output=True, text=True, check=True, timeout=5).stdout.split()[0])
    except (OSError, subprocess.SubprocessError, ValueError, IndexError):
        return float("nan")
