"""The processor of this machine, as Linux describes it."""

from __future__ import annotations

from pathlib import Path

# What speeds up products, best first. PyTorch's products of bfloat16 need AVX-512: without it they take 20 to 50 times
# as long as float32's.
AVX512 = ("amx_bf16", "avx512_bf16", "avx512f")
INSTRUCTIONS = (*AVX512, "avx2")


def model() -> str:
    """Its name."""
    return _field("model name") or "unknown"


def instructions() -> str:
    """The best of `INSTRUCTIONS` that it has: processors of one name differ in them."""
    flags = _field("flags").split()
    return next((name for name in INSTRUCTIONS if name in flags), "others")


def fast_bfloat16() -> bool:
    """Whether products of bfloat16 are not many times slower than float32's."""
    return instructions() in AVX512


def _field(name: str) -> str:
    lines = Path("/proc/cpuinfo").read_text().splitlines()
    return next((line.partition(":")[2].strip() for line in lines if line.startswith(name)), "")
