"""Imports: of users' own code, which settings name as "module:name" or as a module; of extras; of large libraries.

The settings of a run may be somebody else's. Then its code must not be: a module that lies in the run's folder or
beside it is not imported, unless this process's user has named it, or has trained this very run with this very file.
"""

from __future__ import annotations

import contextlib
import gc
import importlib
import importlib.util
import os
import sys
from collections.abc import Collection, Iterable, Iterator
from contextlib import contextmanager
from functools import partial, reduce
from importlib.util import find_spec
from pathlib import Path
from secrets import token_hex
from types import ModuleType
from typing import Any

from coop.common.errors import JoinError, UsageError, text_of
from coop.common.places import working_directory

_handed_over: list[Path] = []  # folders of runs whose settings this process reads
_named: set[str] = set()  # modules that this process's user permits
_files: dict[str, Path] = {}  # from which users' modules were imported


def hand_over(folder: Path) -> None:
    """Note that settings come from the run in `folder`: what lies in it or beside it is not imported."""
    if folder.absolute() not in _handed_over:
        _handed_over.append(folder.absolute())


def permit(modules: Iterable[str]) -> None:
    """Permit modules ("module" or "module:name") that this process's user has named, wherever they lie."""
    _named.update(module.partition(":")[0] for module in modules)


def remember(run_dir: Path) -> None:
    """Note for later that this user's run in `run_dir` was trained with the modules that this process has imported."""
    with contextlib.suppress(OSError, RuntimeError):  # then the user is only asked again
        known, path = _known(), _memory()
        if lines := [line for line in map(partial(_line, _run_id(run_dir)), _files.values()) if line not in known]:
            path.parent.mkdir(parents=True, exist_ok=True)
            with path.open("a", encoding="utf-8") as file:
                file.writelines(lines)


def import_module(module: str, field: str, *, installed: bool = False) -> ModuleType:
    """Import a module; the working directory is searched last.

    field: the setting that names it, for the error. installed: the program or an installed package names it.

    Raises:
        UsageError: there is no such module, or its own code fails, or it came with a run (see above).
    """
    if module in sys.modules:
        return sys.modules[module]
    here = ""
    with contextlib.suppress(UsageError):  # one that has been deleted has no modules
        here = str(working_directory())
    # `python -m` has it; a console script lacks it.
    added = here not in ("", *sys.path) and not (installed and _handed_over)
    if added:
        sys.path.append(here)
    try:
        file = None if installed else _find(module)
        if file is not None:
            try:
                _check(module, file, field)
            except UsageError:
                if added:
                    sys.path.remove(here)  # other modules must not be found there either
                raise
        imported = importlib.import_module(module)
    except UsageError:
        raise
    except (Exception, SystemExit) as error:  # a user's module may raise anything
        raise UsageError(f"{field}: cannot import {module!r}: {describe(error)}") from error
    if file is not None:
        _files[module] = file
    return imported


def _find(module: str) -> Path | None:
    """The file of a module's top-level package, found without running it; None if there is no such file."""
    found = importlib.util.find_spec(module.partition(".")[0])
    if found is None:
        return None
    if found.origin and found.has_location:
        return Path(found.origin)
    return next(map(Path, found.submodule_search_locations or ()), None)  # a package without a file


def _check(module: str, file: Path, field: str) -> None:
    """Say which file is imported for a run that was handed over; raise UsageError for one that came with it."""
    if not _handed_over:
        return
    package = file.name == "__init__.py" or file.is_dir()
    places = {each.parent.parent if package and not each.is_dir() else each.parent for each in (file, file.resolve())}
    permitted = bool(_prefixes(module) & _named)
    for run in () if permitted else _handed_over:
        folders = {run, run.resolve()}
        with_it = any(place.is_relative_to(each) or place == each.parent for place in places for each in folders)
        if with_it and _line(_run_id(run), file) not in _known():
            name = module.partition(".")[0]
            raise UsageError(
                f"{field} names the module {module!r}, and {file} came with the run in {run}: not imported; "
                f"--allow-import {name} (allow_import in Python) if it is yours"
            )
    print(f"{field}: imports {module} from {file}", file=sys.stderr, flush=True)


def _prefixes(module: str) -> set[str]:
    """A module and its parent packages."""
    parts = module.split(".")
    return {".".join(parts[:count]) for count in range(1, len(parts) + 1)}


def _memory() -> Path:
    """A file of this user's with a line for each run and module's file; read by `_known`."""
    return Path(os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state") / "coop" / "modules"


def _known() -> set[str]:
    try:
        return set(_memory().read_text(encoding="utf-8").splitlines(keepends=True))
    except (OSError, ValueError, RuntimeError):  # the last where there is no home
        return set()


def _line(run_id: str, file: Path) -> str:
    return f"{run_id} {str(file.resolve())!r}\n"


def _run_id(run_dir: Path) -> str:
    """The random id of the run in a folder; a new one where there is none, which nothing equals."""
    try:
        return (run_dir / "run-id").read_text(encoding="utf-8").strip() or token_hex(16)
    except (OSError, ValueError):
        return token_hex(16)


def import_object(path: str, field: str, *, installed: bool = False) -> Any:  # noqa: ANN401 (whatever the path names)
    """The object at `path`, "module:name"; the rest as `import_module`.

    Raises:
        UsageError: the path has another form, or there is no such module or name in it.
    """
    module, colon, name = path.partition(":")
    if not (module and colon and name):
        raise UsageError(f"{field} = {path!r}: must be module:name")
    try:
        return reduce(getattr, name.split("."), import_module(module, field, installed=installed))
    except AttributeError as error:
        raise UsageError(f"{field} = {path!r}: module {module!r} has no {name!r}") from error


def check_allowed(path: str, allowed: Collection[str], field: str) -> None:
    """Raise JoinError unless the module of `path` ("module" or "module:name"), or a parent package, is in `allowed`.

    For processes whose settings come from elsewhere: only their own user permits code to run.
    """
    module = path.partition(":")[0]
    if not _prefixes(module) & {*allowed}:
        name = module.partition(".")[0]
        raise JoinError(
            f"{field} = {path!r}: this process may not import {module!r}; start it with --allow-import {name}"
        )


def check_permitted(path: str, field: str) -> None:
    """As `check_allowed`, of the modules that this process's user has permitted so far."""
    check_allowed(path, _named, field)


def describe(error: BaseException) -> str:
    """An exception of a user's code in one line."""
    return " ".join(f"{type(error).__name__}: {text_of(error)}".split()).removesuffix(":")


def check_extra(flag: str, extra: str, module: str) -> None:
    """Raise UsageError if the library that a flag needs is not installed."""
    if find_spec(module) is None:
        raise UsageError(f"{flag}: needs the extra {extra!r}: pip install 'coop-rl[{extra}]'")


@contextmanager
def importing() -> Iterator[None]:
    """Import modules within it: they leave no garbage, and looking for it takes a tenth of their time."""
    gc.disable()
    try:
        yield
    finally:
        gc.freeze()
        gc.enable()
