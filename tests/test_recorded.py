"""Recorded updates: the eager ones, with nothing of the host in between; on a CPU the recording is a plain call."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import msgspec
import numpy as np
import pytest
import torch
from samples import make_segment
from torch.utils._python_dispatch import TorchDispatchMode

from coop.common.settings.tables import resolve
from coop.common.transitions import Batch
from coop.common.types import EnvSpec
from coop.learner.agent import Agent
from coop.learner.diagnostics import Diagnostics
from coop.learner.recorded import _WARM_UPS
from coop.replay.table.table import Table

PICTURES = EnvSpec("pictures", (36, 36), "uint8", 4, 5)
ON_HOST = ("_local_scalar_dense", "nonzero", "masked_select", "_to_copy", "item", "is_nonzero", "equal")


def plain_call(function: Callable[[], None], device: torch.device) -> Callable[[], None]:
    """The function itself, after the runs that recording needs."""
    for _ in range(_WARM_UPS):
        function()
    return function


def make_agent(method: str, device: str = "cpu", capture: Any = None, **tables: dict[str, Any]) -> Agent:
    """An agent of pictures whose network is too large for numpy."""
    learner = {"swap_every": 7, "optimizer": "adam", "learning_rate": 1e-4, "device": device, "tf32": False}
    given = {"learner": learner | tables.pop("learner", {}), "network": {"kind": "nips2013"}, **tables}
    return Agent(resolve(given, method), PICTURES, capture)


def make_batches(count: int, spec: EnvSpec = PICTURES, size: int = 32) -> list[Batch]:
    """Draws from a table of transitions, some of which end an episode."""
    rng, table = np.random.default_rng(0), Table(spec, 64, rng=np.random.default_rng(1))
    index = np.arange(8)[:, None] + np.arange(spec.stack)
    for sequence in range(8):
        changes: dict[str, Any] = {
            "frames": rng.integers(256, size=(8 + spec.stack, *spec.frame_shape)).astype(np.uint8),
            "actions": rng.integers(spec.num_actions, size=8, dtype=np.int32),
            "terminated": rng.random(8) < 0.2,
            "rewards": rng.random(8, np.float32),
        }
        changes |= {"obs_index": index.astype(np.int32), "next_index": (index + 1).astype(np.int32), "carried": 0}
        table.insert(make_segment(spec, sequence, 8, **changes))
    return [table.sample(size) for _ in range(count)]


def assert_equal(one: Agent, other: Agent, **tolerance: float) -> None:
    """Both have the same parameters, optimizers and counters."""
    for first, second in zip(one.networks, other.networks, strict=True):
        torch.testing.assert_close(first.flat, second.flat, **(tolerance or {"rtol": 0, "atol": 0}))
    assert one.updates == other.updates
    assert [each.steps for each in one.optimizers] == [each.steps for each in other.optimizers]


@pytest.mark.parametrize("method", ["dqn", "edql", "g-coop", "coop"])
@pytest.mark.parametrize("tables", [{}, {"edl": {"noise": "normal"}, "learner": {"weight_decay": [0.01]}}], ids=str)
def test_recorded_updates_are_the_eager_ones(method: str, tables: dict[str, Any]) -> None:
    eager, recorded = make_agent(method, **tables), make_agent(method, capture=plain_call, **tables)
    assert recorded.eager == ""
    for batch in make_batches(20):
        expected, found = eager.update(batch), recorded.update(batch)
        np.testing.assert_allclose(found.td_errors, expected.td_errors, rtol=1e-4, atol=1e-6)
        assert (found.s, found.swapped) == (expected.s, expected.swapped)
    # s and the rate are float32 there
    assert_equal(recorded, eager, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("method", ["dqn", "coop"])
@pytest.mark.parametrize("capture", [plain_call, None], ids=["recorded", "eager"])
def test_updates_from_frames_on_the_device_are_those_from_frames_of_the_host(method: str, capture: Any) -> None:
    """The rows of the mirror change between updates, and some batches bring their own frames."""
    one, other = (make_agent(method, capture=capture) for _ in range(2))
    mirror = torch.zeros(500, *PICTURES.frame_shape, dtype=torch.uint8)
    rng = np.random.default_rng(3)
    for number, batch in enumerate(make_batches(12)):
        slots = rng.permutation(500)[: len(batch.frames)].astype(np.int32)
        mirror[torch.from_numpy(slots).long()] = torch.tensor(batch.frames)
        there = msgspec.structs.replace(
            batch, frames=mirror, obs_index=slots[batch.obs_index], next_index=slots[batch.next_index]
        )
        expected, found = one.update(batch), other.update(there if number % 3 else batch)
        np.testing.assert_array_equal(found.td_errors, expected.td_errors)
    assert_equal(one, other)
    assert other.eager == ""


def test_the_archive_of_the_diagnostics_holds_frames_of_the_host() -> None:
    (batch,) = make_batches(1)
    there = msgspec.structs.replace(batch, frames=torch.tensor(batch.frames))
    one, other = Diagnostics(), Diagnostics()
    one.add(batch)
    other.add(there)
    assert one.archive is not None
    assert other.archive is not None
    np.testing.assert_array_equal(other.archive.frames, one.archive.frames)
    assert isinstance(other.archive.frames, np.ndarray)


@pytest.mark.parametrize("method", ["dqn", "coop"])
def test_hundreds_of_recorded_updates_are_the_eager_ones(method: str) -> None:
    tables = {"learner": {"optimizer": "adam", "eps": 1e-3, "learning_rate": 1e-5, "swap_every": 100, "batch_size": 4}}
    eager, recorded = make_agent(method, **tables), make_agent(method, capture=plain_call, **tables)
    begun = [network.snapshot() for network in eager.networks]
    batches = make_batches(20, size=4)
    for number in range(400):
        expected, found = (agent.update(batches[number % 20]) for agent in (eager, recorded))
        assert (found.s, found.swapped) == (expected.s, expected.swapped)
    np.testing.assert_allclose(found.td_errors, expected.td_errors, rtol=1e-3, atol=1e-4)
    for one, other, start in zip(recorded.networks, eager.networks, begun, strict=True):
        went, apart = other.snapshot() - start, one.snapshot() - other.snapshot()
        assert np.linalg.norm(apart) < 1e-3 * np.linalg.norm(went)
    assert [each.steps for each in recorded.optimizers] == [each.steps for each in eager.optimizers]


def test_a_recorded_agent_is_saved_and_restored() -> None:
    one, other = make_agent("coop", capture=plain_call), make_agent("coop", capture=plain_call)
    *first, last = make_batches(10)
    for batch in first:
        one.update(batch)
    other.load_state(one.state())
    np.testing.assert_array_equal(one.update(last).td_errors, other.update(last).td_errors)
    assert_equal(one, other)


def test_td_errors_may_be_read_long_after() -> None:
    eager, recorded = make_agent("coop"), make_agent("coop", capture=plain_call)
    batches = make_batches(70)  # more than there are places for
    updates = [recorded.update(batch) for batch in batches]
    for batch, update in zip(batches, updates, strict=True):
        np.testing.assert_allclose(update.td_errors, eager.update(batch).td_errors, rtol=1e-5, atol=1e-6)


def test_a_batch_of_another_size_is_led_by_the_host() -> None:
    eager, recorded = make_agent("dqn"), make_agent("dqn", capture=plain_call)
    for batch in (*make_batches(1), *make_batches(1, size=9)):
        np.testing.assert_allclose(recorded.update(batch).td_errors, eager.update(batch).td_errors, rtol=1e-6)


def test_a_failed_recording_is_told_and_leaves_the_agent_as_it_was(capsys: pytest.CaptureFixture[str]) -> None:
    def fail(function: Any, device: torch.device) -> Any:
        function()
        raise RuntimeError("operation not permitted when stream is capturing\nmore")

    eager, recorded = make_agent("coop"), make_agent("coop", capture=fail)
    for batch in make_batches(2):
        np.testing.assert_array_equal(recorded.update(batch).td_errors, eager.update(batch).td_errors)
    assert_equal(recorded, eager)
    printed = capsys.readouterr().err
    assert printed.count("\n") == 1
    assert "RuntimeError: operation not permitted when stream is capturing" in printed


@pytest.mark.parametrize(
    ("method", "tables", "reason"),
    [
        (
            "coop",
            {"edl": {"feedback": "weight-gradient"}},
            "edl.feedback = 'weight-gradient' decomposes matrices on the host",
        ),
        ("medqn", {}, "the rule of medqn uses the host"),
    ],
)
def test_what_is_not_recorded(method: str, tables: dict[str, Any], reason: str) -> None:
    learner = {"device": "cpu"}
    agent = Agent(
        resolve({"network": {"kind": "nips2013"}, "learner": learner, **tables}, method), PICTURES, plain_call
    )
    assert agent.eager == reason
    assert make_agent("coop").eager == ""
    vectors = EnvSpec("vectors", (4,), "float32", 1, 2)
    small = Agent(resolve({"network": {"kind": "mlp"}}, method), vectors, plain_call)
    assert small.eager == "the network is small and runs in numpy"


class _Watch(TorchDispatchMode):
    """Notes the operations by which values would come to the host, or be asked for."""

    def __init__(self) -> None:
        super().__init__()
        self.seen: list[str] = []

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        name = func.name().removeprefix("aten::").partition(".")[0]
        moved = name == "_to_copy" and (kwargs or {}).get("device") is not None
        if name in ON_HOST and (name != "_to_copy" or moved):
            self.seen.append(func.name())
        return func(*args, **(kwargs or {}))


@pytest.mark.parametrize("method", ["dqn", "edql", "g-coop", "coop"])
@pytest.mark.parametrize("loss", ["huber", "squared"])
@pytest.mark.parametrize("feedback", ["transform", "random"])
def test_an_update_asks_the_host_for_nothing(method: str, loss: str, feedback: str) -> None:
    settings = {"double": True, "loss": loss, "reward_bound": 1.0, "weight_decay": [0.01]}
    agent = make_agent(method, capture=plain_call, learner=settings, edl={"feedback": feedback})
    batch = make_batches(1)[0]
    agent.update(batch)
    assert agent._recorded is not None
    with torch.inference_mode(), _Watch() as watch:
        agent._learn(0, agent._recorded._feed_of(batch).given)
    assert watch.seen == []
