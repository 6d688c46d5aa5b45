"""Speed and memory of the table on one core: `python benchmarks/table.py`.

Inserts and samples alternate, round by round, with bare numpy copies of the same bytes, so that the ratios hold on a
busy machine. Prints medians with the range over the rounds, then bytes per transition and the pause of a snapshot.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator
from itertools import count, cycle
from pathlib import Path

import msgspec
import numpy as np

from common.settings.capacity import estimated_bytes
from common.types import EnvSpec, Segment
from replay.table.table import Table

ROUNDS = 9
REPEATS = 200
BATCH = 32
ATARI = EnvSpec("Atari", (84, 84), "uint8", 4, 4)
CARTPOLE = EnvSpec("CartPole", (4,), "float32", 1, 2)
POLICIES = [(e, s) for e in ("fifo", "reservoir", "prioritized") for s in ("uniform", "prioritized")]


def segments(spec: EnvSpec, steps: int, streams: int = 8) -> Iterator[Segment]:
    """Yield segments of several streams without end, all steps within episodes, each repeating one stack of frames."""
    rng = np.random.default_rng(0)
    frames = rng.integers(0, 256, (streams, steps + spec.stack, *spec.frame_shape)).astype(spec.frame_dtype)
    frames[:, : spec.stack] = frames[:, steps:]  # the next segment of a stream begins as the last one ended
    index = (np.arange(steps)[:, None] + np.arange(spec.stack)).astype(np.int32)
    first = Segment(
        incarnation=1,
        stream=0,
        sequence=0,
        frames=frames[0],
        obs_index=index,
        next_index=index + 1,
        actions=rng.integers(0, spec.num_actions, steps).astype(np.int32),
        rewards=rng.random(steps, np.float32),
        terminated=np.zeros(steps, np.bool_),
        param_version=np.zeros(steps, np.int64),
    )
    for sequence in count():
        carried = spec.stack if sequence else 0
        for stream in range(streams):
            changed = {"stream": stream, "sequence": sequence, "frames": frames[stream], "carried": carried}
            yield msgspec.structs.replace(first, **changed)


def seconds(action: Callable[[], object]) -> float:
    """Seconds per call, mean of `REPEATS` calls."""
    start = time.perf_counter()
    for _ in range(REPEATS):
        action()
    return (time.perf_counter() - start) / REPEATS


def bare_copies(spec: EnvSpec, capacity: int, steps: int) -> tuple[Callable[[], object], Callable[[], object]]:
    """(copy a segment's new frames into a ring, gather a batch's frames from it): the minimal work of any table."""
    rng = np.random.default_rng(1)
    ring = np.ones((capacity, *spec.frame_shape), spec.frame_dtype)
    source = np.ones((steps, *spec.frame_shape), spec.frame_dtype)
    places = cycle(range(0, capacity - steps, steps))
    starts = rng.integers(0, capacity - spec.stack, (1000, BATCH, 1))
    picks = cycle((starts + np.arange(spec.stack + 1)).reshape(1000, -1))

    def insert() -> None:
        place = next(places)
        ring[place : place + steps] = source

    return insert, lambda: ring.take(next(picks), axis=0)


def resident_bytes() -> int:
    """Resident bytes of this process."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4096


def speed(spec: EnvSpec, capacity: int, steps: int, eviction: str, sampling: str) -> None:
    """Insert one and a half times a table's capacity, then time it against bare copies."""
    table = Table(spec, capacity, eviction=eviction, sampling=sampling, rng=np.random.default_rng(0))
    stream = segments(spec, steps)
    while table.inserted < 1.5 * capacity:
        table.insert(next(stream))
    bare_insert, bare_sample = bare_copies(spec, capacity, steps)
    priorities = np.random.default_rng(2)

    def sample() -> None:
        batch = table.sample(BATCH)
        if "prioritized" in (eviction, sampling):
            table.update_priorities(batch.ids, priorities.random(BATCH))

    rounds = [
        (seconds(lambda: table.insert(next(stream))), seconds(bare_insert), seconds(sample), seconds(bare_sample))
        for _ in range(ROUNDS)
    ]
    inserts, bare_inserts, samples, bare_samples = (np.array(column) for column in zip(*rounds, strict=True))
    figures = [f"{spec.env_id:8} {f'{eviction} / {sampling}':25}"]
    for amount, ours, bare in ((steps, inserts, bare_inserts), (BATCH, samples, bare_samples)):
        rate = amount / ours
        figures.append(f"{np.median(rate):9,.0f} ({rate.min():9,.0f} to {rate.max():9,.0f})")
        ratio = f"{np.median(ours / bare):4.1f}x" if spec is ATARI else ""  # copying 16 bytes is no useful reference
        figures.append(f"{1e6 * np.median(ours):5.0f} us {ratio:5}")
    print("  ".join(figures), flush=True)


def memory(spec: EnvSpec, capacity: int, steps: int) -> None:
    """Fill a fifo table, and print its size, the process's growth, and the size of a million transitions."""
    stream = segments(spec, steps)
    first = next(stream)
    before = resident_bytes()
    table = Table(spec, capacity, rng=np.random.default_rng(0))
    table.insert(first)
    while table.inserted < 2 * capacity:
        table.insert(next(stream))
    grown = (resident_bytes() - before) / capacity
    stats = table.stats()
    print(f"{spec.env_id}, {capacity:,} transitions, fifo: {stats.frames_held:,} frames held,")
    print(f"  bytes per transition: {stats.bytes_held / capacity:,.1f} held, {grown:,.1f} by the process's memory")
    frame = int(np.prod(spec.frame_shape)) * np.dtype(spec.frame_dtype).itemsize
    each = estimated_bytes(spec, 1)
    extra = stats.frames_held - capacity
    million = each + extra * frame / 1e6
    print(f"  at 1,000,000: {each} each ({frame} frame + {each - frame} indices, columns and counters)")
    print(f"  + {extra} frames x {frame} shared by all = {million:,.1f} per transition")
    pauses = []
    for _ in range(ROUNDS):
        start = time.perf_counter()
        _, _, frames = table.snapshot()
        pauses.append(1e3 * (time.perf_counter() - start))
        with frames:
            table.insert(next(stream))
    print(f"  pause for a snapshot: {np.median(pauses):.1f} ms ({min(pauses):.1f} to {max(pauses):.1f})")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--capacity", type=int, default=20_000, help="of the table whose memory is measured")
    options = parser.parse_args()
    print(
        f"{ROUNDS} alternating rounds of {REPEATS} calls: median (range). x: time over bare copies of the same frames."
    )
    print("A sample includes the priority update that follows it, where a policy uses priorities.")
    print(f"{'':36}{'inserted/s':>35}  {'per call':>8}      {'sampled/s, batches of 32':>38}  {'per call':>8}")
    for spec, capacity, steps in ((ATARI, 10_000, 64), (CARTPOLE, 5_000, 16)):
        for eviction, sampling in POLICIES:
            speed(spec, capacity, steps, eviction, sampling)
    memory(ATARI, options.capacity, 64)


if __name__ == "__main__":
    main()
