"""Runs of Algorithm 1 on CartPole, all in step: act, store, sample, update, change roles.

    stack = Stack(settings, Runs.of(seeds, "adam", 5e-4, s=0.0), "cuda")
    stack.advance(settings.total_steps)
    stack.episodes()

A step is the same few operations for every run, and reads nothing back. On a GPU a block of steps is a CUDA graph, of
Triton's kernels (`coop.studies.stacked.kernels`) where they fit and of PyTorch's operations otherwise.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from coop.learner.recorded import captured
from coop.studies.stacked import networks
from coop.studies.stacked.cartpole import Chance, RandomNumbers, move
from coop.studies.stacked.networks import StackTape, shape_of
from coop.studies.stacked.settings import Runs, StackSettings

COLUMNS = 10  # of the table: obs, next_obs, action, terminated
BLOCK = 32  # steps, at most, of a captured block


class Episodes(NamedTuple):
    """The finished episodes of one run: env_step int64 [episodes], at their ends, and returns int64 [episodes]."""

    env_step: NDArray[np.int64]
    returns: NDArray[np.int64]


class Stack:
    """K runs, from their first step on.

    Attributes:
        step: environment steps done, of each run. updates: updates done, of each run.
        theta: float32 [2, K, size], both networks. mean, square: float32 [1 or 2, K, size], the optimizers'.
        table: float32 [K (capacity + 1), 10], the runs' transitions end to end; a table's last row holds none.
    """

    def __init__(
        self,
        settings: StackSettings,
        runs: Runs,
        device: str = "cpu",
        *,
        kernels: bool = True,
        precision: str = "tf32x3",
    ) -> None:
        """kernels: use Triton's on a GPU. precision: of their products, "tf32x3", "ieee" or "tf32"."""
        self.settings, self.runs, self.device = settings, runs, torch.device(device)
        self.shape = shape_of(settings.hidden, settings.width)
        self.step = self.updates = 0
        count, size = len(runs.seeds), self.shape.size
        trained = 2 if settings.two_networks else 1
        begun = {
            (seed, number): self.shape.initial(seed, number)
            for seed in set(runs.seeds.tolist())
            for number in range(trained)
        }
        theta = [torch.stack([begun[seed, number % trained] for seed in runs.seeds.tolist()]) for number in (0, 1)]
        self.theta = torch.stack(theta).to(self.device)
        self.mean, self.square = (torch.zeros(trained, count, size, device=self.device) for _ in range(2))
        self.gradient = torch.zeros(count, size, device=self.device)
        self.table = torch.zeros(count * (settings.capacity + 1), COLUMNS, device=self.device)
        self.ended = torch.zeros(settings.total_steps, count, dtype=torch.int16, device=self.device)
        self.chance = Chance(settings, runs, self.device)
        self.state = self.chance.first_states()
        self.length = torch.zeros(count, dtype=torch.int16, device=self.device)
        if settings.feedback == "random":
            fixed = [networks.fixed_feedback(self.shape, seed) for seed in runs.seeds.tolist()]
            self.fixed = torch.stack(fixed).to(self.device)
        self.segments: list[tuple[str, slice]] = []
        start = 0
        for name, many in runs.optimizers:
            self.segments.append((name, slice(start, start + many)))
            start += many
        self._every = max(n for n in range(1, BLOCK + 1) if settings.swap_every % n == 0)
        self._draws: RandomNumbers | None = None  # of a captured block
        self._replays: dict[int, Callable[[], None]] = {}
        self._kernel_step, self.path = self._choose(kernels, precision)

    def _choose(self, kernels: bool, precision: str) -> tuple[Callable[[RandomNumbers, int, int], None] | None, str]:
        """A step by Triton's kernels, or None, and what a block of steps is made of, in words."""
        if self.device.type != "cuda":
            return None, "PyTorch's operations"
        if not kernels:
            return None, "CUDA graphs of PyTorch's operations"
        try:
            from coop.studies.stacked import kernels as ours  # noqa: PLC0415 (Triton is there on a GPU only)
        except ImportError as error:
            return None, f"CUDA graphs of PyTorch's operations: {error}"
        if (reason := ours.why_not(self.settings)) is not None:
            return None, f"CUDA graphs of PyTorch's operations: {reason}"
        return ours.Kernels(self, precision).step, f"CUDA graphs of Triton's kernels, {precision}"

    def advance(self, steps: int) -> None:
        """Play `steps` more steps of every run."""
        with torch.inference_mode(), _no_denormals():
            while steps > 0:
                steps -= self._block(steps)

    def _block(self, most: int) -> int:
        """Play steps that have one role and no change of it before their end; return how many."""
        settings = self.settings
        learning = self.step >= settings.learning_starts
        before = (
            settings.swap_every - self.updates % settings.swap_every
            if learning
            else settings.learning_starts - self.step
        )
        count = min(most, before, self._every)
        draws, role = self.chance.draws(self.step, count), settings.role(self.updates)
        if learning and count == self._every and self._captures:
            self._replay(draws, role)
        else:
            self.play(draws, learning, role)
        self.step += count
        if learning:
            self.updates += count
            if self.updates % settings.swap_every == 0 and not settings.two_networks:
                self.theta[1].copy_(self.theta[0])
        return count

    @property
    def _captures(self) -> bool:
        """Whether blocks become graphs; the decompositions of a weight gradient can't."""
        return self.device.type == "cuda" and self.settings.feedback != "weight-gradient"

    def _replay(self, draws: RandomNumbers, role: int) -> None:
        """Play a block of `_every` steps as a graph; the first block of a role is played without one, and warms up."""
        if self._draws is None:
            self._draws = RandomNumbers(*(each.clone() for each in draws))
        for kept, new in zip(self._draws, draws, strict=True):
            kept.copy_(new)
        if role in self._replays:
            self._replays[role]()
            return
        stream = torch.cuda.Stream()  # type: ignore[no-untyped-call]
        stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(stream):
            self.play(self._draws, True, role)
        torch.cuda.current_stream().wait_stream(stream)
        held = self._draws
        self._replays[role] = captured(lambda: self.play(held, True, role), self.device)

    def play(self, draws: RandomNumbers, learning: bool, role: int) -> None:
        """Play the steps of a block; network `role` acts, and is trained if `learning`."""
        for number in range(len(draws.step)):
            if learning and self._kernel_step is not None:
                self._kernel_step(draws, number, role)
                continue
            self.act(draws, number, role)
            if learning:
                self.update(draws, number, role)

    def act(self, draws: RandomNumbers, number: int, role: int) -> None:
        """Step `number` of a block up to its transition's place in the table."""
        settings = self.settings
        obs = self.state.float()
        values = networks.forward(self.shape, self.theta[role], obs[:, None]).values[:, 0]
        drawn = draws.action[number]
        action = torch.where(drawn < 0, (values[:, 1] > values[:, 0]).long(), drawn)
        moved, fell = move(self.state, action)
        next_obs = moved.float()
        self.length += 1
        over = fell | (self.length >= settings.time_limit)
        terminal = over if settings.time_limit_terminal else fell
        row = torch.cat((obs, next_obs, action[:, None], terminal[:, None]), 1)
        self.table.index_copy_(0, draws.row[number], row)
        self.ended.index_copy_(0, draws.step[number : number + 1], (self.length * over)[None])
        self.length *= ~over
        torch.where(over[:, None], draws.reset[number], moved, out=self.state)

    def update(self, draws: RandomNumbers, number: int, role: int) -> None:
        """Train network `role` towards the other one's targets, with the batch of step `number` of a block."""
        batch = self.table.index_select(0, draws.batch[number].view(-1)).view(*draws.batch[number].shape, COLUMNS)
        tape, error = self.errors(batch, role)
        scale = self.feedback(tape, error, draws, number, role)
        for name, part in self.segments:
            step = networks.step_of(
                self.settings, name, self.gradient[part], self.mean[role, part], self.square[role, part],
                draws.corrections[number],
            )  # fmt: skip
            rate = draws.rate[number, part, None]
            self.theta[role, part].sub_(step * (rate if scale is None else rate * scale[part]))

    def errors(self, batch: Tensor, role: int) -> tuple[StackTape, Tensor]:
        """The forward pass of the batch's observations, and the output error, float32 [K, batch, 2]."""
        settings, size = self.settings, batch.shape[1]
        obs, next_obs = batch[..., :4], batch[..., 4:8]
        both = networks.forward(self.shape, self.theta[role], torch.cat((obs, next_obs), 1) if settings.double else obs)
        target = networks.forward(self.shape, self.theta[1 - role], next_obs).values
        tape = StackTape([h[:, :size] for h in both.h], both.values[:, :size])
        chosen = both.values[:, size:] if settings.double else target
        errors = networks.td_errors(settings, batch, tape.values, chosen, target)
        return tape, networks.output_error(settings, errors, batch[..., 8])

    def feedback(self, tape: StackTape, error: Tensor, draws: RandomNumbers, number: int, role: int) -> Tensor | None:
        """Write the gradient by the runs' feedback; return factors of the learning rate, [K, size], if it has some.

        noise: the plain gradient, and in each layer normal noise with the length of what transform would add to it.
        matched: the plain gradient, with each layer's rate multiplied by |transform's gradient| / |plain gradient|.
        """
        shape, theta, s, kind = self.shape, self.theta[role], draws.s[number], self.settings.feedback
        if kind == "transform":
            deltas = networks.error_driven(shape, theta, tape, error, s)
        elif kind == "random":
            deltas = networks.aligned(self.fixed, error)
        else:
            deltas = networks.backward(shape, theta, tape, error)
        networks.write_gradient(shape, tape, deltas, self.gradient)
        if kind == "weight-gradient":
            noise = self.chance.gaussian(draws.update[number], 2 * shape.width * len(shape.layers))
            parts = zip(shape.views(self.gradient), deltas, tape.h, noise.chunk(len(shape.layers), 1), strict=True)
            for (weight, _), delta, h, part in parts:
                weight.add_(s[:, None, None] * networks.polar_of_gradient(delta, h, part))
        if kind not in ("noise", "matched"):
            return None
        driven = networks.error_driven(shape, theta, tape, error, s)
        other = networks.write_gradient(shape, tape, driven, torch.zeros_like(self.gradient))
        if kind == "matched":
            ratio = (shape.sums(other.square()) / shape.sums(self.gradient.square()).clamp_min(_TINY)).sqrt()
            return shape.by_layer(ratio)
        length = (shape.sums((other - self.gradient).square()) / shape.counts(self.device)).sqrt()
        noise = self.chance.gaussian(draws.update[number], shape.size)
        self.gradient.add_(shape.by_layer(length) * noise)
        return None

    def episodes(self) -> list[Episodes]:
        """The finished episodes of each run so far."""
        lengths = self.ended[: self.step].t().contiguous().cpu().numpy()
        found = []
        for run in lengths:
            ends = np.flatnonzero(run)
            found.append(Episodes(ends + 1, run[ends].astype(np.int64)))
        return found

    def finite(self) -> NDArray[np.bool_]:
        """Whether each run's parameters are finite: bool [K]."""
        return np.asarray(self.theta.isfinite().all(2).all(0).cpu().numpy())


_TINY = 1e-30


@contextmanager
def _no_denormals() -> Iterator[None]:
    """Set denormals to 0 meanwhile, as the product's optimizers do: with them a step takes many times as long."""
    torch.set_flush_denormal(True)
    try:
        yield
    finally:
        torch.set_flush_denormal(False)
