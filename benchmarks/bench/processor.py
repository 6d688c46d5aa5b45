"""The processor of this machine, as Linux describes it."""

from __future__ import annotations

import subprocess
from contextlib import suppress
from pathlib import Path

# What speeds up products, best first. PyTorch's products of bfloat16 need AVX-512: without it they take 20 to 50 times
# as long as float32's.
AVX512 = ("amx_bf16", "avx512_bf16", "avx512f")
INSTRUCTIONS = (*AVX512, "avx2")


def model() -> str:
    """Its name, with the numbers that tell the generations of one name apart."""
    numbers = [f"{name} {number}" for name in ("cpu family", "model") if (number := _field(name))]
    return ", ".join([_field("model name") or "unknown", *numbers])


def instructions() -> str:
    """The best of `INSTRUCTIONS` that it has: processors of one name differ in them."""
    flags = _field("flags").split()
    return next((name for name in INSTRUCTIONS if name in flags), "others")


def gpu() -> dict[str, str]:
    """{"gpu": its name and its driver}; nothing where there is none."""
    query = ["nvidia-smi", "--query-gpu=name,driver_version", "--format=csv,noheader"]
    with suppress(OSError, subprocess.CalledProcessError):
        return {"gpu": subprocess.run(query, capture_output=True, text=True, check=True).stdout.strip()}
    return {}


def fast_bfloat16() -> bool:
    """Whether products of bfloat16 are not many times slower than float32's."""
    return instructions() in AVX512


def _field(name: str) -> str:
    lines = Path("/proc/cpuinfo").read_text().splitlines()
    fields = (line.partition(":")[::2] for line in lines)
    return next((value.strip() for field, value in fields if field.strip() == name), "")
