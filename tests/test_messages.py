"""Messages: valid ones come back whole, and each broken field is refused by its name."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from samples import make_segment

from common import experience, messages, wire
from common.config import RunConfig
from common.errors import BadMessage
from common.experience import BatchReader, Drawn, EpisodeRecord, SegmentReader
from common.messages import Join, Joined, ReplayStats, Role
from common.types import EnvSpec, EpisodeEnd
from common.wire import Message
from replay.table import Table

SPEC = EnvSpec("CartPole-v0", (4,), "float32", 1, 2)


def _batch() -> tuple[Any, Drawn]:
    table = Table(SPEC, 100, rng=np.random.default_rng(0))
    table.insert(make_segment(SPEC))
    end = EpisodeRecord(4, 7, 0, EpisodeEnd(3, 1.5, 4, 0.1, 0.2, 0.3, 5))
    return table.sample(8), Drawn(3, 4, 4, 0, 0, 0, (end,))


def _decoded(payload: bytearray) -> Message:
    return wire.decode(bytes(payload))


STATS = ReplayStats(1, 2, 3, 4, 5, 6, 7, 8, 9, "a", "b")
JOINED = Joined(RunConfig(target_return=1.0), SPEC, "abc", 2, ["tcp/h:1"])


def test_everything_comes_back() -> None:
    join = Join("replay", 5, ["tcp/127.0.0.1:1"])
    assert messages.decode_join(_decoded(messages.encode_join("r", join))) == join
    assert messages.decode_joined(_decoded(messages.encode_joined(JOINED))) == JOINED
    role = Role(2, (4, 5), 6)
    assert messages.decode_role(_decoded(messages.encode_role("r", role))) == role
    assert messages.decode_stats(_decoded(messages.encode_stats("r", STATS))) == STATS
    assert messages.decode_retry(_decoded(messages.encode_retry("r", "later"))) == "later"
    assert messages.decode_ack(_decoded(messages.encode_ack("r", 9))) == 9
    assert experience.decode_sample(_decoded(experience.encode_sample("r", 1, 2, 3, 4))) == (1, 2, 3, 4)
    number, version, flat = messages.decode_weights(
        _decoded(messages.encode_weights("r", 2, 8, np.arange(3, dtype=np.float32))), 3
    )
    assert (number, version, flat.tolist()) == (2, 8, [0.0, 1.0, 2.0])


def test_segments_and_batches_come_back() -> None:
    segment = make_segment(SPEC, sequence=3)
    back = SegmentReader(SPEC)(_decoded(experience.encode_segment("r", segment)))
    assert back.episodes == segment.episodes
    for name in ("frames", "obs_index", "next_index", "actions", "rewards", "terminated", "param_version"):
        np.testing.assert_array_equal(getattr(back, name), getattr(segment, name))
    batch, drawn = _batch()
    batch_back, drawn_back = BatchReader(SPEC)(_decoded(experience.encode_batch("r", batch, drawn)))
    assert drawn_back == drawn
    np.testing.assert_array_equal(batch_back.frames[batch_back.obs_index], batch.frames[batch.obs_index])


def _breaking(array: str, place: Any, value: Any) -> Callable[[Message], Message]:
    def change(message: Message) -> Message:
        arrays = {name: np.array(a) for name, a in message.arrays.items()}
        arrays[array][place] = value
        return replace(message, arrays=arrays)

    return change


def _with_array(name: str, value: Any) -> Callable[[Message], Message]:
    return lambda message: replace(message, arrays={**message.arrays, name: value})


def _with_field(name: str, value: Any) -> Callable[[Message], Message]:
    return lambda message: replace(message, fields={**message.fields, name: value})


END = [3, 1.5, 4, 0.1, 0.2, 0.3, 5]


@pytest.mark.parametrize(
    ("change", "field"),
    [
        (lambda message: replace(message, kind="sample"), "kind"),
        (_with_field("extra", 1), "fields"),
        (_with_field("incarnation", -1), "fields.incarnation"),
        (_with_field("incarnation", True), "fields.incarnation"),
        (_with_field("stream", 65_536), "fields.stream"),
        (_with_field("sequence", "1"), "fields.sequence"),
        (_with_field("carried", 6), "fields.carried"),
        (_with_field("episodes", [END[:-1]]), "fields.episodes"),
        (_with_field("episodes", [[4, *END[1:]]]), "fields.episodes"),
        (_with_field("episodes", [[3, float("nan"), *END[2:]]]), "fields.episodes"),
        (_with_array("extra", np.zeros(1)), "arrays"),
        (_with_array("frames", np.zeros((5, 4), np.float64)), "arrays.frames"),
        (_with_array("frames", np.zeros((5, 3), np.float32)), "arrays.frames"),
        (_with_array("frames", np.zeros((0, 4), np.float32)), "arrays.obs_index"),
        (_with_array("actions", np.zeros(5, np.int32)), "arrays.actions"),
        (_with_array("actions", np.zeros((4, 1), np.int32)), "arrays.actions"),
        (_breaking("frames", 0, np.inf), "arrays.frames"),
        (_breaking("obs_index", 0, -1), "arrays.obs_index"),
        (_breaking("next_index", 3, 5), "arrays.next_index"),
        (_breaking("actions", 1, 2), "arrays.actions"),
        (_breaking("rewards", 1, np.nan), "arrays.rewards"),
        (_breaking("param_version", 1, -3), "arrays.param_version"),
    ],
)
def test_a_bad_segment_is_refused_by_field(change: Callable[[Message], Message], field: str) -> None:
    message = _decoded(experience.encode_segment("r", make_segment(SPEC)))
    with pytest.raises(BadMessage) as caught:
        SegmentReader(SPEC)(change(message))
    assert caught.value.field == field


def _spec_table(**changes: Any) -> dict[str, Any]:
    table = {"env_id": "x", "frame_shape": [4], "frame_dtype": "float32", "stack": 1, "num_actions": 2}
    return {**table, **changes}


@pytest.mark.parametrize(
    ("decode", "payload", "change", "field"),
    [
        (messages.decode_join, messages.encode_join("r", Join("boss", 1, [])), None, "fields.role"),
        (messages.decode_join, messages.encode_join("r", Join("actor", 1, ["x"] * 17)), None, "fields.endpoints"),
        (messages.decode_joined, messages.encode_joined(JOINED), _with_field("config", {"a": 1}), "fields.config"),
        (messages.decode_joined, messages.encode_joined(JOINED), _with_field("spec", {}), "fields.spec"),
        (
            messages.decode_joined,
            messages.encode_joined(JOINED),
            _with_field("spec", _spec_table(frame_dtype="object")),
            "fields.spec.frame_dtype",
        ),
        (
            messages.decode_joined,
            messages.encode_joined(JOINED),
            _with_field("spec", _spec_table(num_actions=0)),
            "fields.spec.num_actions",
        ),
        (experience.decode_sample, experience.encode_sample("r", 1, 1, 0, 0), None, "fields.batch_size"),
        (messages.decode_snapshot, messages.encode_snapshot("r", "../../etc"), None, "fields.folder"),
        (messages.decode_snapshot, messages.encode_snapshot("r", "checkpoints/1\n"), None, "fields.folder"),
        (messages.decode_role, messages.encode_role("r", Role(3, (0, 0), 0)), None, "fields.acting"),
        (messages.decode_stats, messages.encode_stats("r", STATS), _with_field("lost", -1), "fields.lost"),
    ],
)
def test_other_bad_messages(
    decode: Callable[[Message], Any],
    payload: bytearray,
    change: Callable[[Message], Message] | None,
    field: str,
) -> None:
    message = _decoded(payload)
    with pytest.raises(BadMessage) as caught:
        decode(change(message) if change else message)
    assert caught.value.field == field


def test_weights_of_another_size_are_refused() -> None:
    message = _decoded(messages.encode_weights("r", 1, 0, np.zeros(3, np.float32)))
    with pytest.raises(BadMessage) as caught:
        messages.decode_weights(message, 4)
    assert caught.value.field == "arrays.flat"
