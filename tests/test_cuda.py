"""The learner on a GPU: the updates, states and runs of a CPU. Skipped where PyTorch finds no GPU."""

import gc
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from commands import run_command
from samples import make_segment

from coop.common.messaging.messages.sample import NamedBatch
from coop.common.settings.tables import resolve
from coop.common.transitions import Batch
from coop.common.types import EnvSpec
from coop.learner.agent import Agent
from coop.learner.device_mirror import DeviceMirror
from coop.learner.device_table import DeviceTable
from coop.learner.edl import kernels
from coop.learner.edl.completed import Jacobians
from coop.learner.recorded import captured
from coop.replay.table.table import Table
from results.cartpole.edl.dissect import AGREE, agreement

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


def _agent(device: str, kind: str, spec: EnvSpec, method: str, **tables: dict[str, Any]) -> Agent:
    tables["learner"] = {
        "swap_every": 3,
        "learning_rate": 1e-4,
        "device": device,
        "tf32": False,
        **tables.get("learner", {}),
    }
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


def test_bfloat16() -> None:
    host = _agent("cpu", "nature", PICTURES, "coop")
    device = _agent("cuda", "nature", PICTURES, "coop", network={"dtype": HALF})
    for batch in _batches(PICTURES, 3):
        np.testing.assert_allclose(device.update(batch).td_errors, host.update(batch).td_errors, atol=0.05)


@pytest.mark.parametrize("method", ["dqn", "edql", "g-coop", "coop"])
def test_a_thousand_recorded_updates_are_the_eager_ones(method: str) -> None:
    """The same up to rounding, for as long as rounding does not grow: SGD with a small rate."""
    tables = {"learner": {**SGD, "learning_rate": 1e-5, "swap_every": 100}}
    recorded, eager = (_agent("cuda", "nature", PICTURES, method, **tables) for _ in range(2))
    eager._recorded = None
    begun = [network.snapshot() for network in eager.networks]
    batches = _batches(PICTURES, 20)
    for number in range(1000):
        expected, found = (agent.update(batches[number % 20]) for agent in (eager, recorded))
        assert (found.s, found.swapped) == (expected.s, expected.swapped)
    assert recorded.eager == ""
    np.testing.assert_allclose(found.td_errors, expected.td_errors, rtol=1e-2, atol=1e-3)
    for one, other, start in zip(recorded.networks, eager.networks, begun, strict=True):
        went, apart = other.snapshot() - start, one.snapshot() - other.snapshot()
        assert np.linalg.norm(apart) < 1e-2 * np.linalg.norm(went)


def test_adam_is_recorded_with_its_steps_and_its_rate() -> None:
    adam = {"optimizer": "adam", "eps": 1e-3, "learning_rate_final": 0.1, "learning_rate": 1e-4}
    recorded, eager = (_agent("cuda", "nature", PICTURES, "coop", learner=adam) for _ in range(2))
    host = _agent("cpu", "nature", PICTURES, "coop", learner=adam)
    eager._recorded = None
    for batch in _batches(PICTURES, 8):
        for agent in (recorded, eager, host):
            agent.update(batch)
    assert [each.steps for each in recorded.optimizers] == [each.steps for each in host.optimizers] == [5, 3]
    for optimizer in recorded.optimizers:
        assert float(optimizer._count) == optimizer.steps
    _assert_same(recorded, eager)
    _assert_same(recorded, host)


def test_older_graphs_do_not_end_a_recording() -> None:
    """Agents are cycles: what collects them must not run while another one is recorded."""
    threshold = gc.get_threshold()
    gc.set_threshold(1)
    try:
        for method in ("coop", "dqn", "coop", "edql"):
            agent = _agent("cuda", "nips2013", PICTURES, method)
            for batch in _batches(PICTURES, 4):  # two recordings with two networks
                agent.update(batch)
            assert agent.eager == ""
    finally:
        gc.set_threshold(*threshold)


def test_after_a_failed_recording_the_gpu_is_usable() -> None:
    """What can't be recorded ends with an error, and random numbers, streams and other recordings go on as before."""
    device, stream = torch.device("cuda"), torch.cuda.current_stream()
    x = torch.ones(4, device=device)
    for fail in (lambda: x.sum().item(), torch.cuda.synchronize):
        with pytest.raises(RuntimeError):
            captured(lambda fail=fail: (torch.rand(4, device=device), fail()), device)
        assert torch.cuda.current_stream() == stream
        assert gc.isenabled()
        assert float(torch.rand(4, device=device).sum()) > 0
        again = captured(lambda: x.mul_(2), device)
        before = x.clone()
        again()
        assert torch.equal(x, 2 * before)


def test_branches_change_no_update() -> None:
    branched, plain = (_agent("cuda", "nature", PICTURES, "coop", learner=SGD) for _ in range(2))
    plain._recorded._capture = lambda f, device: (f(), captured(f, device))[1]
    for batch in _batches(PICTURES, 12):
        for agent in (branched, plain):
            agent.update(batch)
    _assert_same(branched, plain)


def test_updates_from_a_mirror_on_the_gpu_are_those_from_frames_of_the_host() -> None:
    """Its rows change behind updates that the GPU has not done yet; more frames arrive than one write takes."""
    one, other = (_agent("cuda", "nature", PICTURES, "coop", learner=SGD) for _ in range(2))
    mirror, rng = DeviceMirror(PICTURES, 400, torch.device("cuda")), np.random.default_rng(0)
    for number, batch in enumerate(_batches(PICTURES, 40), 1):
        count = len(batch.frames)
        slots, numbers = rng.permutation(400)[:count].astype(np.int32), 1000 * number + np.arange(count)
        mirror.write(7, slots, numbers, batch.frames)
        there = mirror.read(NamedBatch(7, "", slots, numbers, np.arange(0), batch.frames[:0], batch.columns()))
        assert there is not None
        assert isinstance(there.frames, torch.Tensor)
        one.update(batch)
        other.update(there)
    _assert_same(one, other)


def test_the_table_draws_the_same_with_a_kernel(monkeypatch: pytest.MonkeyPatch) -> None:
    table = DeviceTable(PICTURES, 300, 3, 3, 0.9, torch.device("cuda"))
    for column in (table._rewards, table._ended, table._terminated):
        column.random_(0, 2)
    table._actions.random_(0, 6)
    table.steps.fill_(150)
    torch.manual_seed(0)
    found = table.sample(500, 0.0, 0.0)
    monkeypatch.setattr(kernels, "draws", lambda *_: None)
    torch.manual_seed(0)
    expected = table.sample(500, 0.0, 0.0)
    torch.testing.assert_close(found.columns, expected.columns)
    assert torch.equal(found.index, expected.index)


def test_the_kernels_are_compiled_and_are_the_plain_ways() -> None:
    assert kernels.usable(torch.ones(1, device="cuda"))
    generator = torch.Generator().manual_seed(0)
    for actions in (2, 6, 18):
        shapes = ((3, actions, actions), (3, actions, 40), (3, actions, 5000))
        ts = [torch.randn(shape, generator=generator) for shape in shapes]
        ts[1][0] = 0
        e = torch.randn(3, actions, generator=generator)
        expected = Jacobians(ts, [None] * 3, torch.eye(actions), 3).apply(e, 0.3)
        on_gpu = [t.cuda() for t in ts]
        assert kernels.fits(on_gpu, 3)
        for found in (
            kernels.feedback(on_gpu, e.cuda(), torch.tensor(0.3, device="cuda")),
            Jacobians([t.double() for t in on_gpu], [None] * 3, torch.eye(actions).cuda(), 3).apply(
                e.cuda().double(), 0.3
            ),
        ):
            for one, other in zip(found, expected, strict=True):
                torch.testing.assert_close(one.float().cpu(), other, rtol=1e-4, atol=1e-5)
    frames = torch.randint(256, (9, 84, 84), dtype=torch.uint8, generator=generator)
    index = torch.randint(9, (12,), dtype=torch.int32, generator=generator)
    stacked = kernels.stacks(frames.cuda(), index.cuda(), 3)
    assert stacked is not None
    assert stacked.is_contiguous(memory_format=torch.channels_last)
    assert torch.equal(stacked.cpu(), frames[index.long()].view(3, 4, 84, 84) * (1 / 255))


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
