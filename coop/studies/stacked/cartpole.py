"""CartPole and every random number of a stack's runs, on the runs' device.

A random number is a hash of the run's seed, the step and a lane, so a run does not depend on those beside it.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from coop.studies.stacked.settings import Runs, StackSettings

GRAVITY, POLE_MASS, TOTAL_MASS, HALF_LENGTH, FORCE, TAU = 9.8, 0.1, 1.1, 0.5, 10.0, 0.02
MAX_X, MAX_ANGLE = 2.4, 12 * 2 * math.pi / 360
LANES = 256  # random numbers of one run and step
_EXPLORES, _ACTION, _RESET, _NORMAL, _ROW, _BATCH = 0, 1, 2, 6, 8, 16
_MASK = 0xFFFFFFFF


def move(state: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
    """One step of every cart: state float64 [..., 4], action [...] (1: right) -> the next state, and whether it fell.

    The arithmetic is gymnasium's, operation by operation.
    """
    x, x_dot, theta, theta_dot = state.unbind(-1)
    force = torch.where(action == 1, FORCE, -FORCE)
    cos, sin = theta.cos(), theta.sin()
    temp = (force + POLE_MASS * HALF_LENGTH * theta_dot.square() * sin) / TOTAL_MASS
    theta_acc = (GRAVITY * sin - cos * temp) / (HALF_LENGTH * (4.0 / 3.0 - POLE_MASS * cos.square() / TOTAL_MASS))
    x_acc = temp - POLE_MASS * HALF_LENGTH * theta_acc * cos / TOTAL_MASS
    x, theta = x + TAU * x_dot, theta + TAU * theta_dot
    moved = torch.stack((x, x_dot + TAU * x_acc, theta, theta_dot + TAU * theta_acc), -1)
    return moved, (x.abs() > MAX_X) | (theta.abs() > MAX_ANGLE)


def keys_of(runs: Runs, device: torch.device) -> Tensor:
    """Three 32-bit keys of each run, from its seed: int64 [3, K]."""
    words = [np.random.SeedSequence([int(seed), 4]).generate_state(3) for seed in runs.seeds]
    return torch.tensor(np.array(words, np.int64).T.copy(), device=device)


def mixed(x: Tensor) -> Tensor:
    """A bijective hash of 32-bit numbers: int64 [...], each below 2^32."""
    x = ((x ^ (x >> 16)) * 0x7FEB352D) & _MASK
    x = ((x ^ (x >> 15)) * 0x846CA68B) & _MASK
    return x ^ (x >> 16)


def bits(keys: Tensor, counter: Tensor) -> Tensor:
    """32 random bits as int64 [..., K, lanes], from keys [2 or more, K] and a counter broadcast to the same shape."""
    return mixed((mixed(counter ^ keys[0][:, None]) + keys[1][:, None]) & _MASK)


def normal(words: Tensor) -> Tensor:
    """One number of N(0, 1) from each 32 random bits, float32: its two halves, by Box and Muller."""
    radius = (-2 * (((words >> 16).float() + 0.5) / 65536).log()).sqrt()
    return radius * ((words & 0xFFFF).float() * (2 * math.pi / 65536)).cos()


class RandomNumbers(NamedTuple):
    """What chance and the schedules decide for a block of n steps, before any network is asked.

    Attributes:
        step: int64 [n], steps done before each.
        action: int64 [n, K], the random action, or -1 for the greedy one.
        reset: float64 [n, K, 4], the state after an episode's end.
        row: int64 [n, K], where the transition goes in the tables laid end to end.
        batch: int64 [n, K, batch], the transitions of the update there.
        s: float32 [n, K]. rate: float32 [n, K], the learning rate.
        corrections: float32 [n, 2], Adam's. update: int64 [n], updates done before each (0 before the first).
    """

    step: Tensor
    action: Tensor
    reset: Tensor
    row: Tensor
    batch: Tensor
    s: Tensor
    rate: Tensor
    corrections: Tensor
    update: Tensor


class Chance:
    """Draws for the blocks of a stack's runs."""

    def __init__(self, settings: StackSettings, runs: Runs, device: torch.device) -> None:
        def there(values: object, dtype: torch.dtype = torch.float32) -> Tensor:
            return torch.tensor(np.asarray(values), dtype=dtype, device=device)

        self._settings = settings
        self.keys = keys_of(runs, device)
        self._lanes = torch.arange(_BATCH + settings.batch_size, device=device)
        self._base = torch.arange(len(runs.seeds), device=device) * (settings.capacity + 1)
        self._epsilons = there(settings.epsilons)
        self._rates = there(settings.rates, torch.float64)
        self._scales = there(settings.exploration_rates, torch.float64)
        self._corrections = there(np.stack(settings.corrections, 1))
        self._rate, self._s = there(runs.rates, torch.float64), there(runs.s, torch.float64)

    def first_states(self) -> Tensor:
        """The states with which the runs begin: float64 [K, 4]."""
        words = bits(self.keys, self._lanes[_RESET:_NORMAL] + (1 << 31))
        return words.double() * (2.0**-32 * 0.1) - 0.05

    def draws(self, first: int, count: int) -> RandomNumbers:
        """The draws of `count` steps, of which `first` steps are done before; only `first` comes from the host."""
        settings = self._settings
        step = torch.arange(count, device=self.keys.device) + first
        words = bits(self.keys, (step * LANES)[:, None, None] + self._lanes)
        share = words[..., :_NORMAL].double() * 2.0**-32
        random = share[..., _EXPLORES] < self._epsilons[step][:, None]
        # Transition i gets row j of 0..i (reservoir), or i modulo the capacity; the last row holds what is not kept.
        ring = step % settings.capacity
        row = ring[:, None].expand(-1, words.shape[1])
        if settings.eviction == "reservoir":
            drawn = (words[..., _ROW] * (step + 1)[:, None]) >> 32
            row = torch.where(step[:, None] < settings.capacity, row, drawn.clamp_max(settings.capacity))
        size = (step + 1).clamp_max(settings.capacity)[:, None, None]
        update = (step + 1 - settings.learning_starts - 1).clamp_min(0)
        s = self._scales[update][:, None] * self._s
        if settings.noise == "normal":
            s = s * normal(words[..., _NORMAL])
        return RandomNumbers(
            step=step,
            action=torch.where(random, words[..., _ACTION] & 1, -1),
            reset=share[..., _RESET:_NORMAL] * 0.1 - 0.05,
            row=row + self._base,
            batch=((words[..., _BATCH:] * size) >> 32) + self._base[:, None],
            s=s.float(),
            rate=(self._rates[update][:, None] * self._rate).float(),
            corrections=self._corrections[update],
            update=update,
        )

    def gaussian(self, update: Tensor, size: int) -> Tensor:
        """Numbers of N(0, 1) for an update, an int64 scalar on the device: float32 [K, size]."""
        keys = mixed(mixed(update ^ self.keys[2]) ^ self.keys[0])
        return normal(mixed(torch.arange(size, device=keys.device) ^ keys[:, None]))
