"""The learner on a GPU: the updates, states and runs of a CPU. Skipped where PyTorch finds no GPU."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from commands import run_command
from samples import make_segment

from common.settings.tables import resolve
from common.types import Batch, EnvSpec
from experiments.stacked.dissect import AGREE, agreement
from learner.agent import Agent
from replay.table.table import Table

pytestmark = [
    pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU"),
    pytest.mark.timeout(300),  # the first use of a GPU, and whole runs
]

VECTOR = EnvSpec("made-up", (4,), "float32", 1, 2)
GRIDS = EnvSpec("grids", (10, 10, 4), "bool", 1, 3)
PICTURES = EnvSpec("pictures", (84, 84), "uint8", 4, 6)
SGD = {"optimizer": "sgd"}
HALF = "bfloat16"
KINDS = [
    ("mlp", VECTOR),
    ("custom_networks:duel", VECTOR),
    ("minatar", GRIDS),
    ("nips2013", PICTURES),
    ("nature", PICTURES),
]


@pytest.fixture(autouse=True)
def full_precision(monkeypatch: pytest.MonkeyPatch) -> None:
    """Convolutions of float32 use TF32, with 10 bits of mantissa, unless told otherwise."""
    monkeypatch.setattr(torch.backends.cudnn, "allow_tf32", False)


def _agent(device: str, kind: str, spec: EnvSpec, method: str, **tables: dict[str, Any]) -> Agent:
    tables["learner"] = {"swap_every": 3, "learning_rate": 1e-4, "device": device, **tables.get("learner", {})}
    tables["network"] = {"kind": kind, "hidden": [32, 32], **tables.get("network", {})}
    return Agent(resolve(tables, method), spec)


def _both(kind: str, spec: EnvSpec, method: str, **tables: dict[str, Any]) -> tuple[Agent, Agent]:
    """The same agent on the CPU and on the GPU."""
    host, device = (_agent(name, kind, spec, method, **tables) for name in ("cpu", "cuda"))
    return host, device


def _batches(spec: EnvSpec, count: int) -> list[Batch]:
    rng = np.random.default_rng(0)
    table = Table(spec, 64, rng=rng)
    top = {"uint8": 256, "bool": 2}.get(spec.frame_dtype)
    index = np.arange(8)[:, None] + np.arange(spec.stack)
    for sequence in range(8):
        shape = (8 + spec.stack, *spec.frame_shape)
        frames = rng.standard_normal(shape) if top is None else rng.integers(top, size=shape)
        changes: dict[str, Any] = {
            "frames": frames.astype(spec.frame_dtype),
            "actions": rng.integers(spec.num_actions, size=8, dtype=np.int32),
        }
        changes |= {"obs_index": index.astype(np.int32), "next_index": (index + 1).astype(np.int32), "carried": 0}
        table.insert(make_segment(spec, sequence, 8, rewards=rng.random(8, np.float32), **changes))
    return [table.sample(32) for _ in range(count)]


def _assert_same(one: Agent, other: Agent) -> None:
    for first, second in zip(one.networks, other.networks, strict=True):
        np.testing.assert_allclose(first.snapshot(), second.snapshot(), rtol=1e-3, atol=2e-5)


@pytest.mark.parametrize("method", ["dqn", "edql", "g-coop", "coop", "medqn"])
@pytest.mark.parametrize(("kind", "spec"), KINDS, ids=[kind for kind, _ in KINDS])
def test_updates_are_those_of_the_processor(kind: str, spec: EnvSpec, method: str) -> None:
    host, device = _both(kind, spec, method, learner=SGD)
    assert device.networks[0].flat.is_cuda
    for batch in _batches(spec, 7):  # two swaps
        expected, found = host.update(batch), device.update(batch)
        np.testing.assert_allclose(found.td_errors, expected.td_errors, rtol=1e-3, atol=1e-4)
        assert found.swapped == expected.swapped
    _assert_same(device, host)


@pytest.mark.parametrize("optimizer", ["rmsprop", "rmsprop-mnih", "adam"])
def test_every_optimizer_and_weight_decay(optimizer: str) -> None:
    settings = {"optimizer": optimizer, "eps": 1e-2, "weight_decay": [0.01]}
    host, device = _both("nips2013", PICTURES, "coop", learner=settings)
    for batch in _batches(PICTURES, 4):
        host.update(batch)
        device.update(batch)
    _assert_same(device, host)


@pytest.mark.parametrize("feedback", ["random", "weight-gradient"])
def test_every_feedback(feedback: str) -> None:
    host, device = _both("nips2013", PICTURES, "coop", learner=SGD, edl={"feedback": feedback})
    for batch in _batches(PICTURES, 2):
        host.update(batch)
        device.update(batch)
    _assert_same(device, host)


@pytest.mark.parametrize("tables", [{"network": {"dtype": HALF}}, {"edl": {"polar_dtype": HALF}}], ids=str)
def test_bfloat16(tables: dict[str, dict[str, Any]]) -> None:
    host, device = _agent("cpu", "nature", PICTURES, "coop"), _agent("cuda", "nature", PICTURES, "coop", **tables)
    for batch in _batches(PICTURES, 3):
        np.testing.assert_allclose(device.update(batch).td_errors, host.update(batch).td_errors, atol=0.05)


def test_a_state_moves_between_processor_and_gpu() -> None:
    adam = {"optimizer": "adam", "eps": 1e-2}
    host, device = _both("nips2013", PICTURES, "coop", learner=adam)
    again = _agent("cuda", "nips2013", PICTURES, "coop", learner=adam)
    *first, last = _batches(PICTURES, 4)
    for batch in first:
        device.update(batch)
    host.load_state(device.state())
    again.load_state(host.state())
    for agent in (host, device, again):
        agent.update(last)
    _assert_same(host, device)
    _assert_same(again, device)


def test_a_run_is_resumed_and_evaluated(tmp_path: Path) -> None:
    run = tmp_path / "run"
    settings = ["--preset", "catch", "--learner.device", "cuda", "--total-steps", "1500"]
    run_command("coop-local", *settings, "--run-dir", run, check=True)
    run_command("coop-local", "--resume", "--run-dir", run, "--total-steps", "2000", check=True)
    summary = json.loads((run / "summary.json").read_text())
    assert (summary["env_steps"], summary["exit"]) == (2000, "complete")
    assert str(summary["updates"]) in run_command("coop-eval", run, "--episodes", "2", check=True).stdout


@pytest.mark.parametrize("condition", ["none", "transform", "matched", "noise", "random"])
def test_stacked_kernels_are_pytorchs_operations(condition: str) -> None:
    pytest.importorskip("triton")
    assert agreement(condition, width=32, precision="tf32x3") < AGREE
