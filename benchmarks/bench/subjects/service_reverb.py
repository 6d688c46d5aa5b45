"""A Reverb server over loopback, a uniform table of the same items; frames are stored once: service_reverb.py."""

from __future__ import annotations

import multiprocessing
import os
from contextlib import ExitStack
from multiprocessing.connection import Connection

os.environ["TF_CPP_MIN_LOG_LEVEL"] = "3"

import numpy as np
import reverb
import tensorflow as tf
from service_work import BATCH, CAPACITY, STEPS, Inserters, attend_service, insert_on_demand

TABLE = "table"
STACK = 4  # an item is this many frames and the next one
FRAME = (84, 84)
AHEAD = 256  # items drawn ahead, as our client asks for eight batches ahead


def server(end: Connection) -> None:
    table = reverb.Table(
        TABLE,
        sampler=reverb.selectors.Uniform(),
        remover=reverb.selectors.Fifo(),
        max_size=CAPACITY,
        rate_limiter=reverb.rate_limiters.MinSize(1000),
        signature={
            "frames": tf.TensorSpec((STACK + 1, *FRAME), tf.uint8),
            "action": tf.TensorSpec((), tf.int32),
            "reward": tf.TensorSpec((), tf.float32),
            "terminated": tf.TensorSpec((), tf.bool),
        },
    )
    serving = reverb.Server([table])
    end.send(serving.port)
    end.recv()
    serving.stop()


def inserter(address: str, end: Connection) -> None:
    rng = np.random.default_rng(0)
    frames = rng.integers(0, 256, (STEPS, *FRAME)).astype(np.uint8)
    step = {"action": np.int32(1), "reward": np.float32(1), "terminated": np.bool_(False)}
    with reverb.Client(address).trajectory_writer(num_keep_alive_refs=STACK + 1) as writer:
        for frame in frames[: STACK + 1]:
            writer.append({"frames": frame, **step})

        def submit() -> None:
            for frame in frames:
                writer.append({"frames": frame, **step})
                last = {name: writer.history[name][-2] for name in step}
                writer.create_item(TABLE, 1.0, {"frames": writer.history["frames"][-STACK - 1 :], **last})
            writer.flush(block_until_num_items=16 * STEPS)  # as many in flight as our clients may have

        insert_on_demand(end, (submit, writer.flush))


def main() -> None:
    with ExitStack() as stack:
        spawn = multiprocessing.get_context("spawn")
        ours, theirs = spawn.Pipe()
        process = spawn.Process(target=server, args=(theirs,))
        process.start()
        stack.callback(process.join)
        stack.callback(ours.send, None)
        address = f"localhost:{ours.recv()}"
        inserters = Inserters(stack, inserter, address)
        inserters.insert(2.0)
        items = reverb.TrajectoryDataset.from_table_signature(address, TABLE, max_in_flight_samples_per_worker=AHEAD)
        batches = iter(items.batch(BATCH).prefetch(8).as_numpy_iterator())
        attend_service(inserters, lambda: next(batches))


if __name__ == "__main__":
    main()
