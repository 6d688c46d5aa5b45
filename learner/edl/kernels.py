"""Kernels of CUDA for what an update would otherwise do in dozens of small steps; elsewhere none is usable.

They are compiled by NVRTC, which PyTorch brings along, when they are first wanted. Whoever uses one has a plain way
too: if the compiler is missing or refuses, one line says so, and that way is taken.
"""

from __future__ import annotations

import ctypes
import math
from collections.abc import Sequence
from functools import cache
from typing import Any

import torch
from torch import Tensor

from coop.common.errors import first_line
from coop.common.process.output import warn
from coop.learner.edl.nvrtc import compiled
from coop.learner.edl.polar import SCALES

LAYERS = 8  # that one call of `feedback` takes
MOST_ACTIONS = 18
_THREADS = 256

_SOURCE = """
typedef unsigned char u8;
struct Layers { const float* t[LAYERS]; float* out[LAYERS]; int n[LAYERS]; };

// The rows of T [A, n] and the error e [A] of one sample and layer -> weights w and rest r [A] with
// (T + s P)^T e = T^T w + (r, 0, ...). See learner/edl/completed.py; the Gram matrix is summed in float64.
extern "C" __global__ void __launch_bounds__(THREADS)
weigh(Layers layers, const float* errors, const float* rate, int batch, float* weights, float* rests)
{
    __shared__ double g[A][A], x[A][A], y[A][A], z[A][A], u[A][A], v[A][A], lengths[A];
    __shared__ double partial[THREADS / 32][BLOCK * BLOCK];
    __shared__ int sound;
    const int sample = blockIdx.x, layer = blockIdx.y, tid = threadIdx.x;
    const int n = layers.n[layer];
    const float* t = layers.t[layer] + (long long)sample * A * n;
    for (int p = 0; p < A; p += BLOCK)
        for (int q = p; q < A; q += BLOCK) {
            double sums[BLOCK][BLOCK];
            for (int i = 0; i < BLOCK; i++)
                for (int j = 0; j < BLOCK; j++) sums[i][j] = 0;
            for (int k = tid; k < n; k += THREADS) {
                double a[BLOCK], b[BLOCK];
#pragma unroll
                for (int i = 0; i < BLOCK; i++) a[i] = p + i < A ? (double)t[(long long)(p + i) * n + k] : 0;
#pragma unroll
                for (int j = 0; j < BLOCK; j++) b[j] = q + j < A ? (double)t[(long long)(q + j) * n + k] : 0;
#pragma unroll
                for (int i = 0; i < BLOCK; i++)
#pragma unroll
                    for (int j = 0; j < BLOCK; j++) sums[i][j] += a[i] * b[j];
            }
#pragma unroll
            for (int i = 0; i < BLOCK; i++)
#pragma unroll
                for (int j = 0; j < BLOCK; j++) {
                    double sum = sums[i][j];
                    for (int d = 16; d; d >>= 1) sum += __shfl_down_sync(0xffffffffu, sum, d);
                    if (tid % 32 == 0) partial[tid / 32][i * BLOCK + j] = sum;
                }
            __syncthreads();
            for (int m = tid; m < BLOCK * BLOCK; m += THREADS) {
                double sum = 0;
                for (int w = 0; w < THREADS / 32; w++) sum += partial[w][m];
                const int i = p + m / BLOCK, j = q + m % BLOCK;
                if (i < A && j < A) g[i][j] = g[j][i] = sum;
            }
            __syncthreads();
        }
    // Whether the rows are independent: the pivots of elimination.
    for (int m = tid; m < A * A; m += THREADS) x[m / A][m % A] = g[m / A][m % A];
    if (tid == 0) sound = g[0][0] > 0;
    __syncthreads();
    for (int k = 0; k + 1 < A; k++) {
        for (int m = tid; m < A * A; m += THREADS) {
            const int i = m / A, j = m % A;
            if (i > k && j > k) x[i][j] -= x[i][k] * (x[k][j] / x[k][k]);
        }
        __syncthreads();
        if (tid == 0 && !(x[k + 1][k + 1] > LIMIT * g[k + 1][k + 1])) sound = 0;
        __syncthreads();
    }
    if (tid < A) {
        double longest = 0;
        for (int i = 0; i < A; i++) longest = fmax(longest, sqrt(fmax(g[i][i], 0.0)));
        if (longest == 0) longest = 1;
        lengths[tid] = sound ? 0 : DELTA * (sqrt(fmax(g[tid][tid], 0.0)) + SHORT * longest);
    }
    __syncthreads();
    for (int m = tid; m < A * A; m += THREADS) {
        const int i = m / A, j = m % A;
        double sum = g[i][j];
        if (!sound) sum += t[(long long)i * n + j] * lengths[j] + t[(long long)j * n + i] * lengths[i];
        if (i == j) sum += lengths[i] * lengths[i];
        x[i][j] = sum;
    }
    __syncthreads();
    // G^(-1/2) by the scaled Newton-Schulz iteration of learner/edl/polar.py.
    double trace = 0;
    for (int i = 0; i < A; i++) trace += x[i][i];
    for (int m = tid; m < A * A; m += THREADS) {
        y[m / A][m % A] = x[m / A][m % A] / trace;
        z[m / A][m % A] = m / A == m % A;
    }
    __syncthreads();
    const double scales[] = {SCALES};
    for (int step = 0; step < (int)(sizeof(scales) / sizeof(double)); step++) {
        const double rho = scales[step];
        for (int m = tid; m < A * A; m += THREADS) {
            const int i = m / A, j = m % A;
            double sum = 0;
            for (int k = 0; k < A; k++) sum += z[i][k] * y[k][j];
            x[i][j] = (i == j ? 1.5 * rho : 0) - 0.5 * rho * rho * rho * sum;
        }
        __syncthreads();
        for (int m = tid; m < A * A; m += THREADS) {
            const int i = m / A, j = m % A;
            double left = 0, right = 0;
            for (int k = 0; k < A; k++) { left += y[i][k] * x[k][j]; right += x[i][k] * z[k][j]; }
            u[i][j] = left;
            v[i][j] = right;
        }
        __syncthreads();
        for (int m = tid; m < A * A; m += THREADS) {
            y[m / A][m % A] = u[m / A][m % A];
            z[m / A][m % A] = v[m / A][m % A];
        }
        __syncthreads();
    }
    if (tid < A) {
        const float* e = errors + (long long)sample * A;
        const double s = *rate;
        double white = 0;
        for (int k = 0; k < A; k++) white += z[tid][k] * e[k];
        white *= s / sqrt(trace);
        const long long at = ((long long)layer * batch + sample) * A + tid;
        weights[at] = (float)(e[tid] + white);
        rests[at] = (float)(lengths[tid] * white);
    }
}

// out [batch, n] = T^T w + (r, 0, ...) of each sample and layer.
extern "C" __global__ void __launch_bounds__(THREADS)
combine(Layers layers, const float* weights, const float* rests, int batch)
{
    __shared__ float w[A], r[A];
    const int sample = blockIdx.y, layer = blockIdx.z, n = layers.n[layer];
    const long long at = ((long long)layer * batch + sample) * A;
    if (threadIdx.x < A) { w[threadIdx.x] = weights[at + threadIdx.x]; r[threadIdx.x] = rests[at + threadIdx.x]; }
    __syncthreads();
    const int j = blockIdx.x * THREADS + threadIdx.x;
    if (j >= n) return;
    const float* t = layers.t[layer] + (long long)sample * A * n + j;
    float sum = j < A ? r[j] : 0;
#pragma unroll
    for (int a = 0; a < A; a++) sum += w[a] * t[(long long)a * n];
    layers.out[layer][(long long)sample * n + j] = sum;
}

// Adam's step, whose number is in `count`.
extern "C" __global__ void __launch_bounds__(THREADS)
adam(float* theta, const float* gradient, float* mean, float* square, const float* count, const float* rate,
     double log1, double log2, float beta1, float beta2, float eps, int size)
{
    __shared__ float step, root;
    if (threadIdx.x == 0) {
        step = (float)(*rate / -expm1(*count * log1));
        root = (float)(1 / sqrt(-expm1(*count * log2)));
    }
    __syncthreads();
    const int first = blockIdx.x * THREADS * EACH + threadIdx.x;
#pragma unroll
    for (int k = 0; k < EACH; k++) {
        const int i = first + k * THREADS;
        if (i >= size) break;
        const float g = gradient[i];
        const float m = mean[i] + (1 - beta1) * (g - mean[i]);
        const float v = beta2 * square[i] + (1 - beta2) * g * g;
        mean[i] = m;
        square[i] = v;
        theta[i] -= step * m / (sqrtf(v) * root + eps);
    }
}

// A transition for each thread, as learner/device_table.py draws them in PyTorch: chance [2, size], uniform.
extern "C" __global__ void __launch_bounds__(THREADS)
draw(const float* chance, const long long* steps, const float* ended, const float* terminated, const float* rewards,
     const long long* chosen, const float* powers, long long* actions, float* sums, float* discounts, float* valid,
     int* index, int rows, int streams, int n, int stack, int size)
{
    const int i = blockIdx.x * THREADS + threadIdx.x;
    if (i >= size) return;
    const long long now = *steps, held = (now < rows ? now : rows) - n;
    const long long first = now - n - 1 - (long long)(chance[i] * (float)held);
    const long long stream = (long long)(chance[size + i] * (float)streams);
    const long long place = first % rows * streams + stream;
    long long last = place;
    float sum = 0;
    int span = 0;
    for (bool alive = true; alive && span < n; alive = ended[last] == 0) {
        last = (first + span + 1) % rows * streams + stream;
        sum += powers[span++] * rewards[last];
    }
    actions[i] = chosen[place];
    sums[i] = sum;
    discounts[i] = powers[span] * (1 - terminated[last]);
    valid[i] = 1 - ended[place];
    for (int f = 0; f < stack; f++) {
        index[(long long)i * stack + f] = (int)(place * stack + f);
        index[((long long)size + i) * stack + f] = (int)(last * stack + f);
    }
}

// Four uint8 frames of each observation -> pixels in [0, 1], the four of a place side by side: float [n, pixels, 4].
extern "C" __global__ void __launch_bounds__(THREADS)
stack(const u8* frames, const int* index, float* out, int pixels)
{
    const int four = blockIdx.x * THREADS + threadIdx.x, obs = blockIdx.y;
    if (4 * four >= pixels) return;
    uchar4 seen[4];
#pragma unroll
    for (int f = 0; f < 4; f++) seen[f] = *(const uchar4*)(frames + (long long)index[4 * obs + f] * pixels + 4 * four);
    float4* place = (float4*)(out + ((long long)obs * pixels + 4 * four) * 4);
#pragma unroll
    for (int k = 0; k < 4; k++) {
        const float scale = (float)(1.0 / 255);
        float pixel[4];
#pragma unroll
        for (int f = 0; f < 4; f++) pixel[f] = ((const u8*)&seen[f])[k] * scale;
        place[k] = make_float4(pixel[0], pixel[1], pixel[2], pixel[3]);
    }
}
"""


class _Layers(ctypes.Structure):
    _fields_ = (("t", ctypes.c_void_p * LAYERS), ("out", ctypes.c_void_p * LAYERS), ("n", ctypes.c_int * LAYERS))


def usable(array: Tensor) -> bool:
    """Whether the kernels can work on a tensor: float32 on a GPU whose compiler works."""
    return array.is_cuda and array.dtype == torch.float32 and _module(2, array.device.index or 0) is not None


def fits(ts: Sequence[Tensor], batch: int) -> bool:
    """Whether `feedback` can take these T: [batch, A, n] each."""
    return (
        0 < len(ts) <= LAYERS
        and all(len(t) == batch and t.is_contiguous() and t.shape[1] <= t.shape[2] for t in ts)
        and 2 <= ts[0].shape[1] <= MOST_ACTIONS
        and usable(ts[0])
    )


def feedback(ts: Sequence[Tensor], e: Tensor, s: Tensor | float) -> list[Tensor]:
    """(T + s P)^T e of each T float32 [batch, A, n], P its completed polar factor: e [batch, A] -> [batch, n]."""
    batch, actions = e.shape
    device = e.device
    module = _module(actions, device.index or 0)
    assert module is not None
    rate = s if isinstance(s, Tensor) else torch.full((), s, device=device)
    e = e.contiguous()
    weights, rests = (torch.empty(len(ts), batch, actions, device=device) for _ in range(2))
    outs = [torch.empty(batch, t.shape[2], device=device) for t in ts]
    layers = _Layers()
    for i, (t, out) in enumerate(zip(ts, outs, strict=True)):
        layers.t[i], layers.out[i], layers.n[i] = t.data_ptr(), out.data_ptr(), t.shape[2]
    size = ctypes.c_int(batch)
    _launch(module["weigh"], (batch, len(ts), 1), layers, e, rate, size, weights, rests)
    widest = max(t.shape[2] for t in ts)
    _launch(module["combine"], (-(-widest // _THREADS), batch, len(ts)), layers, weights, rests, size)
    return outs


_EACH = 8


def adam(
    theta: Tensor,
    gradient: Tensor,
    mean: Tensor,
    square: Tensor,
    count: Tensor | None,
    rate: Tensor | float,
    betas: tuple[float, float],
    eps: float,
) -> None:
    """Adam's step number `count` in place; all arrays float32 [P], count and rate of one number on their device."""
    assert count is not None
    module = _module(2, theta.device.index or 0)
    assert module is not None
    rate = rate if isinstance(rate, Tensor) else torch.full((), rate, device=theta.device)
    beta1, beta2 = betas
    size = theta.numel()
    _launch(
        module["adam"], (-(-size // (_THREADS * _EACH)), 1, 1), theta, gradient, mean, square, count, rate,
        ctypes.c_double(_log(beta1)), ctypes.c_double(_log(beta2)),
        ctypes.c_float(beta1), ctypes.c_float(beta2), ctypes.c_float(eps), ctypes.c_int(size),
    )  # fmt: skip


def draws(
    chance: Tensor, steps: Tensor, columns: Sequence[Tensor], powers: Tensor, stack: int
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor] | None:
    """Transitions of a `DeviceTable`; None if the kernels can't work there.

    chance: float32 [2, size], uniform in [0, 1). steps: int64 [], rows so far. columns: ended, terminated and rewards,
    float32 [rows, streams] each, and actions, int64 [rows, streams]. powers: float32 [n + 1], of gamma. Returns
    actions, rewards, discounts, weights [size] each, and the rows of the frames, int32 [2 size stack].
    """
    if not usable(chance):
        return None
    module = _module(2, chance.device.index or 0)
    assert module is not None
    size, (rows, streams) = chance.shape[1], columns[0].shape
    actions = torch.empty(size, dtype=torch.int64, device=chance.device)
    rewards, discounts, weights = torch.empty(3, size, device=chance.device)
    index = torch.empty(2 * size * stack, dtype=torch.int32, device=chance.device)
    _launch(
        module["draw"], (-(-size // _THREADS), 1, 1), chance, steps, *columns, powers,
        actions, rewards, discounts, weights, index,
        *map(ctypes.c_int, (rows, streams, len(powers) - 1, stack, size)),
    )  # fmt: skip
    return actions, rewards, discounts, weights, index


def stacks(frames: Tensor, index: Tensor, count: int) -> Tensor | None:
    """Observations of four frames, as networks take them; None if these are not such frames on a GPU.

    frames: uint8 [unique, height, width]. index: int32 [4 count] -> float32 [count, 4, height, width], channels last.
    """
    pixels = frames[0].numel()
    fitting = frames.is_cuda and frames.dtype == torch.uint8 and frames.dim() == 3 and index.numel() == 4 * count
    if not fitting or pixels % 4 or index.dtype != torch.int32 or not index.is_cuda or not frames.is_contiguous():
        return None
    module = _module(2, frames.device.index or 0)
    if module is None:
        return None
    height, width = frames.shape[1:]
    out = torch.empty(count, height, width, 4, device=frames.device)
    grid = (-(-pixels // (4 * _THREADS)), count, 1)
    _launch(module["stack"], grid, frames, index, out, ctypes.c_int(pixels))
    return out.permute(0, 3, 1, 2)


def _log(beta: float) -> float:
    return math.log(beta) if beta > 0 else -1e300


def source(actions: int) -> str:
    """The kernels' source in C++ for CUDA, for a number of actions."""
    values: dict[str, Any] = {
        "A": actions,
        "BLOCK": min(actions, 6),
        "THREADS": _THREADS,
        "LAYERS": LAYERS,
        "EACH": _EACH,
        "LIMIT": 1e-8,
        "DELTA": 1e-5,
        "SHORT": 1e-3,
        "SCALES": ", ".join(map(repr, SCALES)),
    }
    return "".join(f"#define {name} {value}\n" for name, value in values.items()) + _SOURCE


@cache
def _module(actions: int, device: int) -> dict[str, ctypes.c_void_p] | None:
    """The kernels for a number of actions on a GPU; None, after a line that says why, if there are none."""
    try:
        with torch.cuda.device(device):
            major, minor = torch.cuda.get_device_capability()
            torch.cuda.current_stream().synchronize()  # makes the context
            code = compiled(source(actions), f"sm_{major}{minor}")
            driver = _driver()
            module = ctypes.c_void_p()
            _check(driver.cuModuleLoadData(ctypes.byref(module), code))
            found = {}
            for name in ("weigh", "combine", "adam", "draw", "stack"):
                found[name] = ctypes.c_void_p()
                _check(driver.cuModuleGetFunction(ctypes.byref(found[name]), module, name.encode()))
            return found
    except (OSError, RuntimeError, AttributeError) as error:
        warn(f"no kernels are compiled for the GPU, updates take longer: {first_line(error)}")
        return None


def _launch(function: ctypes.c_void_p, grid: tuple[int, int, int], *arguments: Any) -> None:  # noqa: ANN401
    """Start a kernel on the current stream; tensors are passed by their address."""
    held = [ctypes.c_void_p(one.data_ptr()) if isinstance(one, Tensor) else one for one in arguments]
    pointers = (ctypes.c_void_p * len(held))(*(ctypes.cast(ctypes.pointer(one), ctypes.c_void_p) for one in held))
    stream = ctypes.c_void_p(torch.cuda.current_stream().cuda_stream)
    _check(_driver().cuLaunchKernel(function, *grid, _THREADS, 1, 1, 0, stream, pointers, None))


def _check(status: int) -> None:
    if status:
        raise RuntimeError(f"CUDA driver: error {status}")


@cache
def _driver() -> ctypes.CDLL:
    return ctypes.CDLL("libcuda.so.1")
