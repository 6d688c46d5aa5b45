"""The working directory that a command was started in, which users' code may leave or somebody delete."""

from __future__ import annotations

import errno
import os
from pathlib import Path

from coop.common.errors import UsageError

_started_in: Path | None = None
_deleted: OSError | None = None


def remember_working_directory() -> None:
    """Make this process's working directory the one that `working_directory` tells from now on.

    One that has been deleted is left, because some libraries (MKL) end a process there.
    """
    global _started_in, _deleted  # noqa: PLW0603 (of the process)
    try:
        _started_in = Path.cwd()
    except OSError as error:
        _deleted = error
        os.chdir("/")


def working_directory() -> Path:
    """The directory in which this command was started; the present one in a process that is no command of ours.

    Raises:
        UsageError: it has been deleted.
    """
    try:
        if _deleted is not None:
            raise _deleted
        return _started_in or Path.cwd()
    except OSError as error:
        raise UsageError("the working directory has been deleted; give absolute paths") from error


def user_path(text: str | Path) -> Path:
    """A path as users write it: ~ is their home; raises ValueError for an empty one, which would be this folder."""
    if not str(text):
        raise ValueError("an empty path; this folder is .")
    return Path(text).expanduser()


def absolute(path: str | Path, name: str = "path") -> Path:
    """A user's path as it was meant when this command was started. name: of the argument, for the error.

    Raises:
        UsageError: it is none, empty, or one that no file system takes, or as `working_directory`.
    """
    if not isinstance(path, str | os.PathLike):
        raise UsageError(f"{name} = {path!r}: must be a path, as text or a Path")
    try:
        given = user_path(path)
        meant = given if given.is_absolute() else working_directory() / given
        meant.lstat()
    except (TypeError, ValueError, RuntimeError) as error:  # the last for a home that nobody has
        raise UsageError(f"{name} = {str(path)!r}: {error}") from None
    except OSError as error:
        if error.errno in (errno.ENAMETOOLONG, errno.ELOOP):
            raise UsageError(f"{name} = {str(path)!r}: {error.strerror}") from None
    return meant


def shown(path: Path) -> Path:
    """A path below that directory as users write it; others as they are."""
    if _started_in is not None and path.is_relative_to(_started_in):
        return path.relative_to(_started_in)
    return path
