"""The loops between the products of K updates, compiled by numba: the arithmetic of lockstep's numpy, to the bit.

Each function works on a block of runs, the first axis. All numbers are float32 unless said otherwise, and every
operation rounds on its own: numba contracts nothing without `fastmath`.
"""

from __future__ import annotations

import numpy as np

from coop.common.compiling import compiled
from coop.common.types import Array

LARGEST = np.finfo(np.float32).max


@compiled
def push(
    state: Array,
    cos: Array,
    sin: Array,
    values: Array,
    chosen: Array,
    physics: Array,
    limit: int,
    limit_terminal: bool,
    lengths: Array,
    actions: Array,
    obs: Array,
    terminal: Array,
    over: Array,
) -> bool:
    """Choose an action of each run, and push its cart: gymnasium's CartPole, operation by operation, in float64.

    state: [K, 4], written; cos, sin: of its angles, [K]. values: float32 [K, 2]. chosen: int64 [K], -1: the greedy
    action. physics: as `Carts` has them. limit: steps of an episode, 0: none; limit_terminal: whether it counts as a
    terminal state. lengths: [K], counted up. actions: int64 [K], float32 obs: [K, 4], terminal, over: bool [K], all
    written. Returns whether an episode is over.
    """
    gravity, pole, total, length, both, push, tau, widest, steepest = physics
    some = False
    for k in range(state.shape[0]):
        actions[k] = chosen[k]
        if chosen[k] < 0:
            first, second = values[k, 0], values[k, 1]
            actions[k] = 1 if second > first or (np.isnan(second) and not np.isnan(first)) else 0  # as argmax
        force = push if actions[k] == 1 else -push
        x_dot, theta_dot = state[k, 1], state[k, 3]
        temp = (force + both * (theta_dot * theta_dot) * sin[k]) / total
        theta_acc = (gravity * sin[k] - cos[k] * temp) / (length * (4.0 / 3.0 - pole * (cos[k] * cos[k]) / total))
        x_acc = temp - both * theta_acc * cos[k] / total
        state[k, 0] += tau * x_dot
        state[k, 1] = x_dot + tau * x_acc
        state[k, 2] += tau * theta_dot
        state[k, 3] = theta_dot + tau * theta_acc
        for j in range(4):
            obs[k, j] = np.float32(state[k, j])
        lengths[k] += 1
        fell = np.abs(state[k, 0]) > widest or np.abs(state[k, 2]) > steepest
        over[k] = fell or lengths[k] == limit
        terminal[k] = over[k] if limit_terminal else fell
        some |= over[k]
    return some


@compiled
def gather(
    obs: Array,
    next_obs: Array,
    actions: Array,
    rewards: Array,
    terminated: Array,
    versions: Array,
    spans: Array,
    ids: Array,
    reuse: Array,
    rows: Array,
    powers: Array,
    x: Array,
    taken: Array,
    gained: Array,
    discounts: Array,
    seen: Array,
    largest: Array,
    now: Array,
) -> None:
    """Read a batch of each table, and count the draws.

    obs, next_obs: [n, capacity, width], and the other columns [n, capacity]. rows: int64 [n, batch]. x: [n, 2 batch,
    width], written, obs before next_obs. taken: int64 [n, batch], gained, the rewards, and discounts [n, batch], powers
    of gamma, written. seen: int64 [n, 5, batch], written: ids, ages, draws, weight lags, terminations. largest: [n],
    raised to the largest |reward|. now: int64 [2], transitions and updates.
    """
    for k in range(rows.shape[0]):
        size = rows.shape[1]
        for b in range(size):
            reuse[k, rows[k, b]] += 1
        for b in range(size):
            row = rows[k, b]
            for j in range(x.shape[2]):
                x[k, b, j] = obs[k, row, j]
                x[k, size + b, j] = next_obs[k, row, j]
            taken[k, b] = actions[k, row]
            gained[k, b] = rewards[k, row]
            largest[k] = max(largest[k], np.abs(rewards[k, row]))
            discounts[k, b] = powers[spans[k, row]] * (np.float32(0) if terminated[k, row] else np.float32(1))
            seen[k, 0, b] = ids[k, row]
            seen[k, 1, b] = now[0] - 1 - ids[k, row]
            seen[k, 2, b] = reuse[k, row]
            seen[k, 3, b] = now[1] - versions[k, row]
            seen[k, 4, b] = 1 if terminated[k, row] else 0


@compiled
def insert(
    rows: Array,
    new_obs: Array,
    new_next: Array,
    new_actions: Array,
    new_rewards: Array,
    terminal: Array,
    version: int,
    span: int,
    number: int,
    capacity: int,
    obs: Array,
    next_obs: Array,
    actions: Array,
    rewards: Array,
    terminated: Array,
    versions: Array,
    spans: Array,
    ids: Array,
    reuse: Array,
    evicted: Array,
    held: Array,
) -> None:
    """Put a transition of each run into its row, int64 [K], -1 for none; the columns are as `gather` has them.

    new_obs, new_next: [K, width]. new_actions, new_rewards, terminal: [K]. version, span, number: of the transition.
    evicted: int64 [K, buckets], evicted transitions by the bit length of their draws. held: int64 [K], terminal
    transitions.
    """
    for k in range(rows.shape[0]):
        row = rows[k]
        if row < 0:
            evicted[k, 0] += 1
            continue
        if number >= capacity:
            bucket, draws = 0, reuse[k, row]
            while draws > 0 and bucket < evicted.shape[1] - 1:
                draws >>= 1
                bucket += 1
            evicted[k, bucket] += 1
        held[k] += int(terminal[k]) - int(terminated[k, row])
        for j in range(new_obs.shape[1]):
            obs[k, row, j] = new_obs[k, j]
            next_obs[k, row, j] = new_next[k, j]
        actions[k, row] = new_actions[k]
        rewards[k, row] = new_rewards[k]
        terminated[k, row] = terminal[k]
        versions[k, row] = version
        spans[k, row] = span
        ids[k, row] = number
        reuse[k, row] = 0


@compiled
def rectify(
    columns: Array,
    bias: Array,
) -> None:
    """Columns [n, units, batch] <- max(columns + bias, 0), bias [n, units]; nan stays nan."""
    zero = np.float32(0)
    for k in range(columns.shape[0]):
        for i in range(columns.shape[1]):
            shift, line = bias[k, i], columns[k, i]
            for b in range(line.shape[0]):
                value = line[b] + shift
                line[b] = zero if value <= zero else value


@compiled
def rectify_both(
    columns: Array,
    bias: Array,
    h: Array,
) -> None:
    """As `rectify`; h [n, rows, units] becomes the transpose of its first columns."""
    zero = np.float32(0)
    rows, units = h.shape[1], h.shape[2]
    for k in range(columns.shape[0]):
        for start in range(0, units, 16):
            stop = min(start + 16, units)
            for i in range(start, stop):
                shift, line = bias[k, i], columns[k, i]
                for b in range(line.shape[0]):
                    value = line[b] + shift
                    line[b] = zero if value <= zero else value
            for b in range(rows):
                for i in range(start, stop):
                    h[k, b, i] = columns[k, i, b]


@compiled
def shift(
    columns: Array,
    bias: Array,
) -> None:
    """Columns [n, actions, batch] <- columns + bias."""
    for k in range(columns.shape[0]):
        for i in range(columns.shape[1]):
            for b in range(columns.shape[2]):
                columns[k, i, b] += bias[k, i]


@compiled
def temporal(
    values: Array,
    next_values: Array,
    preferred: Array,
    taken: Array,
    rewards: Array,
    discounts: Array,
    bound: np.float32,
    loss: int,
    errors: Array,
    out: Array,
) -> bool:
    """The TD errors [n, batch], and the output error [n, actions, batch], both written; returns if all are finite.

    values, next_values, preferred: [n, actions, batch]. bound: of the values, 0: none. loss: 0 squared, 1 mse, 2 huber.
    """
    one, zero = np.float32(1), np.float32(0)
    size, finite = taken.shape[1], True
    count = np.float32(size)
    for k in range(taken.shape[0]):
        for b in range(size):
            best = 0
            for a in range(1, preferred.shape[1]):  # as argmax
                most, other = preferred[k, best, b], preferred[k, a, b]
                if other > most or (np.isnan(other) and not np.isnan(most)):
                    best = a
            value = next_values[k, best, b]
            if bound > zero:
                value = -bound if value < -bound else bound if value > bound else value
            error = values[k, taken[k, b], b] - (rewards[k, b] + discounts[k, b] * value)
            errors[k, b] = error
            finite &= np.abs(error) <= LARGEST
            slope = error
            if loss == 1:
                slope = np.float32(2) * error
            elif loss == 2:
                slope = -one if error < -one else one if error > one else error
            for a in range(out.shape[1]):
                out[k, a, b] = zero
            out[k, taken[k, b], b] = slope / count
    return finite


@compiled
def summed(
    delta: Array,
    bias: Array,
) -> None:
    """Bias [n, units] <- the sums of delta [n, batch, units] over the batch."""
    for k in range(delta.shape[0]):
        sums = bias[k]
        for i in range(sums.shape[0]):
            sums[i] = delta[k, 0, i]
        for b in range(1, delta.shape[1]):
            line = delta[k, b]
            for i in range(sums.shape[0]):
                sums[i] += line[i]


@compiled
def masked(
    delta: Array,
    h: Array,
    bias: Array,
) -> None:
    """Delta [n, batch, units] <- delta * (h > 0); bias [n, units] <- its sums over the batch."""
    zero, one = np.float32(0), np.float32(1)
    for k in range(delta.shape[0]):
        for b in range(delta.shape[1]):
            line, active = delta[k, b], h[k, b]
            for i in range(line.shape[0]):
                line[i] *= one if active[i] > zero else zero
    summed(delta, bias)


@compiled
def spread(
    shared: Array,
    h: Array,
    t: Array,
) -> None:
    """T [n, 2, batch, units] <- shared [n, 2, 1, units] * (h > 0)."""
    zero, one = np.float32(0), np.float32(1)
    for k in range(t.shape[0]):
        for a in range(2):
            source = shared[k, a, 0]
            for b in range(t.shape[2]):
                line, active = t[k, a, b], h[k, b]
                for i in range(line.shape[0]):
                    line[i] = source[i] * (one if active[i] > zero else zero)


@compiled
def muted(
    t: Array,
    h: Array,
) -> None:
    """T [n, 2, batch, units] <- t * (h > 0)."""
    zero, one = np.float32(0), np.float32(1)
    for k in range(t.shape[0]):
        for a in range(2):
            for b in range(t.shape[2]):
                line, active = t[k, a, b], h[k, b]
                for i in range(line.shape[0]):
                    line[i] *= one if active[i] > zero else zero


@compiled
def whiten(
    grams: Array,
    e: Array,
    s: Array,
    limit: np.float32,
    square: np.float32,
    weights: Array,
    doubtful: Array,
) -> bool:
    """Weights [layers, n, batch, 2] <- e + s G^(-1/2) e, as `coop.learner.edl.polar` has it for 2 x 2.

    grams: [3, layers, n, batch], G's a, b and c. e: [n, batch, 2]. s: [n]. limit, square: of G. doubtful: bool [layers,
    n, batch], written: where G^(-1/2) e counts as 0.
    """
    zero, two = np.float32(0), np.float32(2)
    any_doubt = False
    for i in range(grams.shape[1]):
        for k in range(grams.shape[2]):
            for m in range(grams.shape[3]):
                a, b, c = grams[0, i, k, m], grams[1, i, k, m], grams[2, i, k, m]
                first, second = e[k, m, 0], e[k, m, 1]
                product, trace = a * b, a + b
                determinant = product - c * c
                margin = determinant - limit * product - square * trace
                sound = margin > zero
                doubtful[i, k, m] = not sound
                d = np.sqrt(determinant)
                scale = d * np.sqrt(trace + two * d)
                top = ((b + d) * first - c * second) / scale
                low = ((a + d) * second - c * first) / scale
                if not sound:
                    top = low = zero
                    any_doubt = True
                weights[i, k, m, 0] = first + s[k] * top
                weights[i, k, m, 1] = second + s[k] * low
    return any_doubt


@compiled
def adam(
    theta: Array,
    gradient: Array,
    mean: Array,
    square: Array,
    decay1: np.float32,
    rest1: np.float32,
    decay2: np.float32,
    rest2: np.float32,
    tiny: np.float32,
    eps: np.float32,
    rate: np.float32,
    finite: Array,
) -> None:
    """A step of `coop.learner.optimizers.Adam` for each run, arrays [n, P]; finite: bool [n], written: theta's."""
    for k in range(theta.shape[0]):
        t, g, m, v = theta[k], gradient[k], mean[k], square[k]
        for i in range(t.shape[0]):
            m[i] = m[i] * decay1 + g[i] * rest1
            v[i] = v[i] * decay2 + (g[i] * g[i]) * rest2
            t[i] -= (m[i] / (np.sqrt(v[i] + tiny) + eps)) * rate
        good = True
        for i in range(t.shape[0]):
            good &= np.abs(t[i]) <= LARGEST
        finite[k] = good
