"""The simulated disk: real files in memory, of which only what was flushed survives the end of the machine.

The calls that the product's files go through are taken over in this process. Each may be slow to no effect, find no
space, be the last thing that its process does, or stop half-way. A machine's crash puts each folder and each file
back to what was flushed last; of what was not, some has reached the disk all the same, and the last piece may be torn.
"""

from __future__ import annotations

import errno
import os
import random
import shutil
import stat
from collections.abc import Callable, Iterator, Set
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from benchmarks.simulate.world import Killed, World

_TAKEN = ("fsync", "fdatasync", "pwrite", "ftruncate", "replace", "rename", "unlink", "mkdir", "rmdir")
_real: dict[str, Callable[..., Any]] = {name: getattr(os, name) for name in _TAKEN}


class Disk:
    """The files below `root`, each top folder being one machine's disk.

    Attributes:
        full: top folders that have no space. deadly: how many calls a process has left, by name. calls: so far.
        failing: top folders whose next flush of a file fails.
        mortal: top folders of machines that will die; of others nobody asks what was flushed.
    """

    def __init__(self, world: World, root: Path, mortal: Set[str]) -> None:
        self.root = root
        self.mortal = mortal
        self.full: set[str] = set()
        self.failing: set[str] = set()
        self.deadly: dict[str, int] = {}
        self.calls = 0
        self._world = world
        self._files: dict[int, bytes] = {}  # what was flushed, by inode
        self._folders: dict[int, dict[str, int]] = {}
        self._holes: dict[int, tuple[int, int]] = {}  # bytes that a failed flush has lost: later ones pass them over

    @contextmanager
    def installed(self) -> Iterator[None]:
        """Take over this process's calls."""
        try:
            for name in _TAKEN:
                setattr(os, name, getattr(self, f"_{name}"))
            yield
        finally:
            for name in _TAKEN:
                setattr(os, name, _real[name])

    def crash(self, top: str, draw: random.Random) -> None:
        """Lose what a machine had not flushed."""
        root = self.root / top
        kept: dict[Path, bytes] = {}
        folders: list[Path] = []
        self._survivors(root, kept, folders, draw)
        shutil.rmtree(root)
        root.mkdir()
        for folder in folders:
            folder.mkdir(exist_ok=True)
        for path, content in kept.items():
            path.write_bytes(content)
        self.adopt(top)

    def adopt(self, top: str) -> None:
        """Take all that a machine's disk holds as flushed."""
        for folder, names, files in os.walk(self.root / top):
            entries = {name: Path(folder, name).stat().st_ino for name in (*names, *files)}
            self._folders[Path(folder).stat().st_ino] = entries
            for name in files:
                self._files[entries[name]] = Path(folder, name).read_bytes()

    def _survivors(self, folder: Path, kept: dict[Path, bytes], folders: list[Path], draw: random.Random) -> None:
        there = {entry.name: entry.inode() for entry in os.scandir(folder)}
        flushed = self._folders.get(folder.stat().st_ino, {})
        names = flushed if draw.random() < 0.7 else there  # what was not flushed may have been written all the same
        for name, inode in sorted(names.items()):
            path = folder / name
            now = next((folder / n for n, i in there.items() if i == inode), None)
            if now is not None and now.is_dir():
                if now != path:  # renamed since: its content under the old name
                    folders.append(path)
                    inner: dict[Path, bytes] = {}
                    more: list[Path] = []
                    self._survivors(now, inner, more, draw)
                    folders += [path / each.relative_to(now) for each in more]
                    kept.update({path / each.relative_to(now): content for each, content in inner.items()})
                else:
                    folders.append(path)
                    self._survivors(path, kept, folders, draw)
            elif inode in self._folders:
                folders.append(path)  # it was removed: of its content nothing is known
            else:
                kept[path] = self._content(inode, now, draw)

    def _content(self, inode: int, now: Path | None, draw: random.Random) -> bytes:
        """A file after the crash: what was flushed, what is there, or something between."""
        flushed = self._files.get(inode, b"")
        present = self._without_hole(inode, now.read_bytes()) if now is not None else flushed
        if present == flushed or draw.random() < 0.4:
            return flushed
        if draw.random() < 0.3:
            return present
        size = draw.randrange(len(flushed), len(present) + 1) if len(present) > len(flushed) else len(flushed)
        torn = bytearray(present[:size] if draw.random() < 0.5 else flushed + bytes(max(0, size - len(flushed))))
        if len(present) > len(flushed) and size > len(flushed):
            torn[: len(flushed)] = flushed[: len(torn)]
        return bytes(torn)

    # ------------------------------------------------------------------------------------------------------------------

    def _call(self) -> None:
        """Count a call, which may be its process's last one."""
        self.calls += 1
        process = self._world.running
        if process is None:
            return
        if not process.alive:
            raise Killed
        left = self.deadly.get(process.name)
        if left is not None:
            if left <= 0:
                del self.deadly[process.name]
                process.end("killed in the middle of a write")
                raise Killed
            self.deadly[process.name] = left - 1

    def _space(self) -> None:
        process = self._world.running
        if process is not None and process.machine.name in self.full:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    def _fsync(self, descriptor: int) -> None:
        self._call()
        found, process = os.fstat(descriptor), self._world.running
        is_folder = stat.S_ISDIR(found.st_mode)
        if not is_folder:
            self._space()
        name = "" if process is None else process.machine.name
        fails = not is_folder and name in self.failing
        if fails:
            self.failing.discard(name)
        if process is not None and name not in self.mortal and not fails:
            return
        if is_folder:
            with os.scandir(descriptor) as entries:
                there = list(entries)
            self._folders[found.st_ino] = {entry.name: entry.inode() for entry in there}
            for entry in there:  # if it is removed, and the removal is not flushed, a folder is there again
                if entry.is_dir():
                    self._folders.setdefault(entry.inode(), {})
            return
        opened = os.open(f"/proc/self/fd/{descriptor}", os.O_RDONLY)
        try:
            content = self._without_hole(found.st_ino, os.pread(opened, found.st_size, 0))
        finally:
            os.close(opened)
        if fails:
            before = self._files.get(found.st_ino, b"")
            pairs = enumerate(zip(before, content, strict=False))
            first = next((at for at, (one, other) in pairs if one != other), min(len(before), len(content)))
            self._holes[found.st_ino] = first, len(content)
            raise OSError(errno.EIO, os.strerror(errno.EIO))
        self._files[found.st_ino] = content

    def _without_hole(self, inode: int, content: bytes) -> bytes:
        """A file's content as the disk has it, if nothing else is lost."""
        start, end = self._holes.get(inode, (0, 0))
        return content[:start] + bytes(max(0, min(end, len(content)) - start)) + content[max(start, end) :]

    def _written_anew(self, descriptor: int, start: int) -> None:
        """What is written again from a byte on is not lost."""
        if self._holes:
            inode = os.fstat(descriptor).st_ino
            first, end = self._holes.get(inode, (0, 0))
            self._holes[inode] = first, min(end, max(first, start))

    def _fdatasync(self, descriptor: int) -> None:
        self._fsync(descriptor)

    def _pwrite(self, descriptor: int, data: bytes, at: int) -> int:
        self._call()
        process = self._world.running
        if process is not None and process.machine.name in self.full:
            _real["pwrite"](descriptor, data[: len(data) // 2], at)
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        left = None if process is None else self.deadly.get(process.name)
        if left == 0:  # its next call kills it: this one is torn
            data = data[: self._world.random.randrange(len(data) + 1)]
        self._written_anew(descriptor, at)
        written: int = _real["pwrite"](descriptor, data, at)
        return written

    def _ftruncate(self, descriptor: int, size: int) -> None:
        self._call()
        self._written_anew(descriptor, size)
        _real["ftruncate"](descriptor, size)

    def _replace(self, source: Any, target: Any, **named: Any) -> None:  # noqa: ANN401
        self._call()
        _real["replace"](source, target, **named)

    def _rename(self, source: Any, target: Any, **named: Any) -> None:  # noqa: ANN401
        self._call()
        _real["rename"](source, target, **named)

    def _unlink(self, path: Any, **named: Any) -> None:  # noqa: ANN401
        self._call()
        _real["unlink"](path, **named)

    def _mkdir(self, path: Any, mode: int = 0o777, **named: Any) -> None:  # noqa: ANN401
        self._call()
        _real["mkdir"](path, mode, **named)

    def _rmdir(self, path: Any, **named: Any) -> None:  # noqa: ANN401
        self._call()
        _real["rmdir"](path, **named)
