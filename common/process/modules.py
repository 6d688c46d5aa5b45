"""Imports a module that a setting names."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path
from types import ModuleType

from common.errors import UsageError


def import_named(setting: str, module: str) -> ModuleType:
    """Import `module`, an installed one or one in the current folder; `setting` names it in errors.

    Raises:
        UsageError: there is no such module, or its import fails.
    """
    folder = str(Path.cwd())
    if folder not in sys.path:
        sys.path.append(folder)
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        if error.name is not None and f"{module}.".startswith(f"{error.name}."):
            text = f"{setting}: no module {error.name!r}; it must be installed, or on PYTHONPATH or in this folder"
            raise UsageError(text) from None
        raise UsageError(f"{setting}: module {module!r} needs {error.name!r}, which is not installed") from error
    except Exception as error:
        text = str(error).partition("\n")[0]
        raise UsageError(f"{setting}: module {module!r} fails: {type(error).__name__}: {text}") from error
