"""The device that a flag or setting names."""

from __future__ import annotations

import torch

from coop.common.errors import UsageError


def usable_device(name: str, field: str) -> torch.device:
    """The device of this name; raises UsageError, which names the field, if PyTorch can't use it here."""
    try:
        device = torch.device(name)
        torch.empty(0, device=device)
    except (RuntimeError, AssertionError) as error:
        raise UsageError(f"{field}: {str(error).splitlines()[0]}") from error
    return device
