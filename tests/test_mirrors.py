"""What leaves a run for Prometheus and for Weights & Biases, and what is refused where they are not installed."""

import json
import socket
import struct
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import pytest
from commands import run_command
from msgspec.structs import replace
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from test_screen import STATUS

from coop.common.errors import UsageError
from coop.common.messaging.messages.status import LearnerStatus
from coop.common.process.extras import check_extra
from coop.common.process.processes import free_endpoint
from coop.lockstep.lockstep import Lockstep
from coop.records.run_directory import RunDirectory
from coop.records.sources import base_config
from website.assemble import assembled

PAGE = assembled("docs/watching.md")
BLOCK, HEADER = 32768, 7  # bytes, of the log in which wandb keeps its records


def test_a_status_for_prometheus() -> None:
    pytest.importorskip("prometheus_client", reason="needs the extra prometheus")
    from prometheus_client.parser import text_string_to_metric_families  # noqa: PLC0415

    from coop.monitor.exporter import exported  # noqa: PLC0415

    status: LearnerStatus | None = None

    def scrape() -> dict[str, float]:
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics", timeout=20) as answer:
            families = list(text_string_to_metric_families(answer.read().decode()))
        samples = [sample for family in families for sample in family.samples]
        assert not [sample.name for sample in samples if f"`{sample.name}`" not in PAGE], "docs/watching.md lists all"
        own = {"env": "CartPole-v1", "method": "coop", "seed": "0"}
        assert all(own.items() <= sample.labels.items() for sample in samples)
        return {" ".join([s.name, *(v for k, v in sorted(s.labels.items()) if k not in own)]): s.value for s in samples}

    with exported("0", lambda: status) as port:
        assert scrape() == {}, "before the first status"
        status = replace(STATUS, missing=["actor 2 on node2 (pid 44)"])
        told = scrape()
        with pytest.raises(UsageError, match=f"--prometheus {port}: Address already in use"), exported(str(port), dict):
            pass
        status = replace(STATUS, ratio=None, measured=None, waits=[], env_steps=31_290)
        fewer = scrape()
    assert told["coop_env_steps_total"] == 31_240
    assert told["coop_return_mean_100"] == 187.43
    assert (told["coop_members actor"], told["coop_members_lost"]) == (2, 1)
    assert (told["coop_ratio_measured"], told["coop_ratio_most"]) == (0.998, 80)
    assert (told["coop_q_abs_mean"], told["coop_q_bound"]) == (42.13, 100)
    assert told["coop_wait_share the learner actors"] == 0.63
    assert told["coop_evicted_unsampled"] == 0, "which is not unknown"
    assert fewer["coop_env_steps_total"] == 31_290
    assert not [name for name in fewer if name.startswith(("coop_ratio", "coop_q", "coop_wait"))]


def records(path: Path) -> Iterator[bytes]:
    """The records of wandb's file: a log of blocks, in which a record may be split into several parts."""
    data, record = path.read_bytes()[7:], b""  # after its own header
    at = HEADER
    while at - HEADER < len(data):
        left = BLOCK - at % BLOCK
        if left < HEADER:
            at += left
            continue
        _, size, kind = struct.unpack_from("<IHB", data, at - HEADER)
        record += data[at : at + size]
        at += HEADER + size
        if kind in (1, 4):  # whole, or the last part
            yield record
            record = b""


def test_weights_and_biases_gets_tensorboards_scalars(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    wandb = pytest.importorskip("wandb", reason="needs the extra wandb")
    from wandb.proto.wandb_internal_pb2 import Record  # noqa: PLC0415

    monkeypatch.setenv("WANDB_MODE", "offline")
    run = Lockstep(base_config(["--method", "coop"]))
    with RunDirectory(tmp_path, run.config, wandb=True) as directory:
        rows = 0
        while rows < 2:
            for effects in run.play():
                directory.record(effects.episodes, effects.metrics)
                rows += bool(effects.metrics)
    wandb.teardown()
    run.env.close()
    board = EventAccumulator(str(tmp_path / "tb"), size_guidance={"scalars": 0}).Reload()
    expected = {(tag, e.step): e.value for tag in board.Tags()["scalars"] for e in board.Scalars(tag)}
    (file,) = tmp_path.glob("wandb/offline-run-*/*.wandb")
    told, settings = {}, {}
    for data in records(file):
        record = Record.FromString(data)
        row = {item.key or item.nested_key[0]: json.loads(item.value_json) for item in record.history.item}
        told |= {(tag, row["env_step"]): value for tag, value in row.items() if "/" in tag}
        settings |= {item.key: json.loads(item.value_json) for item in record.config.update}
    assert told == pytest.approx(expected)
    assert settings["replay.capacity"] == run.config.replay.capacity


def test_what_is_not_installed_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    check_extra("--json", "json", "json")
    with pytest.raises(UsageError, match=r"^--x: needs the extra 'x': pip install 'coop-rl\[x\]'$"):
        check_extra("--x", "x", "no_such_module")


def test_flags_are_refused_before_anything_starts(tmp_path: Path) -> None:
    done = run_command("coop-local", "--prometheus", "x", "--run-dir", tmp_path / "run")
    assert (done.returncode, done.stderr) == (
        2,
        "coop-local: error: --prometheus x: PORT or HOST:PORT with a port from 0 to 65535 is needed\n",
    )
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("command", "flags", "refused"),
    [
        ("coop-local", ("--prometheus", "{busy}"), "--prometheus {busy}"),
        ("coop-local", ("--web", "{free}", "--prometheus", "{free}"), "--prometheus {free}"),
        ("coop-learner", ("--prometheus", "{busy}"), "--prometheus {busy}"),
        ("coop-learner", ("--health", "{busy}"), "--health {busy}"),
        ("coop-replay", ("--health", "{busy}"), "--health {busy}"),
        ("coop-actor", ("--health", "{busy}"), "--health {busy}"),
        ("coop-router", ("--health", "{busy}"), "--health {busy}"),
    ],
)
def test_a_port_in_use_is_refused_before_anything_starts(
    tmp_path: Path, command: str, flags: tuple[str, ...], refused: str
) -> None:
    with socket.create_server(("127.0.0.1", 0)) as other:
        ports = {"busy": other.getsockname()[1], "free": free_endpoint().rpartition(":")[2]}
        done = run_command(command, *(flag.format(**ports) for flag in flags), cwd=tmp_path)
    expected = f"{command}: error: {refused.format(**ports)}: Address already in use\n"
    assert (done.returncode, done.stdout, done.stderr) == (2, "", expected)
    assert not list(tmp_path.iterdir())
