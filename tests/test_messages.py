"""Messages: valid ones come back whole, and whatever is wrong with one is refused by the name of its field."""

import contextlib
import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from samples import make_segment

from coop.common.bounds import (
    MAX_AHEAD,
    MAX_COUNT,
    MAX_EVALUATED,
    MAX_FLOAT32,
    MAX_INTEGER,
    MAX_MAGNITUDE,
    MAX_RETURN,
    MAX_STREAMS,
    MAX_UPDATES,
    MAX_VIDEO,
)
from coop.common.errors import BadMessage, RunError
from coop.common.messaging import wire
from coop.common.messaging.members import Origin
from coop.common.messaging.messages.answers import Ack, Error, Retry
from coop.common.messaging.messages.control import EndOfRun, Join, JoinReply, Leave, Limit, Limits, Snapshot, Written
from coop.common.messaging.messages.evaluate import GIF, Evaluated, EvaluationRow, Video
from coop.common.messaging.messages.insert import SegmentReader, encode_segment
from coop.common.messaging.messages.sample import (
    BatchReader,
    Draws,
    NamedBatchReader,
    encode_batch,
    encode_named,
    encode_request,
    read_request,
)
from coop.common.messaging.messages.status import ReplayStats
from coop.common.messaging.messages.weights import Current, Role, Weights
from coop.common.messaging.wire import Message
from coop.common.settings.config import RunConfig
from coop.common.settings.tables import to_tables
from coop.common.transitions import Drawn, DrawRequest
from coop.common.types import EnvSpec, EpisodeEnd, EpisodeRecord
from coop.replay.table.table import PinnedBatch, Table

SPEC = EnvSpec("CartPole-v0", (4,), "float32", 1, 2)
END = [3, 1.5, 4, 0.1, 0.2, 0.3, 5]
RECORD = [4, 7, 0, END]
STATS = ReplayStats(1, 2, 3, 4, 5, 6, 7, 8, 9, "a", "b")
JOIN = Join("replay", 5, ["tcp/127.0.0.1:1"], checkpoints=[500, 1000])
JOIN_REPLY = JoinReply(RunConfig(target_return=1.0), SPEC, "abc", 2, ["tcp/h:1"], 77, 300, replay=Origin("h", 7))
LIMITS = Limits(0.5, 8.0, 10, 5, 50, "a", "")
EVALUATED = Evaluated(5, 3, EvaluationRow(600, 400, 2, 10, 21.5, 3.25, 0.0, 1.5))
RESULT = msgspec.structs.asdict(EVALUATED.result)
VIDEO = Video(5, 4, 600, np.frombuffer(GIF + b"9a", np.uint8))
TABLES = to_tables(RunConfig())
FLAT = np.arange(3, dtype=np.float32)


def _batch() -> tuple[PinnedBatch, Drawn]:
    table = Table(SPEC, 100, rng=np.random.default_rng(0))
    table.insert(make_segment(SPEC))
    end = EpisodeRecord(4, 7, 0, EpisodeEnd(3, 1.5, 4, 0.1, 0.2, 0.3, 5))
    return table.sample_pinned(8), Drawn(3, 4, 4, 0, 0, 0, (end,))


def _encoded_batch() -> bytearray:
    batch, drawn = _batch()
    return encode_batch("r", batch.frames, batch.columns, drawn)


def _encoded_batches() -> bytearray:
    """Two batches of eight, whose frames are named; the answer carries one frame of the first and two of the second."""
    table = Table(SPEC, 100, rng=np.random.default_rng(0))
    table.insert(make_segment(SPEC))
    batches, slots = [table.sample_pinned(8) for _ in range(2)], np.arange(5)
    frames = tuple(len(batch.frames) for batch in batches)
    assert frames == (5, 5), "all that the table has"
    drawn = Drawn(3, 4, 4, 0, 0, 0, ())
    draws = Draws(9, "", 6, frames, (drawn, msgspec.structs.replace(drawn, sequence=4)))
    columns, names = [batch.columns for batch in batches], np.concatenate((slots, slots))
    return encode_named(
        "r", draws, columns, names, names + 1, np.array([2, 5, 9]), table.stored(names[:3]), bytearray()
    )


REQUEST = DrawRequest(1, 3, 2, 4, 5, ids=np.array([7]), priorities=np.array([0.5], np.float32))
READERS: dict[str, tuple[bytearray, Callable[[Message], Any]]] = {
    "join": (JOIN.encode("r"), Join.decode),
    "join-reply": (JOIN_REPLY.encode("r"), JoinReply.decode),
    "leave": (Leave(5).encode("r"), Leave.decode),
    "insert": (encode_segment("r", make_segment(SPEC)), SegmentReader(SPEC)),
    "ack": (Ack(9).encode("r"), Ack.decode),
    "retry": (Retry("later").encode("r"), Retry.decode),
    "error": (Error.of(BadMessage("f", "wrong")).encode("r"), Error.decode),
    "sample": (encode_request("r", REQUEST), read_request),
    "batch": (_encoded_batch(), BatchReader(SPEC)),
    "batches": (_encoded_batches(), NamedBatchReader(SPEC)),
    "weights": (Weights(2, 8, FLAT).encode("r"), partial(Weights.decode, parameters=3)),
    "role": (Role(2, (4, 5), 6).encode("r"), Role.decode),
    "stats": (STATS.encode("r"), ReplayStats.decode),
    "snapshot": (Snapshot(12, [4, 8], 1, 3).encode("r"), Snapshot.decode),
    "written": (Written(12).encode("r"), Written.decode),
    "limit": (Limit(0.5, 8).encode("r"), Limit.decode),
    "limits": (LIMITS.encode("r"), Limits.decode),
    "evaluated": (EVALUATED.encode("r"), Evaluated.decode),
    "video": (VIDEO.encode("r"), Video.decode),
    "stop": (EndOfRun.because("complete").encode("r"), EndOfRun.decode),
    "current": (Current().encode("r"), Current.decode),
}


def _valid(kind: str) -> Message:
    return wire.decode(bytes(READERS[kind][0]))


def _sent(message: Message, arrays: dict[str, Any]) -> Message:
    """The message with other arrays."""
    return wire.decode(bytes(wire.encode(message.kind, message.run, message.fields, arrays)))


@pytest.mark.parametrize(
    ("kind", "value"),
    [
        ("join", JOIN),
        ("join-reply", JOIN_REPLY),
        ("leave", Leave(5)),
        ("ack", Ack(9)),
        ("retry", Retry("later")),
        ("error", Error("f", "f: wrong")),
        ("role", Role(2, (4, 5), 6)),
        ("evaluated", EVALUATED),
        ("stats", STATS),
        ("snapshot", Snapshot(12, [4, 8], 1, 3)),
        ("written", Written(12)),
        ("limit", Limit(0.5, 8.0)),
        ("limits", LIMITS),
        ("stop", EndOfRun("complete")),
        ("current", Current()),
    ],
)
def test_everything_comes_back(kind: str, value: object) -> None:
    assert READERS[kind][1](_valid(kind)) == value


def test_an_error_that_is_not_about_a_field_comes_back() -> None:
    payload = Error.of(RunError("disk full")).encode("r")
    assert Error.decode(wire.decode(bytes(payload))).problem == "disk full"


def test_arrays_come_back() -> None:
    request = read_request(_valid("sample"))
    assert (request.sequence, request.ids.tolist(), request.priorities.tolist()) == (3, [7], [0.5])
    weights = READERS["weights"][1](_valid("weights"))
    assert (weights.network, weights.version, weights.flat.tolist()) == (2, 8, FLAT.tolist())
    segment, back = make_segment(SPEC), READERS["insert"][1](_valid("insert"))
    assert back.episodes == segment.episodes
    for name in ("frames", "obs_index", "next_index", "actions", "rewards", "terminated", "param_version"):
        np.testing.assert_array_equal(getattr(back, name), getattr(segment, name))
    batch, drawn = _batch()
    batch_back, drawn_back = READERS["batch"][1](_valid("batch"))
    assert drawn_back == drawn
    for name in ("frames", "obs_index", "next_index", "actions", "rewards", "weights", "ids", "age", "reuse"):
        np.testing.assert_array_equal(getattr(batch_back, name), getattr(batch.read(), name))


def test_named_batches_come_back() -> None:
    message = _valid("batches")
    draws, batches = READERS["batches"][1](message)
    assert (draws.table, draws.admitted, [drawn.sequence for drawn in draws.draws]) == (9, 6, [3, 4])
    assert [batch.carried.tolist() for batch in batches] == [[2], [0, 4]]
    np.testing.assert_array_equal(np.concatenate([batch.frames for batch in batches]), message.arrays["frames"])
    for batch in batches:
        assert (batch.slots.tolist(), batch.numbers.tolist()) == ([0, 1, 2, 3, 4], [1, 2, 3, 4, 5])
    for name in ("obs_index", "next_index", "actions", "rewards", "weights", "ids", "age", "reuse"):
        joined = np.concatenate([batch.columns[name] for batch in batches])
        np.testing.assert_array_equal(joined, message.arrays[name])


def _spec(**changes: object) -> dict[str, object]:
    table = {"env_id": "x", "frame_shape": [4], "frame_dtype": "float32", "stack": 1, "num_actions": 2}
    return {**table, **changes}


FIELDS = [
    ("join", "role", "boss"),
    ("join", "role", 5),
    ("join", "incarnation", 2**63),
    ("join", "index", -2),
    ("join", "index", MAX_COUNT + 1),
    ("join", "endpoints", ["x"] * 17),
    ("join", "endpoints", ["x" * 257]),
    ("join", "origin", ["h", -1]),
    ("join-reply", "learner", None),
    ("join-reply", "replay", ["h" * 257, 1]),
    ("leave", "incarnation", -1),
    ("join", "checkpoints", [-1]),
    ("join", "checkpoints", [0] * 17),
    ("join", "serving", 1),
    ("join-reply", "anew", 0),
    ("join-reply", "config", {"learning": 1}),
    ("join-reply", "config", {**TABLES, "replay": {"capacity": -1}}),
    ("join-reply", "config", []),
    ("join-reply", "layout", "x" * 65),
    ("join-reply", "index", -1),
    ("join-reply", "replay_endpoints", "tcp/h:1"),
    ("join-reply", "spec", {}),
    ("insert", "incarnation", -1),
    ("insert", "incarnation", True),
    ("insert", "stream", 65_536),
    ("insert", "sequence", "1"),
    ("insert", "carried", 6),
    ("insert", "carried", -1),
    ("insert", "acked", 1.0),
    ("insert", "acked", MAX_COUNT + 1),
    ("insert", "sequence", MAX_COUNT + 1),
    ("insert", "carried", 1025),
    ("insert", "episodes", [[3, 1e300, *END[2:]]]),
    ("insert", "episodes", [[*END[:2], 0, *END[3:]]]),
    ("insert", "episodes", [[*END[:2], MAX_COUNT + 1, *END[3:]]]),
    ("insert", "episodes", [[*END[:3], 1.5, *END[4:]]]),
    ("insert", "episodes", [[*END[:4], 1e300, *END[5:]]]),
    ("insert", "episodes", [[*END[:6], MAX_UPDATES + 1]]),
    ("insert", "episodes", [END, END]),
    ("insert", "episodes", [[2, *END[1:]], [1, *END[1:]]]),
    ("insert", "episodes", [END[:-1]]),
    ("insert", "episodes", [[4, *END[1:]]]),
    ("insert", "episodes", [[3, math.nan, *END[2:]]]),
    ("ack", "inserted", None),
    ("retry", "reason", 5),
    ("error", "problem", "x" * 4097),
    ("sample", "batch_size", 0),
    ("sample", "batch_size", 65_537),
    ("sample", "sequence", -1),
    ("sample", "episodes_from", -1),
    ("sample", "base", MAX_UPDATES + 1),
    ("sample", "episodes_from", MAX_COUNT + 1),
    ("batch", "sequence", -1),
    ("batch", "episodes", [RECORD[:-1]]),
    ("batch", "episodes", [[*RECORD[:3], [3, math.inf, *END[2:]]]]),
    ("weights", "network", 0),
    ("weights", "version", -1),
    ("role", "acting", 3),
    ("role", "versions", [1]),
    ("role", "versions", [1, -1]),
    ("role", "updates", "many"),
    ("role", "env_step", -1),
    ("evaluated", "incarnation", 2**63),
    ("evaluated", "number", -1),
    ("video", "number", MAX_COUNT + 1),
    ("video", "env_step", -1),
    ("stats", "lost", -1),
    ("stats", "samples_wait_for", None),
    ("stop", "reason", None),
    ("snapshot", "number", "../../etc"),
    ("snapshot", "number", -1),
    ("snapshot", "keep", [1, "/"]),
    ("snapshot", "keep", [1] * 17),
    ("written", "number", 1.0),
    ("sample", "base", -1),
    ("sample", "sequence", 1),
    ("sample", "sequence", 2 + MAX_AHEAD),
    ("batch", "planned", -1),
    ("sample", "mirror", -1),
    ("sample", "mirror_slots", 2**31),
    ("sample", "draws", 0),
    ("sample", "draws", 2),  # without memory or mirror
    ("batches", "table", -1),
    ("batches", "memory", "/etc/passwd"),
    ("batches", "admitted", -1),
    ("batches", "frames", [10]),
    ("batches", "frames", [5, 4]),
    ("batches", "frames", [10, 0]),
    ("batches", "draws", []),
    ("limit", "ratio", 0.0),
    ("limit", "ratio", math.nan),
    ("limit", "ratio", 1e7),
    ("limit", "tolerance", 1e13),
    ("limit", "tolerance", -1),
    ("limits", "drawn", "many"),
]


@pytest.mark.parametrize(("kind", "field", "value"), FIELDS)
def test_a_bad_field_is_refused_by_name(kind: str, field: str, value: object) -> None:
    message = _valid(kind)
    with pytest.raises(BadMessage) as caught:
        READERS[kind][1](replace(message, fields={**message.fields, field: value}))
    assert caught.value.field == f"fields.{field}"


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("env_id", 5),
        ("frame_shape", [0]),
        ("frame_shape", [1] * 5),
        ("frame_dtype", "object"),
        ("stack", 0),
        ("stack", 65),
        ("num_actions", 0),
    ],
)
def test_a_bad_specification_is_refused_by_name(field: str, value: object) -> None:
    message = _valid("join-reply")
    with pytest.raises(BadMessage) as caught:
        JoinReply.decode(replace(message, fields={**message.fields, "spec": _spec(**{field: value})}))
    assert caught.value.field == f"fields.spec.{field}"


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("env_step", -1),
        ("update", MAX_UPDATES + 1),
        ("network", 3),
        ("episodes", 0),
        ("episodes", MAX_EVALUATED + 1),
        ("return_mean", math.nan),
        ("return_mean", 2 * MAX_RETURN),
        ("return_sd", -1.0),
        ("return_sd", math.inf),
        ("epsilon", 1.5),
        ("seconds", -1.0),
    ],
)
def test_a_bad_result_is_refused_by_name(field: str, value: object) -> None:
    message = _valid("evaluated")
    with pytest.raises(BadMessage) as caught:
        Evaluated.decode(replace(message, fields={**message.fields, "result": {**RESULT, field: value}}))
    assert caught.value.field == f"fields.result.{field}"


ARRAYS = [
    ("video", "gif", np.zeros(6, np.uint8), "gif"),
    ("video", "gif", np.zeros((2, 3), np.uint8), "gif"),
    ("video", "gif", np.zeros(0, np.uint8), "gif"),
    ("video", "gif", np.tile(np.frombuffer(GIF, np.uint8), MAX_VIDEO // 4 + 1), "gif"),
    ("insert", "frames", np.zeros((5, 4), np.float64), "frames"),
    ("insert", "frames", np.zeros((5, 3), np.float32), "frames"),
    ("insert", "frames", np.zeros((0, 4), np.float32), "obs_index"),
    ("insert", "frames", np.full((5, 4), np.inf, np.float32), "frames"),
    ("insert", "obs_index", np.array([[0], [1], [-1], [3]], np.int32), "obs_index"),
    ("insert", "obs_index", np.zeros((4, 2), np.int32), "obs_index"),
    ("insert", "next_index", np.array([[1], [2], [3], [5]], np.int32), "next_index"),
    ("insert", "actions", np.zeros(5, np.int32), "actions"),
    ("insert", "actions", np.zeros((4, 1), np.int32), "actions"),
    ("insert", "actions", np.array([0, 1, 2, 0], np.int32), "actions"),
    ("insert", "actions", np.array([0, 1, -1, 0], np.int32), "actions"),
    ("insert", "rewards", np.array([0, np.nan, 0, 0], np.float32), "rewards"),
    ("insert", "rewards", np.array([0, 0, 0, -np.inf], np.float32), "rewards"),
    ("insert", "rewards", np.array([0, 0, 0, 1e7], np.float32), "rewards"),
    ("insert", "frames", np.full((5, 4), -1e7, np.float32), "frames"),
    ("insert", "frames", np.full((5, 4), np.nan, np.float32), "frames"),
    ("insert", "param_version", np.array([0, 0, MAX_UPDATES + 1, 0]), "param_version"),
    ("insert", "span", np.zeros(4, np.uint8), "span"),
    ("batch", "weights", np.full(8, -1, np.float32), "weights"),
    ("insert", "terminated", np.array([0, 1, 2, 0], np.uint8).view(np.bool_), "terminated"),
    ("insert", "param_version", np.array([0, 0, -3, 0]), "param_version"),
    ("batch", "frames", np.zeros((5, 4), np.uint8), "frames"),
    ("batch", "obs_index", np.full((8, 1), 5, np.int32), "obs_index"),
    ("batch", "next_index", np.full((8, 1), -1, np.int32), "next_index"),
    ("batch", "actions", np.full(8, 2, np.int32), "actions"),
    ("batch", "actions", np.zeros(7, np.int32), "actions"),
    ("batch", "rewards", np.full(8, np.nan, np.float32), "rewards"),
    ("batch", "terminated", np.full(8, 3, np.uint8).view(np.bool_), "terminated"),
    ("batch", "weights", np.full(8, np.inf, np.float32), "weights"),
    ("batches", "frames", np.full((3, 4), np.nan, np.float32), "frames"),
    ("batches", "frames", np.zeros((2, 4), np.float32), "carried"),
    ("batches", "slots", np.full(10, -1, np.int32), "slots"),
    ("batches", "slots", np.zeros(9, np.int32), "numbers"),
    ("batches", "numbers", np.zeros(10, np.int64), "numbers"),
    ("batches", "carried", np.array([-1, 2, 3], np.int32), "carried"),
    ("batches", "carried", np.array([1, 2, 10], np.int32), "carried"),
    ("batches", "carried", np.array([1, 2, 2], np.int32), "carried"),
    ("batches", "obs_index", np.full((16, 1), 5, np.int32), "obs_index"),
    ("batches", "next_index", np.full((16, 1), -1, np.int32), "next_index"),
    ("batches", "actions", np.full(16, 2, np.int32), "actions"),
    ("batches", "actions", np.zeros(15, np.int32), "actions"),
    ("batches", "weights", np.full(16, np.inf, np.float32), "weights"),
    ("batch", "ids", np.full(8, -1), "ids"),
    ("batch", "age", np.full(8, -1), "age"),
    ("batch", "reuse", np.full(8, -1, np.int32), "reuse"),
    ("sample", "ids", np.array([-1]), "ids"),
    ("sample", "ids", np.array([1, 2]), "priorities"),
    ("sample", "priorities", np.full(1, -0.5, np.float32), "priorities"),
    ("sample", "priorities", np.full(1, np.inf, np.float32), "priorities"),
    ("sample", "priorities", np.full(1, np.nan, np.float32), "priorities"),
    ("sample", "priorities", np.zeros(1), "priorities"),
    ("weights", "flat", np.zeros(4, np.float32), "flat"),
    ("weights", "flat", np.zeros(3), "flat"),
]


@pytest.mark.parametrize(("kind", "array", "value", "named"), ARRAYS)
def test_a_bad_array_is_refused_by_name(kind: str, array: str, value: Any, named: str) -> None:
    message = _valid(kind)
    with pytest.raises(BadMessage) as caught:
        READERS[kind][1](_sent(message, arrays={**message.arrays, array: value}))
    assert caught.value.field == f"arrays.{named}"


def test_boolean_frames_hold_nothing_but_0_and_1() -> None:
    spec = EnvSpec("x", (3, 3, 2), "bool", 1, 2)
    frames = np.random.default_rng(0).integers(0, 2, (5, 3, 3, 2)).astype(bool)
    message = wire.decode(bytes(encode_segment("r", make_segment(spec, frames=frames))))
    back = SegmentReader(spec)(message).frames
    assert (back.dtype, back.tobytes()) == (np.bool_, frames.tobytes())
    with pytest.raises(BadMessage, match=r"arrays\.frames: values from 0 to 2"):
        SegmentReader(spec)(_sent(message, arrays={**message.arrays, "frames": (2 * frames.view(np.uint8)).view(bool)}))


def test_the_largest_numbers_are_taken() -> None:
    end = EpisodeEnd(3, -1e15, MAX_COUNT, 1.0, MAX_FLOAT32, -MAX_FLOAT32, MAX_UPDATES)
    changes = {
        "incarnation": MAX_INTEGER,
        "stream": MAX_STREAMS - 1,
        "sequence": MAX_COUNT,
        "acked": MAX_COUNT,
        "carried": 5,
        "rewards": np.full(4, -MAX_MAGNITUDE, np.float32),
        "param_version": np.full(4, MAX_UPDATES),
        "episodes": (end,),
    }
    segment = msgspec.structs.replace(make_segment(SPEC), **changes)
    back = SegmentReader(SPEC)(wire.decode(bytes(encode_segment("r", segment))))
    assert back.episodes == (end,)
    assert (back.acked, back.sequence, back.stream) == (MAX_COUNT, MAX_COUNT, MAX_STREAMS - 1)


def test_a_refusal_names_what_was_found() -> None:
    message = _valid("join")
    with pytest.raises(BadMessage) as caught:
        Join.decode(replace(message, fields={**message.fields, "index": -2}))
    assert str(caught.value) == "fields.index: -2; expected int >= -1"


@pytest.mark.parametrize("kind", READERS)
def test_every_kind_refuses_what_is_missing_or_unknown(kind: str) -> None:
    message, read = _valid(kind), READERS[kind][1]
    wrong = {
        "kind": replace(message, kind="other"),
        "fields": replace(message, fields={**message.fields, "extra": 1}),
        "arrays": _sent(message, arrays={**message.arrays, "extra": np.zeros(1, np.float32)}),
    }
    for field, changed in wrong.items():
        with pytest.raises(BadMessage) as caught:
            read(changed)
        assert caught.value.field == field
    for name in message.fields:
        with pytest.raises(BadMessage, match=f"fields: missing {name}"):
            read(replace(message, fields={key: value for key, value in message.fields.items() if key != name}))
    for name in message.arrays:
        with pytest.raises(BadMessage, match=f"arrays: missing {name}"):
            read(_sent(message, arrays={key: value for key, value in message.arrays.items() if key != name}))


@pytest.mark.parametrize("kind", ["insert", "batch", "batches"])
def test_nothing_at_all_is_refused(kind: str) -> None:
    message = _valid(kind)
    kept = {"frames", "slots", "numbers", "carried"}
    arrays = {name: array if name in kept else array[:0] for name, array in message.arrays.items()}
    with pytest.raises(BadMessage) as caught:
        READERS[kind][1](_sent(message, arrays=arrays))
    assert caught.value.field == "arrays.actions"


ANYTHING = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**63), 2**64 - 1) | st.floats() | st.text(max_size=5) | st.binary(),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=4) | st.binary(), inner, max_size=3),
    max_leaves=8,
)


@pytest.mark.parametrize("kind", READERS)
@settings(max_examples=150)
@given(data=st.data())
def test_no_value_raises_anything_else(kind: str, data: st.DataObject) -> None:
    message, read = _valid(kind), READERS[kind][1]
    fields = dict(message.fields)
    place = data.draw(st.sampled_from([*fields, "extra"]))
    inner = fields.get(place)
    if isinstance(inner, dict) and data.draw(st.booleans()):
        name = data.draw(st.sampled_from([*inner, "extra"]))
        fields[place] = {**inner, name: data.draw(ANYTHING)}
    else:
        fields[place] = data.draw(ANYTHING)
    payload = wire.encode(message.kind, message.run, fields, message.arrays)
    with contextlib.suppress(BadMessage):
        read(wire.decode(bytes(payload)))
