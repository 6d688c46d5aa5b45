"""The table on the networks' device: what it draws is what the emulators showed."""

from __future__ import annotations

import ctypes
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from coop.common.types import EnvSpec
from coop.learner.device_table import DeviceTable
from coop.learner.edl import kernels

SPEC = EnvSpec("pictures", (2, 3), "uint8", 4, 3)
CPU = torch.device("cpu")
GAMMA = 0.5


def _filled(rows: int, n_step: int, capacity: int = 60) -> tuple[DeviceTable, dict[str, np.ndarray]]:
    """Three emulators, `rows` steps: step t of emulator k shows pictures of 10 t + k, and chooses action t mod 3."""
    rng, streams = np.random.default_rng(0), 3
    shape = (rows, streams)
    ends = rng.random(shape) < 0.15
    outcomes = {
        "rewards": rng.random(shape).astype(np.float32),
        "terminated": (ends & (rng.random(shape) < 0.5)).astype(np.float32),
        "ended": ends.astype(np.float32),
    }
    table = DeviceTable(SPEC, capacity, streams, n_step, GAMMA, CPU)
    for t in range(rows):
        obs = (10 * t + torch.arange(streams))[:, None, None, None].expand(streams, 4, 2, 3) % 256
        terminated = torch.from_numpy(outcomes["terminated"][t])
        truncated = torch.from_numpy(outcomes["ended"][t]) - terminated
        table.show(obs.byte(), torch.from_numpy(outcomes["rewards"][t]), terminated, truncated)
        table.act(torch.full((streams,), t % 3))
    return table, outcomes


@pytest.mark.parametrize("n_step", [1, 3])
@pytest.mark.parametrize("rows", [8, 20, 25])
def test_transitions_are_the_emulators(rows: int, n_step: int) -> None:
    table, outcomes = _filled(rows, n_step)
    torch.manual_seed(0)
    given = table.sample(4000, 0.1, 0.2)
    pictures = given.frames.index_select(0, given.index).view(2, 4000, 4, 6)
    assert (pictures == pictures[:, :, :1, :1]).all()
    obs, after = pictures[:, :, 0, 0].long()
    steps, streams = (obs // 10).tolist(), (obs % 10).tolist()
    for i, (t, k) in enumerate(zip(steps, streams, strict=True)):
        assert given.columns.actions[i] == t % 3
        assert given.columns.weights[i] == 1 - outcomes["ended"][t, k]
        total, span, discount = 0.0, 0, 1.0
        for step in range(t + 1, t + n_step + 1):
            total += discount * outcomes["rewards"][step, k]
            discount, span = discount * GAMMA, span + 1
            if outcomes["ended"][step, k]:
                break
        assert given.columns.rewards[i] == pytest.approx(total, rel=1e-5)
        assert given.columns.discounts[i] == pytest.approx(discount * (1 - outcomes["terminated"][t + span, k]))
        assert after[i] == 10 * (t + span) + k
    # Every transition that is whole in the last 20 rows is drawn, and none else.
    held = min(rows, 20)
    assert set(steps) == set(range(rows - held, rows - n_step))
    assert set(streams) == {0, 1, 2}
    assert (given.s, given.rate) == (0.1, 0.2)


@pytest.mark.skipif(shutil.which("g++") is None, reason="needs g++")
def test_the_kernel_draws_the_same(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The kernel of a GPU, compiled for the processor, where a loop takes the place of its threads."""
    kernel = re.search(r'extern "C" __global__ void \S+\ndraw\(.*?\n}\n', kernels.source(2), re.DOTALL)
    assert kernel is not None
    loop = 'extern "C" void block(int b) { blockIdx.x = b; }\nextern "C" void thread(int t) { threadIdx.x = t; }\n'
    text = "struct Place { int x; } blockIdx, threadIdx;\n#define __global__\n#define __launch_bounds__(n)\n"
    (tmp_path / "draw.cpp").write_text(f"{text}#define THREADS {kernels._THREADS}\n{kernel[0]}{loop}")
    library = tmp_path / "draw.so"
    subprocess.run(["g++", "-O1", "-shared", "-fPIC", "-o", library, tmp_path / "draw.cpp"], check=True)
    host = ctypes.CDLL(str(library))

    def launch(function: Any, grid: tuple[int, int, int], *arguments: Any) -> None:
        held = [ctypes.c_void_p(one.data_ptr()) if isinstance(one, torch.Tensor) else one for one in arguments]
        for block in range(grid[0]):
            host.block(block)
            for thread in range(kernels._THREADS):
                host.thread(thread)
                host.draw(*held)

    for rows, n_step in ((8, 1), (20, 3), (25, 3), (25, 5)):
        table, _ = _filled(rows, n_step)
        torch.manual_seed(1)
        expected = table.sample(500, 0.1, 0.2)
        with monkeypatch.context() as patched:
            patched.setattr(kernels, "usable", lambda _: True)
            patched.setattr(kernels, "_module", lambda *_: {"draw": None})
            patched.setattr(kernels, "_launch", launch)
            torch.manual_seed(1)
            found = table.sample(500, 0.1, 0.2)
        torch.testing.assert_close(found.columns, expected.columns)
        assert torch.equal(found.index, expected.index)


def test_a_table_smaller_than_a_transition_is_refused() -> None:
    with pytest.raises(ValueError, match="holds 3 steps"):
        DeviceTable(SPEC, 9, 3, 3, GAMMA, CPU)
