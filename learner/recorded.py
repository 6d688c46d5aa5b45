"""Updates recorded once and repeated as a whole: on a GPU as CUDA graphs, which the host starts with one call.

The batch, s and the learning rate lie at fixed addresses, where `Feed` copies them from pinned memory on a stream of
its own; TD errors are copied back without waiting, and read when they are wanted.
"""

from __future__ import annotations

import gc
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from coop.common.errors import first_line
from coop.common.process.output import warn
from coop.common.settings.config import RunConfig
from coop.common.transitions import MASKS, Batch
from coop.common.types import EnvSpec
from coop.learner.edl.branches import branching
from coop.learner.given import Given, indices
from coop.learner.losses import BatchColumns, Values, columns

Capture = Callable[[Callable[[], None], torch.device], Callable[[], None]]
"""Makes a function without arguments, of a device, repeatable; it may run before, but does not while it is recorded."""

_LANES = 3  # batches on their way to the device with their frames
_SMALL_LANES = 32  # without
_WARM_UPS = 3  # runs in which libraries choose their algorithms and allocate what stays
_LATE = 64  # TD errors of so many updates are on their way to the host
_ALIGNMENT = 64  # bytes


class Learner(Protocol):
    """What `Recorded` asks of the agent: its state, and its optimizers' counts of steps."""

    optimizers: list[Any]

    def state(self) -> dict[str, Any]:
        """The state for `load_state`."""

    def load_state(self, state: dict[str, Any]) -> None:
        """Restore a state from `state`."""


def cuda_graph(function: Callable[[], None], device: torch.device) -> Callable[[], None]:
    """Record a function as a CUDA graph; returns what repeats it. Raises RuntimeError if it can't be recorded.

    What may run side by side becomes parallel branches of the graph; if that can't be recorded, one line says so, and
    the graph has one branch.
    """
    torch.cuda.synchronize(device)
    side = torch.cuda.Stream(device)  # type: ignore[no-untyped-call]
    side.wait_stream(torch.cuda.current_stream(device))
    with torch.cuda.stream(side):
        for _ in range(_WARM_UPS):
            function()
    torch.cuda.current_stream(device).wait_stream(side)
    torch.cuda.synchronize(device)
    try:
        with branching():
            return captured(function, device)
    except RuntimeError as error:
        warn(f"updates are recorded without parallel branches, and take longer: {first_line(error)}")
        return captured(function, device)


def captured(function: Callable[[], None], device: torch.device) -> Callable[[], None]:
    """Record a function that has run before as a CUDA graph. If that fails, the device stays usable: RuntimeError."""
    torch.cuda.synchronize(device)
    number = torch.cuda.current_device() if device.index is None else device.index
    generator = torch.cuda.default_generators[number]
    kept, stream = generator.clone_state(), torch.cuda.current_stream(device)
    graph, pool = torch.cuda.CUDAGraph(), torch.cuda.graph_pool_handle()
    collected = gc.isenabled()
    gc.collect()
    gc.disable()  # the end of an older graph would end the recording
    try:
        # "thread_local": other threads may use the GPU meanwhile.
        with torch.cuda.graph(graph, pool, capture_error_mode="thread_local"):
            function()
    except BaseException:
        # PyTorch leaves its recording stream in use, the generator and the allocator in the midst of a recording.
        torch.cuda.set_stream(stream)
        generator.graphsafe_set_state(kept)
        with suppress(RuntimeError, AttributeError):
            torch._C._cuda_endAllocateToPool(number, pool)
            torch._C._cuda_releasePool(number, pool)
        raise
    finally:
        if collected:
            gc.enable()
    repeat: Callable[[], None] = graph.replay
    return repeat


class Late:
    """TD errors on their way to the host: float32 [batch]."""

    def __init__(self, slot: Tensor, copied: torch.cuda.Event | None) -> None:
        self._slot: Tensor | None = slot
        self._copied = copied
        self._values: Values | None = None

    def read(self) -> Values:
        """Wait for them, and return them."""
        if self._slot is not None:
            if self._copied is not None:
                self._copied.synchronize()
            self._values, self._slot = self._slot.numpy().copy(), None
        assert self._values is not None
        return self._values


class Recorded:
    """The updates of an agent, one recording for each acting role."""

    def __init__(
        self,
        learn: Callable[[int, Given], Tensor],
        config: RunConfig,
        spec: EnvSpec,
        device: torch.device,
        capture: Capture,
        agent: Learner,
    ) -> None:
        """learn: the update of a role with a batch; it returns the TD errors."""
        self._learn, self._device, self._capture, self._agent = learn, device, capture, agent
        self._size, self._gamma, self._spec = config.learner.batch_size, config.learner.gamma, spec
        self._feeds: dict[int, Feed] = {}  # by address of a mirror on the device; 0 for batches with their frames
        self._errors = torch.zeros(self._size, device=device)
        self._repeat: dict[tuple[Feed, int], Callable[[], None]] = {}
        self._on_gpu = device.type == "cuda"
        self._slots = pinned(torch.empty(_LATE, self._size), self._on_gpu)
        self._late: deque[Late] = deque(maxlen=_LATE)
        self._count = 0
        if self._on_gpu:
            torch.backends.cudnn.benchmark = True  # shapes never change

    def fits(self, batch: Batch) -> bool:
        """Whether a batch has the recorded sizes."""
        return len(batch) == self._size and batch.obs_index.shape[1] == self._spec.stack

    def run(self, acting: int, batch: Batch, s: float, rate: float) -> Late:
        """Start the update of a role with a batch. Raises RuntimeError if it can't be recorded."""
        feed = self._feed_of(batch)
        feed.load(batch, columns(batch, self._gamma), s, rate)
        if (feed, acting) not in self._repeat:
            self._record(feed, acting)
        self._repeat[feed, acting]()
        self._agent.optimizers[acting].steps += 1
        if len(self._late) == _LATE:
            self._late[0].read()  # its slot is the next one
        slot = self._slots[self._count % _LATE]
        slot.copy_(self._errors, non_blocking=True)
        late = Late(slot, event() if self._on_gpu else None)
        self._late.append(late)
        self._count += 1
        return late

    def _feed_of(self, batch: Batch) -> Feed:
        """What brings such batches to the device."""
        frames = batch.frames if isinstance(batch.frames, Tensor) else None
        address = 0 if frames is None else frames.data_ptr()
        if address not in self._feeds:
            self._feeds[address] = Feed(self._spec, self._size, self._device, frames)
        return self._feeds[address]

    def _record(self, feed: Feed, acting: int) -> None:
        """Record the update of a role with what a feed brings, and leave the agent as it was."""
        state = self._agent.state()

        def update() -> None:
            self._errors.copy_(self._learn(acting, feed.given))

        try:
            repeat = self._capture(update, self._device)
            if not self._on_gpu:
                repeat = self._uncounted(repeat, acting)
            self._repeat[feed, acting] = repeat
        finally:
            self._agent.load_state(state)

    def _uncounted(self, update: Callable[[], None], acting: int) -> Callable[[], None]:
        """An update that, like a recorded one, leaves the optimizer's count on the host as it is."""

        def run() -> None:
            optimizer = self._agent.optimizers[acting]
            steps = optimizer.steps
            update()
            optimizer.steps = steps

        return run


class Feed:
    """Batches on their way to fixed addresses of a device.

    given: the arrays there, which an update reads.
    """

    def __init__(self, spec: EnvSpec, size: int, device: torch.device, frames: Tensor | None = None) -> None:
        """frames: of a mirror on the device, <frame_dtype>[slots, *frame_shape]; None if batches bring their own."""
        self._layout = _Layout(spec, size, with_frames=frames is None)
        self._place = torch.zeros(self._layout.bytes, dtype=torch.uint8, device=device)
        self._copies: torch.cuda.Stream | None = None
        if device.type == "cuda" and frames is None:  # a batch without takes less time than a way beside the updates
            self._copies = torch.cuda.Stream(device)  # type: ignore[no-untyped-call]
        lanes = _LANES if frames is None else _SMALL_LANES
        self._lanes = deque(_Lane(self._layout, self._place, self._copies) for _ in range(lanes))
        views = self._layout.views(self._place)
        held = BatchColumns(**{name: views[name] for name in BatchColumns._fields if name in views})
        self._with_frames = frames is None
        self.given = Given(
            views["frames"] if frames is None else frames,
            views["index"], held, views["s"].view(()), views["rate"].view(()),
        )  # fmt: skip

    def load(self, batch: Batch, held: BatchColumns[NDArray[Any]], s: float, rate: float) -> None:
        """Begin to copy a batch; what the device does next sees it."""
        lane = self._lanes[0]
        self._lanes.rotate(-1)
        lane.await_copied()
        for name, values in zip(BatchColumns._fields, held, strict=True):
            if values is not None:
                lane.arrays[name][...] = values
        lane.arrays["index"][...] = indices(batch)
        lane.arrays["s"][...] = s
        lane.arrays["rate"][...] = rate
        used = self._layout.bytes
        if self._with_frames:
            lane.arrays["frames"][: len(batch.frames)] = batch.frames
            used = self._layout.offsets["frames"] + batch.frames.nbytes
        lane.send(used)


class _Lane:
    """Pinned memory on the host, and memory on the device behind it."""

    def __init__(self, layout: _Layout, place: Tensor, copies: torch.cuda.Stream | None) -> None:
        """copies: the stream that brings batches to the device beside the updates; None: that of the updates."""
        self._host = pinned(torch.zeros(layout.bytes, dtype=torch.uint8), place.is_cuda)
        self._behind = None if copies is None else torch.empty_like(place)
        self._place, self._copies = place, copies
        self._sent: torch.cuda.Event | None = None
        self._taken: torch.cuda.Event | None = None
        self.arrays: dict[str, NDArray[Any]] = {name: view.numpy() for name, view in layout.views(self._host).items()}

    def await_copied(self) -> None:
        """Wait until the host's memory may be written again."""
        if self._sent is not None:
            self._sent.synchronize()

    def send(self, used: int) -> None:
        """Copy the first bytes to their place, with `copies` by way of the device's memory behind the lane."""
        copies = self._copies
        if copies is None or self._behind is None:
            self._place[:used].copy_(self._host[:used], non_blocking=True)
            self._sent = event() if self._place.is_cuda else None
            return
        main = torch.cuda.current_stream(self._place.device)
        if self._taken is not None:
            copies.wait_event(self._taken)
        with torch.cuda.stream(copies):
            self._behind[:used].copy_(self._host[:used], non_blocking=True)
            self._sent = event()
        main.wait_event(self._sent)
        self._place[:used].copy_(self._behind[:used], non_blocking=True)
        self._taken = event()


class _Layout:
    """Where a batch's arrays lie in one run of bytes; frames, of which there may be fewer, come last.

    offsets: of each array. bytes: of all.
    """

    def __init__(self, spec: EnvSpec, size: int, with_frames: bool) -> None:
        rows = 2 * size * spec.stack
        self._parts: dict[str, tuple[torch.dtype, tuple[int, ...]]] = {
            "actions": (torch.int64, (size,)),
            "rewards": (torch.float32, (size,)),
            "discounts": (torch.float32, (size,)),
            "weights": (torch.float32, (size,)),
            "s": (torch.float32, (1,)),
            "rate": (torch.float32, (1,)),
            "index": (torch.int32, (rows,)),
        }
        if spec.masks:
            self._parts |= dict.fromkeys(MASKS, (torch.bool, (size, spec.num_actions)))
        if with_frames:
            self._parts["frames"] = (getattr(torch, spec.frame_dtype), (rows, *spec.frame_shape))
        self.offsets: dict[str, int] = {}
        self.bytes = 0
        for name, (dtype, shape) in self._parts.items():
            self.offsets[name] = self.bytes
            length = int(np.prod(shape)) * dtype.itemsize
            self.bytes += -(-length // _ALIGNMENT) * _ALIGNMENT

    def views(self, memory: Tensor) -> dict[str, Tensor]:
        """The arrays in uint8 [bytes]."""
        found = {}
        for name, (dtype, shape) in self._parts.items():
            start = self.offsets[name]
            length = int(np.prod(shape)) * dtype.itemsize
            found[name] = memory[start : start + length].view(dtype).view(shape)
        return found


def pinned(memory: Tensor, on_gpu: bool) -> Tensor:
    """Memory of the host that a GPU reads by itself; on a CPU the memory as it is."""
    return memory.pin_memory() if on_gpu else memory


def event() -> torch.cuda.Event:
    """What is reached once the present stream has done all that it has been given."""
    event = torch.cuda.Event()  # type: ignore[no-untyped-call]
    event.record()
    return event
