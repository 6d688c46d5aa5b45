"""Parts that are chosen by name, to which other packages may add their own by entry points."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cached_property
from importlib.metadata import entry_points
from typing import Any, Generic, Protocol, TypeVar

from coop.common.errors import UsageError, not_among
from coop.common.imports import import_object


class Named(Protocol):
    """An entry of a registry."""

    @property
    def name(self) -> str:
        """The name by which settings choose it."""


EntryT = TypeVar("EntryT", bound=Named)


class Registry(Generic[EntryT]):
    """Entries by name: those given, those registered, those of installed packages, and users' own as "module:name".

    Nothing is imported before its name is asked for.

    Args:
        setting: that chooses among the entries, for messages ("method").
        group: of the entry points; each must name an object of `kind` whose name is the entry point's.
        entries: by name; "module:object" stands for an entry that is imported when needed.
        entry_of: makes an entry of a class that a user's "module:name" names, and of that text.
        meant: what to choose in place of names that others use, in words.
    """

    def __init__(
        self,
        setting: str,
        group: str,
        kind: type[EntryT],
        entries: Mapping[str, EntryT | str],
        *,
        entry_of: Callable[[str, type], EntryT] | None = None,
        meant: Mapping[str, str] | None = None,
    ) -> None:
        self.setting = setting
        self.group = group
        self._kind = kind
        self._entries: dict[str, EntryT | str] = {**entries}
        self._own: dict[str, EntryT] = {}
        self._entry_of = entry_of
        self._meant = meant or {}

    def names(self) -> tuple[str, ...]:
        """All names: those of this package first; users' own "module:name" are not among them."""
        return tuple(self._all)

    def knows(self, name: str) -> bool:
        """Whether a setting may have this name; one like "module:name" has not been imported yet."""
        return ":" in name or name in self._all

    def get(self, name: str) -> EntryT:
        """The entry of a name.

        Raises:
            UsageError: there is none, or it cannot be imported; one line says so.
        """
        found = self._all.get(name)
        if found is None and ":" in name:
            return self._imported(name)
        if found is None:
            raise UsageError(f"{self.setting} = {name!r}: {self.unknown(name)}")
        if isinstance(found, str):
            found = self._all[name] = self._checked(name, loaded(found, f"{self.setting} {name!r}"), found)
        return found

    def unknown(self, name: str) -> str:
        """Why a name is refused, with a suggestion and the names allowed."""
        if name in self._meant:
            return f"unknown; did you mean {self._meant[name]}?"
        own = "or module:name; one that a program registers is known once its module has been imported"
        return f"{not_among(self.names(), name)}, {own}"

    def _imported(self, path: str) -> EntryT:
        """The entry that a user's "module:name" names, or that of a class there."""
        if path not in self._own:
            found = import_object(path, self.setting)
            if isinstance(found, type) and self._entry_of is not None:
                found = self._entry_of(path, found)
            if not isinstance(found, self._kind):
                raise UsageError(f"{self.setting} = {path!r}: is no {self._kind.__name__}, nor a class of one")
            self._own[path] = found
        return self._own[path]

    def register(self, entry: EntryT) -> None:
        """Add an entry in this process; an entry point adds it in all of them. Raises UsageError for a name in use."""
        if entry.name in self._all:
            raise UsageError(f"{self.setting} = {entry.name!r}: there is one of that name already")
        self._all[entry.name] = self._checked(entry.name, entry, "it")

    @cached_property
    def _all(self) -> dict[str, EntryT | str]:
        # Names and values alone: their class is another one once a package, such as Dask, imports `importlib_metadata`.
        points = sorted(entry_points(group=self.group), key=lambda point: point.name)
        return {**self._entries, **{point.name: point.value for point in points if point.name not in self._entries}}

    def _checked(self, name: str, entry: Any, source: str) -> EntryT:  # noqa: ANN401 (whatever a package gives)
        if not isinstance(entry, self._kind):
            raise UsageError(f"{self.setting} {name!r}: {source} is no {self._kind.__name__}")
        if entry.name != name:
            raise UsageError(f"{self.setting} {name!r}: {source} has another name, {entry.name!r}")
        return entry


def loaded(part: Any, field: str) -> Any:  # noqa: ANN401 (whatever a package gives)
    """The object that "module:object" names; anything but a text is the object itself.

    Raises:
        UsageError: it cannot be imported; names the `field`.
    """
    return import_object(part, field, installed=True) if isinstance(part, str) else part
