"""The step of `stack` as three Triton kernels: a program of the first plays and propagates for one whole run.

They do what `Stack.act`, `Stack.update` and `networks` do, for widths and batches that are powers of 2, on a GPU or in
Triton's interpreter; `dissect.agreement` compares both.
"""

# Triton's functions take pointers and constants in capitals, and have no types that mypy knows.
# mypy: ignore-errors
# ruff: noqa: ANN001, ANN202, N803, PLR0915

import torch
import triton
import triton.language as tl

from coop.studies.stacked.cartpole import (
    FORCE,
    GRAVITY,
    HALF_LENGTH,
    MAX_ANGLE,
    MAX_X,
    POLE_MASS,
    TAU,
    TOTAL_MASS,
    RandomNumbers,
)
from coop.studies.stacked.settings import StackSettings

CODES = {"none": 0, "transform": 1, "random": 2, "noise": 3, "matched": 4}
OPTIMIZERS = {"sgd": 0, "rmsprop": 1, "adam": 2}
LOSSES = {"squared": 0, "mse": 1, "huber": 2}
ROWS = 32  # outputs of a layer in one program of `_learn`


@triton.jit
def _relu(x):
    return tl.where(x <= 0, 0.0, x)  # nan stays nan


@triton.jit
def _first_layer(theta, x0, x1, x2, x3, W: tl.constexpr):
    unit = tl.arange(0, W)
    w = theta + unit * 4
    h = tl.load(theta + 4 * W + unit)[None, :] + x0[:, None] * tl.load(w)[None, :]
    h += x1[:, None] * tl.load(w + 1)[None, :]
    h += x2[:, None] * tl.load(w + 2)[None, :]
    h += x3[:, None] * tl.load(w + 3)[None, :]
    return _relu(h)


@triton.jit
def _next_layer(theta, h, layer, W: tl.constexpr, PRECISION: tl.constexpr):
    unit = tl.arange(0, W)
    at = theta + 5 * W + (layer - 1) * (W * W + W)
    weight = tl.load(at + unit[None, :] * W + unit[:, None])
    bias = tl.load(at + W * W + unit)
    return _relu(tl.dot(h, weight, input_precision=PRECISION) + bias[None, :])


@triton.jit
def _value(theta, h, hidden, action: tl.constexpr, W: tl.constexpr):
    at = theta + 5 * W + (hidden - 1) * (W * W + W)
    weight = tl.load(at + action * W + tl.arange(0, W))
    return tl.sum(h * weight[None, :], 1) + tl.load(at + 2 * W + action)


@triton.jit
def _greedy(theta, x0, x1, x2, x3, hidden, W: tl.constexpr):
    """Whether action 1 has the larger value at one observation."""
    unit = tl.arange(0, W)
    w = theta + unit * 4
    h = tl.load(theta + 4 * W + unit) + x0 * tl.load(w)
    h += x1 * tl.load(w + 1)
    h += x2 * tl.load(w + 2)
    h = _relu(h + x3 * tl.load(w + 3))
    for layer in range(1, hidden):
        at = theta + 5 * W + (layer - 1) * (W * W + W)
        weight = tl.load(at + unit[:, None] * W + unit[None, :])
        h = _relu(tl.sum(weight * h[None, :], 1) + tl.load(at + W * W + unit))
    at = theta + 5 * W + (hidden - 1) * (W * W + W)
    left = tl.sum(h * tl.load(at + unit), 0) + tl.load(at + 2 * W)
    right = tl.sum(h * tl.load(at + W + unit), 0) + tl.load(at + 2 * W + 1)
    return right > left


@triton.jit(do_not_specialize=["number", "runs", "limit", "hidden"])
def _play_and_propagate(
    theta_on, theta_to, state, length, table, ended,
    d_step, d_action, d_reset, d_row, d_batch, d_s, fixed, hs, sigmas, deltas, xs, es,
    number, runs, limit, bound, hidden, size,
    W: tl.constexpr, BATCH: tl.constexpr, FEEDBACK: tl.constexpr,
    LOSS: tl.constexpr, DOUBLE: tl.constexpr, GAMMA: tl.constexpr, LIMIT_TERMINAL: tl.constexpr,
    PRECISION: tl.constexpr, GRAVITY: tl.constexpr, POLE: tl.constexpr, TOTAL: tl.constexpr, HALF: tl.constexpr,
    FORCE: tl.constexpr, TAU: tl.constexpr, MAX_X: tl.constexpr, MAX_ANGLE: tl.constexpr,
):  # fmt: skip
    """One run's step up to the signals of its layers: sigmas, and es of the last one.

    hs, sigmas, deltas: [K, hidden, BATCH, W]. xs: [K, BATCH, 4]. es: [K, BATCH, 2]. bound: of values, inf for none.
    """
    run = tl.program_id(0).to(tl.int64)
    online, target = theta_on + run * size, theta_to + run * size
    at = number * runs + run

    # Act, by gymnasium's arithmetic.
    p = state + run * 4
    x, x_dot, angle, angle_dot = tl.load(p), tl.load(p + 1), tl.load(p + 2), tl.load(p + 3)
    o0, o1, o2, o3 = x.to(tl.float32), x_dot.to(tl.float32), angle.to(tl.float32), angle_dot.to(tl.float32)
    drawn = tl.load(d_action + at)
    action = tl.where(drawn < 0, _greedy(online, o0, o1, o2, o3, hidden, W).to(tl.int64), drawn)
    push = tl.where(action == 1, FORCE, -FORCE).to(tl.float64)
    cos, sin = tl.cos(angle), tl.sin(angle)
    temp = (push + POLE * HALF * (angle_dot * angle_dot) * sin) / TOTAL
    angle_acc = (GRAVITY * sin - cos * temp) / (HALF * (4.0 / 3.0 - POLE * (cos * cos) / TOTAL))
    x_acc = temp - POLE * HALF * angle_acc * cos / TOTAL
    x, x_dot = x + TAU * x_dot, x_dot + TAU * x_acc
    angle, angle_dot = angle + TAU * angle_dot, angle_dot + TAU * angle_acc
    fell = (tl.abs(x) > MAX_X) | (tl.abs(angle) > MAX_ANGLE)
    lived = tl.load(length + run).to(tl.int32) + 1
    over = fell | (lived >= limit)
    terminal = over if LIMIT_TERMINAL else fell

    # Store.
    row = table + tl.load(d_row + at) * 10
    tl.store(row, o0)
    tl.store(row + 1, o1)
    tl.store(row + 2, o2)
    tl.store(row + 3, o3)
    tl.store(row + 4, x.to(tl.float32))
    tl.store(row + 5, x_dot.to(tl.float32))
    tl.store(row + 6, angle.to(tl.float32))
    tl.store(row + 7, angle_dot.to(tl.float32))
    tl.store(row + 8, action.to(tl.float32))
    tl.store(row + 9, terminal.to(tl.float32))
    tl.store(ended + tl.load(d_step + number) * runs + run, tl.where(over, lived, 0).to(tl.int16))
    tl.store(length + run, tl.where(over, 0, lived).to(tl.int16))
    fresh = d_reset + at * 4
    tl.store(p, tl.where(over, tl.load(fresh), x))
    tl.store(p + 1, tl.where(over, tl.load(fresh + 1), x_dot))
    tl.store(p + 2, tl.where(over, tl.load(fresh + 2), angle))
    tl.store(p + 3, tl.where(over, tl.load(fresh + 3), angle_dot))
    tl.debug_barrier()

    # Sample, and the values of the batch.
    unit = tl.arange(0, W)
    one = tl.arange(0, BATCH)
    rows = table + tl.load(d_batch + at * BATCH + one) * 10
    n0, n1, n2, n3 = tl.load(rows + 4), tl.load(rows + 5), tl.load(rows + 6), tl.load(rows + 7)
    many: tl.constexpr = 2 * BATCH if DOUBLE else BATCH
    place = tl.arange(0, many)
    both = table + tl.load(d_batch + at * BATCH + place % BATCH) * 10 + (place // BATCH) * 4
    b0, b1, b2, b3 = tl.load(both), tl.load(both + 1), tl.load(both + 2), tl.load(both + 3)
    seen = place < BATCH
    put = xs + (run * BATCH + place) * 4
    tl.store(put, b0, mask=seen)
    tl.store(put + 1, b1, mask=seen)
    tl.store(put + 2, b2, mask=seen)
    tl.store(put + 3, b3, mask=seen)
    kept = hs + run * hidden * BATCH * W
    h = _first_layer(online, b0, b1, b2, b3, W)
    tl.store(kept + place[:, None] * W + unit[None, :], h, mask=seen[:, None])
    for layer in range(1, hidden):
        h = _next_layer(online, h, layer, W, PRECISION)
        tl.store(kept + (layer * BATCH + place[:, None]) * W + unit[None, :], h, mask=seen[:, None])
    left, right = _value(online, h, hidden, 0, W), _value(online, h, hidden, 1, W)
    g = _first_layer(target, n0, n1, n2, n3, W)
    for layer in range(1, hidden):
        g = _next_layer(target, g, layer, W, PRECISION)
    to_left, to_right = _value(target, g, hidden, 0, W), _value(target, g, hidden, 1, W)
    if DOUBLE:
        half = tl.arange(0, 2)[:, None]
        left2, right2 = tl.reshape(left, (2, BATCH)), tl.reshape(right, (2, BATCH))
        left, right = tl.sum(tl.where(half == 0, left2, 0.0), 0), tl.sum(tl.where(half == 0, right2, 0.0), 0)
        next_left, next_right = tl.sum(tl.where(half == 1, left2, 0.0), 0), tl.sum(tl.where(half == 1, right2, 0.0), 0)
        best = tl.where(next_right > next_left, to_right, to_left)
    else:
        best = tl.where(to_right > to_left, to_right, to_left)
    best = tl.where(best > bound, bound, tl.where(best < -bound, -bound, best))
    took, last = tl.load(rows + 8), tl.load(rows + 9)
    error = tl.where(took > 0, right, left) - (1.0 + GAMMA * (1.0 - last) * best)
    if LOSS == 1:
        error = 2.0 * error
    if LOSS == 2:
        error = tl.where(error > 1.0, 1.0, tl.where(error < -1.0, -1.0, error))
    error = error / BATCH
    e_left, e_right = tl.where(took > 0, 0.0, error), tl.where(took > 0, error, 0.0)
    tl.store(es + (run * BATCH + one) * 2, e_left)
    tl.store(es + (run * BATCH + one) * 2 + 1, e_right)
    tl.debug_barrier()

    # Propagate to every hidden layer, last first.
    tile = one[:, None] * W + unit[None, :]
    out = online + 5 * W + (hidden - 1) * (W * W + W)
    w_left, w_right = tl.load(out + unit), tl.load(out + W + unit)
    signals = sigmas + run * hidden * BATCH * W
    if FEEDBACK == 0:
        d = e_left[:, None] * w_left[None, :] + e_right[:, None] * w_right[None, :]
        for back in range(0, hidden - 1):
            layer = hidden - 1 - back
            d = tl.where(tl.load(kept + layer * BATCH * W + tile) > 0, d, 0.0)
            tl.store(signals + layer * BATCH * W + tile, d)
            weight = tl.load(online + 5 * W + (layer - 1) * (W * W + W) + unit[:, None] * W + unit[None, :])
            d = tl.dot(d, weight, input_precision=PRECISION)
        d = tl.where(tl.load(kept + tile) > 0, d, 0.0)
        tl.store(signals + tile, d)
    elif FEEDBACK == 2:
        for layer in range(0, hidden):
            b = fixed + (run * hidden + layer) * 2 * W + unit
            d = e_left[:, None] * tl.load(b)[None, :] + e_right[:, None] * tl.load(b + W)[None, :]
            tl.store(signals + layer * BATCH * W + tile, d)
    else:
        s = tl.load(d_s + at)
        e1, e2 = (e_left + e_right) * 0.7071067811865476, (e_left - e_right) * 0.7071067811865476
        plain = deltas + run * hidden * BATCH * W
        zero = tl.zeros((BATCH, W), tl.float32)
        t1 = zero + ((w_left + w_right) * 0.7071067811865476)[None, :]
        t2 = zero + ((w_left - w_right) * 0.7071067811865476)[None, :]
        for back in range(0, hidden - 1):
            layer = hidden - 1 - back
            at_layer = layer * BATCH * W + tile
            t1, t2 = _feed(t1, t2, e1, e2, s, kept + at_layer, signals + at_layer, plain + at_layer, W, FEEDBACK)
            weight = tl.load(online + 5 * W + (layer - 1) * (W * W + W) + unit[:, None] * W + unit[None, :])
            t1 = tl.dot(t1, weight, input_precision=PRECISION)
            t2 = tl.dot(t2, weight, input_precision=PRECISION)
        _feed(t1, t2, e1, e2, s, kept + tile, signals + tile, plain + tile, W, FEEDBACK)


@triton.jit
def _feed(t1, t2, e1, e2, s, h, signal, delta, W: tl.constexpr, FEEDBACK: tl.constexpr):
    """Store a layer's sigma, and delta for the controls; return T behind the layer's ReLU, whose output is at h."""
    active = tl.load(h) > 0
    t1, t2 = tl.where(active, t1, 0.0), tl.where(active, t2, 0.0)
    d = e1[:, None] * t1 + e2[:, None] * t2
    if FEEDBACK >= 3:
        tl.store(delta, d)
    tl.store(signal, d + s * _polar_part(t1, t2, e1, e2, W))
    return t1, t2


@triton.jit
def _polar_part(t1, t2, e1, e2, W: tl.constexpr):
    """(U V^T)^T e of one layer, [batch, W]: `networks.whiten` and what `polar_parts` makes of it."""
    unit = tl.arange(0, W)
    w1, w2 = t1.to(tl.float64), t2.to(tl.float64)
    a, b, c = tl.sum(w1 * w1, 1), tl.sum(w2 * w2, 1), tl.sum(w1 * w2, 1)
    f1, f2 = e1.to(tl.float64), e2.to(tl.float64)
    trace, det = a + b, a * b - c * c
    full = det > 1e-12 * a * b
    root_det = tl.sqrt(tl.where(full, det, 1.0))
    scale = root_det * tl.sqrt(trace + 2.0 * root_det)
    largest = (trace + tl.sqrt((a - b) * (a - b) + 4.0 * c * c)) * 0.5
    some = largest > 0
    u1, u2 = tl.where(a >= b, largest - b, c), tl.where(a >= b, c, largest - a)
    size = tl.where(some, tl.sqrt(u1 * u1 + u2 * u2), 1.0)
    u1, u2 = tl.where(some, u1 / size, 1.0), u2 / size
    root = tl.sqrt(tl.where(some, largest, 1.0))
    first1 = tl.sum(tl.where(unit[None, :] == 0, t1, 0.0), 1).to(tl.float64)
    first2 = tl.sum(tl.where(unit[None, :] == 0, t2, 0.0), 1).to(tl.float64)
    second1 = tl.sum(tl.where(unit[None, :] == 1, t1, 0.0), 1).to(tl.float64)
    second2 = tl.sum(tl.where(unit[None, :] == 1, t2, 0.0), 1).to(tl.float64)
    at1 = tl.where(some, (u1 * first1 + u2 * first2) / root, 1.0)
    at2 = (u1 * second1 + u2 * second2) / root
    first = tl.abs(at1) <= tl.abs(at2)
    part = tl.where(first, at1, at2)
    null = (u1 * f2 - u2 * f1) / tl.sqrt(1.0 - part * part)
    along = (u1 * f1 + u2 * f2 - null * part) / root
    q1 = tl.where(full, ((b + root_det) * f1 - c * f2) / scale, tl.where(some, along * u1, 0.0)).to(tl.float32)
    q2 = tl.where(full, ((a + root_det) * f2 - c * f1) / scale, tl.where(some, along * u2, 0.0)).to(tl.float32)
    z1 = tl.where(full, 0.0, tl.where(first, null, 0.0) + tl.where(some, 0.0, f1)).to(tl.float32)
    z2 = tl.where(full, 0.0, tl.where(first, 0.0, null)).to(tl.float32)
    part1 = tl.where(unit[None, :] == 0, z1[:, None], 0.0)
    return q1[:, None] * t1 + q2[:, None] * t2 + part1 + tl.where(unit[None, :] == 1, z2[:, None], 0.0)


@triton.jit
def _mixed(x):
    x = (x ^ (x >> 16)) * 0x7FEB352D
    x = (x ^ (x >> 15)) * 0x846CA68B
    return x ^ (x >> 16)


@triton.jit
def _gaussian(key, place):
    """`Chance.gaussian` of the parameters at `place`."""
    words = _mixed(place.to(tl.uint32) ^ key)
    radius = tl.sqrt(-2.0 * tl.log(((words >> 16).to(tl.float32) + 0.5) / 65536))
    return radius * tl.cos((words & 0xFFFF).to(tl.float32) * 9.587379924285257e-05)


@triton.jit
def _descend(
    theta, mean, square, place, g, rate, c1, c2,
    OPTIMIZER: tl.constexpr, ALPHA: tl.constexpr, BETA1: tl.constexpr, BETA2: tl.constexpr, EPS: tl.constexpr,
):  # fmt: skip
    """`networks.step_of`, and the step itself, for the parameters at `place`."""
    if OPTIMIZER == 0:
        step = g
    elif OPTIMIZER == 1:
        v = ALPHA * tl.load(square + place) + (1.0 - ALPHA) * g * g
        tl.store(square + place, v)
        step = g / (tl.sqrt(v + 1e-37) + EPS)
    else:
        m = tl.load(mean + place)
        m += (g - m) * (1.0 - BETA1)
        tl.store(mean + place, m)
        v = BETA2 * tl.load(square + place) + (1.0 - BETA2) * g * g
        tl.store(square + place, v)
        step = m * c1 / (tl.sqrt(v + 1e-37) + c2)
    tl.store(theta + place, tl.load(theta + place) - rate * step)


@triton.jit
def _block(signals, kept, run, hidden, layer, row, W: tl.constexpr, BATCH: tl.constexpr, PRECISION: tl.constexpr):
    """The gradient [rows, W] of some rows of a hidden layer's weight, and that of their biases."""
    one, unit = tl.arange(0, BATCH), tl.arange(0, W)
    d = tl.load(signals + ((run * hidden + layer) * BATCH + one[None, :]) * W + row[:, None])
    h = tl.load(kept + ((run * hidden + layer - 1) * BATCH + one[:, None]) * W + unit[None, :])
    return tl.dot(d, h, input_precision=PRECISION), tl.sum(d, 1)


@triton.jit
def _column(signals, xs, run, hidden, j, W: tl.constexpr, BATCH: tl.constexpr):
    """The gradient [W] of the first layer's weights of input j; of its biases for j = 4."""
    one, unit = tl.arange(0, BATCH), tl.arange(0, W)
    d = tl.load(signals + (run * hidden * BATCH + one[:, None]) * W + unit[None, :])
    x = tl.load(xs + (run * BATCH + one) * 4 + tl.minimum(j, 3))
    return tl.sum(d * tl.where(j < 4, x, 1.0)[:, None], 0)


@triton.jit
def _output_row(es, kept, run, hidden, action, W: tl.constexpr, BATCH: tl.constexpr):
    """The gradient [W] of one action's weights in the last layer, and that of its bias, for the plain error."""
    one, unit = tl.arange(0, BATCH), tl.arange(0, W)
    e = tl.load(es + (run * BATCH + one) * 2 + action)
    h = tl.load(kept + ((run * hidden + hidden - 1) * BATCH + one[:, None]) * W + unit[None, :])
    return tl.sum(e[:, None] * h, 0), tl.sum(e, 0)


@triton.jit(do_not_specialize=["number", "runs", "hidden"])
def _lengths(
    hs, sigmas, deltas, xs, es, d_s, sums, number, runs, hidden,
    W: tl.constexpr, BATCH: tl.constexpr, ROWS: tl.constexpr, PRECISION: tl.constexpr,
):  # fmt: skip
    """Squared lengths of transform's gradient, of the plain one and of their difference, to sums [K, layers, parts, 3].

    A hidden layer has a part for each block of ROWS rows, the first and the last layer have one.
    """
    run, block = tl.program_id(0).to(tl.int64), tl.program_id(1)
    parts: tl.constexpr = W // ROWS
    if block < (hidden - 1) * parts:
        layer = 1 + block // parts
        row = (block % parts) * ROWS + tl.arange(0, ROWS)
        driven, driven_bias = _block(sigmas, hs, run, hidden, layer, row, W, BATCH, PRECISION)
        plain, plain_bias = _block(deltas, hs, run, hidden, layer, row, W, BATCH, PRECISION)
        put = sums + ((run * (hidden + 1) + layer) * parts + block % parts) * 3
        tl.store(put, tl.sum(tl.sum(driven * driven, 1) + driven_bias * driven_bias, 0))
        tl.store(put + 1, tl.sum(tl.sum(plain * plain, 1) + plain_bias * plain_bias, 0))
        off, off_bias = driven - plain, driven_bias - plain_bias
        tl.store(put + 2, tl.sum(tl.sum(off * off, 1) + off_bias * off_bias, 0))
    else:
        of_driven, of_plain, of_both = 0.0, 0.0, 0.0
        for j in range(0, 5):
            driven = _column(sigmas, xs, run, hidden, j, W, BATCH)
            plain = _column(deltas, xs, run, hidden, j, W, BATCH)
            of_driven += tl.sum(driven * driven, 0)
            of_plain += tl.sum(plain * plain, 0)
            of_both += tl.sum((driven - plain) * (driven - plain), 0)
        put = sums + run * (hidden + 1) * parts * 3
        tl.store(put, of_driven)
        tl.store(put + 1, of_plain)
        tl.store(put + 2, of_both)
        square = 0.0
        for action in range(0, 2):
            plain, plain_bias = _output_row(es, hs, run, hidden, action, W, BATCH)
            square += tl.sum(plain * plain, 0) + plain_bias * plain_bias
        s = tl.load(d_s + number * runs + run)
        put = sums + (run * (hidden + 1) + hidden) * parts * 3
        tl.store(put, (1.0 + s) * (1.0 + s) * square)
        tl.store(put + 1, square)
        tl.store(put + 2, s * s * square)


@triton.jit
def _factor(sums, run, hidden, layer, count, FEEDBACK: tl.constexpr, PARTS: tl.constexpr):
    """Of a layer with `count` parameters: the deviation of "noise", the factor of the rate of "matched"."""
    part = tl.arange(0, PARTS)
    # The first and the last layer have one part; the others of theirs stay 0.
    at = sums + ((run * (hidden + 1) + layer) * PARTS + part) * 3
    if FEEDBACK == 3:
        return tl.sqrt(tl.sum(tl.load(at + 2), 0) / count)
    return tl.sqrt(tl.sum(tl.load(at), 0) / tl.maximum(tl.sum(tl.load(at + 1), 0), 1e-30))


@triton.jit(do_not_specialize=["number", "runs", "begin", "hidden"])
def _learn(
    theta, mean, square, hs, signals, xs, es, d_s, d_rate, d_corrections, d_update, keys, sums,
    number, runs, begin, hidden, size,
    W: tl.constexpr, BATCH: tl.constexpr, ROWS: tl.constexpr,
    FEEDBACK: tl.constexpr, OPTIMIZER: tl.constexpr, ALPHA: tl.constexpr, BETA1: tl.constexpr, BETA2: tl.constexpr,
    EPS: tl.constexpr, PRECISION: tl.constexpr,
):  # fmt: skip
    """The gradient and the step of a block of one run's parameters; `begin`: the first run of this optimizer."""
    run, block = (begin + tl.program_id(0)).to(tl.int64), tl.program_id(1)
    at = number * runs + run
    parts: tl.constexpr = W // ROWS
    unit = tl.arange(0, W)
    theta, mean, square = theta + run * size, mean + run * size, square + run * size
    rate = tl.load(d_rate + at)
    c1, c2 = tl.load(d_corrections + number * 2), tl.load(d_corrections + number * 2 + 1)
    update = tl.load(d_update + number)
    key = _mixed(_mixed((update ^ tl.load(keys + 2 * runs + run)).to(tl.uint32)) ^ tl.load(keys + run).to(tl.uint32))
    if block < (hidden - 1) * parts:
        layer = 1 + block // parts
        row = (block % parts) * ROWS + tl.arange(0, ROWS)
        start = 5 * W + (layer - 1) * (W * W + W)
        place, bias = start + row[:, None] * W + unit[None, :], start + W * W + row
        g, g_bias = _block(signals, hs, run, hidden, layer, row, W, BATCH, PRECISION)
        if FEEDBACK >= 3:
            factor = _factor(sums, run, hidden, layer, W * W + W, FEEDBACK, parts)
            if FEEDBACK == 3:
                g += factor * _gaussian(key, place)
                g_bias += factor * _gaussian(key, bias)
            else:
                rate *= factor
        _descend(theta, mean, square, place, g, rate, c1, c2, OPTIMIZER, ALPHA, BETA1, BETA2, EPS)
        _descend(theta, mean, square, bias, g_bias, rate, c1, c2, OPTIMIZER, ALPHA, BETA1, BETA2, EPS)
    else:
        first, last, last_rate = 0.0, 0.0, rate
        if FEEDBACK >= 3:
            first = _factor(sums, run, hidden, 0, 5 * W, FEEDBACK, parts)
            last = _factor(sums, run, hidden, hidden, 2 * W + 2, FEEDBACK, parts)
            if FEEDBACK == 4:
                last_rate = rate * last
                rate = rate * first
        for j in range(0, 5):
            place = tl.where(j < 4, unit * 4 + j, 4 * W + unit)
            g = _column(signals, xs, run, hidden, j, W, BATCH)
            if FEEDBACK == 3:
                g += first * _gaussian(key, place)
            _descend(theta, mean, square, place, g, rate, c1, c2, OPTIMIZER, ALPHA, BETA1, BETA2, EPS)
        start = 5 * W + (hidden - 1) * (W * W + W)
        grown = 1.0
        if FEEDBACK == 1:
            grown = 1.0 + tl.load(d_s + at)
        for action in range(0, 2):
            place, bias = start + action * W + unit, start + 2 * W + action + tl.arange(0, 1)
            g, g_bias = _output_row(es, hs, run, hidden, action, W, BATCH)
            g, g_bias = g * grown, g_bias * grown + tl.zeros((1,), tl.float32)
            if FEEDBACK == 3:
                g += last * _gaussian(key, place)
                g_bias += last * _gaussian(key, bias)
            _descend(theta, mean, square, place, g, last_rate, c1, c2, OPTIMIZER, ALPHA, BETA1, BETA2, EPS)
            _descend(theta, mean, square, bias, g_bias, last_rate, c1, c2, OPTIMIZER, ALPHA, BETA1, BETA2, EPS)


def why_not(settings: StackSettings) -> str | None:
    """Why the kernels can't run a stack of these settings; None if they can."""
    for name, value in (("width", settings.width), ("batch_size", settings.batch_size)):
        if value < 16 or value & (value - 1):
            return f"{name} = {value} is no power of 2 from 16 on"
    if settings.feedback not in CODES:
        return f"feedback {settings.feedback!r} has no kernel"
    return None


class Kernels:
    """The kernels of one stack, with the memory in which they pass on what they find.

    precision: "tf32x3" (about float32's), "ieee" or "tf32", of the products.
    """

    def __init__(self, stack, precision: str = "tf32x3") -> None:
        settings, runs = stack.settings, len(stack.runs.seeds)
        self._stack, self._precision, self._runs = stack, precision, runs

        def empty(*shape: int) -> torch.Tensor:
            return torch.zeros(runs, *shape, device=stack.device)

        signals = settings.hidden, settings.batch_size, settings.width
        controls = settings.feedback in ("noise", "matched")
        self._h, self._sigma = empty(*signals), empty(*signals)
        self._delta = empty(*signals) if controls else self._sigma
        self._x, self._e = empty(settings.batch_size, 4), empty(settings.batch_size, 2)
        self._rows = min(ROWS, settings.width)
        self._sums = empty(settings.hidden + 1, settings.width // self._rows, 3)
        self._fixed = stack.fixed if settings.feedback == "random" else self._x
        self._shape = {
            "W": settings.width, "BATCH": settings.batch_size, "PRECISION": precision,
        }  # fmt: skip
        self._world = {
            "GRAVITY": GRAVITY, "POLE": POLE_MASS, "TOTAL": TOTAL_MASS, "HALF": HALF_LENGTH, "FORCE": FORCE, "TAU": TAU,
            "MAX_X": MAX_X, "MAX_ANGLE": MAX_ANGLE,
        }  # fmt: skip

    def step(self, draws: RandomNumbers, number: int, role: int) -> None:
        """`Stack.act` and `Stack.update`."""
        stack, settings = self._stack, self._stack.settings
        code, size = CODES[settings.feedback], stack.shape.size
        bound = float("inf") if settings.value_bound is None else settings.value_bound
        _play_and_propagate[(self._runs,)](
            stack.theta[role], stack.theta[1 - role], stack.state, stack.length, stack.table, stack.ended,
            draws.step, draws.action, draws.reset, draws.row, draws.batch, draws.s, self._fixed,
            self._h, self._sigma, self._delta, self._x, self._e,
            number, self._runs, settings.time_limit, bound, settings.hidden, size,
            FEEDBACK=code, LOSS=LOSSES[settings.loss], DOUBLE=settings.double, GAMMA=settings.gamma,
            LIMIT_TERMINAL=settings.time_limit_terminal, num_warps=8, num_stages=1, **self._shape, **self._world,
        )  # fmt: skip
        blocks = (settings.hidden - 1) * (settings.width // self._rows) + 1
        if code >= 3:
            _lengths[(self._runs, blocks)](
                self._h, self._sigma, self._delta, self._x, self._e, draws.s, self._sums,
                number, self._runs, settings.hidden, ROWS=self._rows, num_warps=4, num_stages=1, **self._shape,
            )  # fmt: skip
        for optimizer, part in stack.segments:
            _learn[(part.stop - part.start, blocks)](
                stack.theta[role], stack.mean[role], stack.square[role],
                self._h, self._delta if code >= 3 else self._sigma, self._x, self._e,
                draws.s, draws.rate, draws.corrections, draws.update, stack.chance.keys, self._sums,
                number, self._runs, part.start, settings.hidden, size,
                ROWS=self._rows, FEEDBACK=code, OPTIMIZER=OPTIMIZERS[optimizer], ALPHA=settings.alpha,
                BETA1=settings.beta1, BETA2=settings.beta2, EPS=settings.eps, num_warps=4, num_stages=1, **self._shape,
            )  # fmt: skip
