"""Figures of the parts of `gpu.py`: lines of JSON, and how often something is done in a second."""

from __future__ import annotations

import json
import time
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any


def figure(**row: Any) -> None:
    """A figure of a part."""
    print(json.dumps(row), flush=True)


def per_second(update: Callable[[], object], seconds: float, device: str, each: int = 1) -> float:
    import torch

    def wait() -> None:
        if device != "cpu":
            torch.cuda.synchronize()

    for _ in range(3):
        update()
    wait()
    count, began = 0, time.perf_counter()
    while time.perf_counter() - began < seconds or not count:
        for _ in range(20 if device != "cpu" else 1):
            update()
            count += each
        wait()
    return round(count / (time.perf_counter() - began), 1)


@contextmanager
def kept(row: dict[str, Any]) -> Iterator[None]:
    """Let what fails cost no more than itself."""
    try:
        yield
    except Exception as error:
        figure(**row, failed=f"{type(error).__name__}: {error}"[:300])
        traceback.print_exc()
