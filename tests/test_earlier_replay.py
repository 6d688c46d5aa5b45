"""What a replay service of protocol 1 left on disk, an epoch and the journal that continues it, is gone on from.

`data/replay-of-protocol-1.tar.gz` was made at commit 3dc97f6: four segments, two draws, an epoch; three segments,
a draw.
"""

import tarfile
from pathlib import Path

import pytest

from common.messaging import wire
from common.settings.config import LearnerSettings, ReplaySettings, RunConfig
from common.types import EnvSpec
from replay.core import ReplayCore
from replay.persistence.epochs import ReplayEpochs
from replay.persistence.recovery import recover

DATA = Path(__file__).parent / "data" / "replay-of-protocol-1.tar.gz"
RUN_ID = 5
CONFIG = RunConfig(
    run="test",
    total_steps=1000,
    learner=LearnerSettings(batch_size=4),
    replay=ReplaySettings(capacity=100, learning_starts=8, tolerance=64.0, journal=True),
)


def _restored(folder: Path, spec: EnvSpec) -> ReplayCore:
    with tarfile.open(DATA) as archive:
        archive.extractall(folder, filter="data")
    left = folder / "replay-of-protocol-1"
    core = ReplayCore(CONFIG, spec)
    first, _ = ReplayEpochs(left, RUN_ID).restore(core, 1)
    assert (core.table.inserted, core.drawn, len(core.repeatable(1))) == (16, 2, 1)
    recover(core, left / "journal", first, RUN_ID)
    return core


def test_segments_and_batches_of_protocol_1_are_read(tmp_path: Path, spec: EnvSpec) -> None:
    core = _restored(tmp_path, spec)
    assert (core.table.inserted, core.drawn, core.episodes_total, core.lost) == (28, 3, 7, 0)
    batch = core.table.sample(16)
    assert batch.span.tolist() == [1] * 16
    assert batch.rewards.tolist() == batch.ids.tolist(), "rewards count the steps"


def test_another_protocol_on_disk_is_not(tmp_path: Path, spec: EnvSpec, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(wire, "ON_DISK", frozenset({2}))
    with pytest.raises(AssertionError, match=r"\(0, 0, 0\)"):
        _restored(tmp_path, spec)
