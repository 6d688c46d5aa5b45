"""Inserts: a segment for the table, answered with a receipt or a request to try again later."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from coop.common.bounds import MAX_MAGNITUDE, MAX_N_STEP, MAX_SEGMENT_STEPS
from coop.common.errors import BadMessage
from coop.common.messaging import wire
from coop.common.messaging.messages.body import Layout, check_kind, to_struct
from coop.common.messaging.wire import Message
from coop.common.transitions import FIELDS, IN_SEGMENT, MASKS, Segment, arrays_of, columns_of, layout
from coop.common.types import Array, EnvSpec

KIND = "insert"
_FIELDS = tuple(name for name in Segment.__struct_fields__ if name not in {"frames", *IN_SEGMENT, *MASKS})


def encode_segment(run: str, segment: Segment, into: bytearray | None = None) -> bytearray:
    """Build an insert request; into: see `wire.encode`."""
    fields = {name: getattr(segment, name) for name in _FIELDS}
    return wire.encode(KIND, run, fields, {"frames": segment.frames, **arrays_of(segment, IN_SEGMENT)}, into)


def check_indices(arrays: Mapping[str, Array], frames: int) -> None:
    """Check that a segment or a batch, of at least one row, refers to `frames` frames; raises BadMessage."""
    for name in ("obs_index", "next_index"):
        check_range(f"arrays.{name}", arrays[name], 0, frames - 1)


def check_values(spec: EnvSpec, arrays: Mapping[str, Array]) -> None:
    """Check the values of a segment's or a batch's arrays, of at least one row; raises BadMessage."""
    frames = arrays["frames"]
    if frames.dtype == np.bool_:
        check_range("arrays.frames", frames.view(np.uint8), 0, 1)
    elif frames.dtype == np.float32:
        check_range("arrays.frames", frames, -MAX_MAGNITUDE, MAX_MAGNITUDE)
    fields = columns_of(FIELDS, spec)
    for name, array in arrays.items():
        if name in fields and (bounds := fields[name].bounds(spec, arrays)) is not None:
            check_range(f"arrays.{name}", array.view(np.uint8) if array.dtype == np.bool_ else array, *bounds)


def check_range(field: str, array: Array, low: float, high: float) -> None:
    """Raise BadMessage for a value outside [low, high] and for NaN."""
    if not array.size:
        return
    least, most = array.item(array.argmin()), array.item(array.argmax())  # min and max take thrice as long
    if not (low <= least and most <= high):
        raise BadMessage(field, f"values from {least} to {most}; allowed: {low} to {high}")


class SegmentReader:
    """Reads insert requests for one environment."""

    def __init__(self, spec: EnvSpec) -> None:
        self._spec = spec
        self._layout = Layout(layout(IN_SEGMENT, spec, "steps"), MASKS.keys())

    def __call__(self, message: Message) -> Segment:
        """Read one; raises BadMessage for anything that the table could not store."""
        check_kind(message, KIND)
        lengths = self._layout.lengths(message.table)
        steps, frames = lengths["steps"], lengths["frames"]
        if not 1 <= steps <= MAX_SEGMENT_STEPS:
            raise BadMessage("arrays.actions", f"{steps} steps; allowed: 1 to {MAX_SEGMENT_STEPS}")
        if frames > (most := (self._spec.stack + 1) * (steps + 2 * MAX_N_STEP)):  # with those of steps that wait
            raise BadMessage("arrays.frames", f"{frames} frames of {steps} steps; at most {most}")
        check_indices(message.arrays, frames)
        check_values(self._spec, message.arrays)
        segment = to_struct(message, Segment, self._layout)
        if segment.carried > frames:
            raise BadMessage("fields.carried", f"{segment.carried} of {frames} frames")
        last = -1
        for end in segment.episodes:
            if not last < end.step_in_segment < steps:
                text = f"one ends with step {end.step_in_segment} of {steps}, the one before it with {last}"
                raise BadMessage("fields.episodes", text)
            last = end.step_in_segment
        return segment
