"""Imports of users' own code, which settings name as "module:name" or as a module."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Collection
from functools import reduce
from types import ModuleType
from typing import Any

from common.errors import JoinError, UsageError
from common.places import working_directory


def import_module(module: str, field: str) -> ModuleType:
    """Import a module; the working directory is searched last.

    field: the setting that names it, for the error.

    Raises:
        UsageError: there is no such module, or its own code fails.
    """
    here = str(working_directory())
    if here not in sys.path:  # as `python -m` has it; a console script lacks it
        sys.path.append(here)
    try:
        return importlib.import_module(module)
    except (Exception, SystemExit) as error:  # a user's module may raise anything
        raise UsageError(f"{field}: cannot import {module!r}: {describe(error)}") from error


def import_object(path: str, field: str) -> Any:  # noqa: ANN401 (whatever the path names)
    """The object at `path`, "module:name".

    Raises:
        UsageError: the path has another form, or there is no such module or name in it.
    """
    module, colon, name = path.partition(":")
    if not (module and colon and name):
        raise UsageError(f"{field} = {path!r}: must be module:name")
    try:
        return reduce(getattr, name.split("."), import_module(module, field))
    except AttributeError as error:
        raise UsageError(f"{field} = {path!r}: module {module!r} has no {name!r}") from error


def check_allowed(path: str, allowed: Collection[str], field: str) -> None:
    """Raise JoinError unless the module of `path` ("module" or "module:name"), or a parent package, is in `allowed`.

    For processes whose settings come from elsewhere: only their own user permits code to run.
    """
    module = path.partition(":")[0]
    parts = module.split(".")
    if not any(".".join(parts[:count]) in allowed for count in range(1, len(parts) + 1)):
        raise JoinError(
            f"{field} = {path!r}: this process may not import {module!r}; start it with --allow-import {parts[0]}"
        )


def describe(error: BaseException) -> str:
    """An exception of a user's code in one line."""
    return " ".join(f"{type(error).__name__}: {error}".split())
