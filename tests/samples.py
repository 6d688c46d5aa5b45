"""Small valid messages for tests to send and to break."""

import numpy as np

from common.types import EnvSpec, EpisodeEnd, Segment


def make_segment(spec: EnvSpec, sequence: int = 0, steps: int = 4, incarnation: int = 7, **changes: object) -> Segment:
    """Consecutive steps with distinguishable frames; the last step ends an episode."""
    first = sequence * steps
    frames = np.arange(first, first + steps + 1, dtype=np.float32)[:, None] + np.zeros(spec.frame_shape, np.float32)
    index = np.arange(steps, dtype=np.int32)[:, None]
    values: dict[str, object] = {
        "incarnation": incarnation,
        "stream": 0,
        "sequence": sequence,
        "frames": frames.astype(spec.frame_dtype),
        "obs_index": index,
        "next_index": index + 1,
        "actions": np.zeros(steps, np.int32),
        "rewards": np.arange(first, first + steps, dtype=np.float32),
        "terminated": np.zeros(steps, np.bool_),
        "param_version": np.zeros(steps, np.int64),
        "carried": min(sequence, 1),
        "acked": first,
        "episodes": (EpisodeEnd(steps - 1, 1.5, steps, 0.1, 0.2, 0.3, 5),),
    }
    return Segment(**{**values, **changes})  # type: ignore[arg-type]
