"""Bounds on files from elsewhere: names of runs, links, and how much memory a file may ask for.

A run, a study or a checkpoint of somebody else is data. What it names stays within its folder, and what it declares is
compared with the bytes that are there before memory is taken for it.
"""

from __future__ import annotations

import errno
import io
import mmap
import os
import pickle
import re
import stat
import unicodedata
import zipfile
from collections import OrderedDict
from collections.abc import Iterator
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from coop.common.errors import RunError, UsageError
from coop.common.types import Array

MAX_NAME_BYTES = 100
MAX_TEXT = 1 << 30  # bytes of a text file that is read at once
MAX_SETTINGS = 1 << 24  # bytes of one that holds settings
_PIECE = 1 << 20  # bytes read at once of what has no size
_PATTERN = frozenset("*?[")
LEFT = (
    "config.toml", "episodes.csv", "metrics.jsonl", "evaluations.csv", "summary.json", "run-id", "roster.json",
    "learning_curve.png", "checkpoints", "journal", "videos", "logs", "tb", "wandb",
)  # fmt: skip
"""What a run leaves in its folder; the rest, but for _BESIDE, is its user's."""
_BESIDE = ("run.log", ".learner.lock", ".replay.lock", "aside", "sweep.toml")
_SIZES = {  # bytes of an item of PyTorch's storages
    "Double": 8, "Float": 4, "Half": 2, "BFloat16": 2, "Long": 8, "Int": 4, "Short": 2, "Char": 1, "Byte": 1, "Bool": 1,
}  # fmt: skip
_MADE = {
    *(("torch._utils", name) for name in ("_rebuild_tensor_v2", "_rebuild_parameter")),
    *(("torch", name) for name in ("Size", "device", "float32", "float64", "bfloat16", "int64", "uint8", "bool")),
    ("_codecs", "encode"),
}
MAX_ENTRIES = 1 << 20  # pages of a column


RUN = r"^[A-Za-z0-9_][A-Za-z0-9._-]{0,63}$"  # what a run is called on the wire; always a name of a folder too


def check_run(name: str) -> None:
    """Raise UsageError for a name that no run has on the wire, by which its processes find each other."""
    if re.fullmatch(RUN, name) is None:
        raise UsageError(f"--run {name[:MAX_NAME_BYTES]!r}: allowed: {RUN.strip('^$')}")


def check_run_name(name: str, source: str) -> str:
    """The name of a run's folder, if it is one: a single folder's name that no shell, pattern or terminal misreads.

    source: where the name is from, for the message.

    Raises:
        UsageError: it is none; says why.
    """
    problem = _problem(name)
    if problem is not None:
        raise UsageError(f"{source}: run name {name[:MAX_NAME_BYTES]!r}: {problem}")
    return name


def _problem(name: str) -> str | None:
    problems = {
        "is empty": not name,
        f"has more than {MAX_NAME_BYTES} bytes": len(name.encode("utf-8", "surrogatepass")) > MAX_NAME_BYTES,
        "holds a path separator; it must be one folder's name": "/" in name or "\\" in name,
        f"begins with {name[:1]!r}": name[:1] in {"-", "."},
        "holds one of * ? [": bool(_PATTERN & {*name}),
        "holds a control character": any(_is_control(unicodedata.category(letter)) for letter in name),
    }
    return next((problem for problem, found in problems.items() if found), None)


def _is_control(category: str) -> bool:
    """Whether letters of a Unicode category have no shape, turn the direction of text, or end a line."""
    return category[0] == "C" or category in {"Zl", "Zp"}


def check_links(folder: Path) -> None:
    """Refuse a run's folder in which a file of the product is a link that leads out of the folder, a pipe or a device.

    Raises:
        RunError: names it.
    """
    if not folder.is_dir():
        return
    inside = folder.resolve()
    for path in _own(folder):
        if path.is_symlink() and _leads_to_itself(path):
            raise RunError(f"{path}: a link that leads to itself; not followed")
        if path.is_symlink() and not path.resolve().is_relative_to(inside):
            raise RunError(f"{path}: a link that leads out of the run, to {path.readlink()}; not followed")
        if path.exists() and not (path.is_file() or path.is_dir()):
            raise RunError(f"{path}: neither a file nor a folder; not opened")


def _leads_to_itself(path: Path) -> bool:
    try:
        path.stat()
    except OSError as error:
        return error.errno == errno.ELOOP
    return False


def _own(folder: Path) -> Iterator[Path]:
    """The files and folders of a run that the product reads or writes, links not followed."""
    for name in (*LEFT, *_BESIDE):
        yield folder / name
        yield folder / f"{name}.part"
    for name in LEFT:
        if name == "wandb":
            continue  # Weights & Biases links its own log there, which is outside; nothing here opens what it holds
        for at, folders, files in os.walk(folder / name):
            if name == "checkpoints" and Path(at) == folder / name:
                yield from (Path(at, each) for each in folders if each.isdecimal())
                folders[:] = [each for each in folders if each.isdecimal()]  # the others are its user's
            else:
                yield from (Path(at, each) for each in (*folders, *files))


def refuse_links(*paths: Path) -> None:
    """Refuse links, pipes and devices where files are about to be written in a folder that may be somebody else's.

    Raises UsageError.
    """
    for path in paths:
        if path.is_symlink():
            raise UsageError(f"{path}: a link, to {path.readlink()}; nothing is written through it")
        if path.exists() and not (path.is_file() or path.is_dir()):
            raise UsageError(f"{path}: neither a file nor a folder; not opened")


def no_links(path: str, flags: int) -> int:
    """For `open(opener=...)`: refuses a link as the file itself, so that no other file is written in its place."""
    return os.open(path, flags | os.O_NOFOLLOW, 0o666)


def read_bytes(path: Path, most: int | None = None) -> bytes:
    """The content of a file of at most `most` bytes, MAX_TEXT by default.

    Raises OSError, and RunError for a larger file before it is read: one that is empty for the most part takes no
    space on a disk, or in an archive. Of a pipe or a device, which has no size, no more is read.
    """
    status, most = path.stat(), MAX_TEXT if most is None else most
    if status.st_size > most:
        raise RunError(f"{path}: has {status.st_size:,} bytes; allowed: at most {most:,}")
    if stat.S_ISREG(status.st_mode):
        return path.read_bytes()
    data = bytearray()
    with path.open("rb") as file:
        while piece := file.read(_PIECE):
            data += piece
            if len(data) > most:
                raise RunError(f"{path}: has more than {most:,} bytes; allowed: at most that")
    return bytes(data)


def read_text(path: Path, most: int | None = None) -> str:
    """The text of a file, with newlines as Python has them; raises as `read_bytes`, and UnicodeDecodeError."""
    return io.TextIOWrapper(io.BytesIO(read_bytes(path, most)), encoding="utf-8").read()


def load_array(path: Path, small: int) -> Array:
    """Read a .npy file; one of more than `small` bytes stays on the disk. Raises OSError, and ValueError for no array.

    The file is mapped even if it is small: that compares the shape in its header with the bytes that follow.
    """
    array: Array = np.load(path, mmap_mode="r", allow_pickle=False)
    return array if path.stat().st_size > small else np.array(array)


def check_torch_file(path: Path) -> None:
    """Check a file of `torch.save` before PyTorch reads it: nothing in it is larger than the file.

    Raises:
        OSError: it cannot be read.
        RunError: it is no such file, or it declares more than it holds.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            entries = {entry.filename: entry for entry in archive.infolist()}
            size = path.stat().st_size
            if any(entry.compress_type != zipfile.ZIP_STORED or entry.file_size > size for entry in entries.values()):
                raise ValueError("an entry is compressed, or larger than the file")
            (name,) = (each for each in entries if each.endswith("/data.pkl"))
            root = name.removesuffix("data.pkl")
            with archive.open(name) as file:
                _Described(file, {key.removeprefix(root): entry.file_size for key, entry in entries.items()}).load()
    except OSError:
        raise
    except Exception as error:  # whatever a made-up pickle makes of the reader
        raise RunError(f"{path}: can't be read: {' '.join(f'{type(error).__name__}: {error}'.split())}") from error


class _Described(pickle._Unpickler):  # in Python: it takes no memory in advance
    """Reads what a checkpoint says of its arrays, and makes none; knows no more names than our checkpoints hold."""

    def __init__(self, file: Any, sizes: dict[str, int]) -> None:  # noqa: ANN401 (a file in an archive)
        super().__init__(file)
        self._sizes = sizes

    def find_class(self, module: str, name: str) -> Any:  # noqa: ANN401 (a name's stand-in)
        if (module, name) == ("collections", "OrderedDict"):
            return _ordered
        if module == "torch" and name.removesuffix("Storage") in _SIZES:
            return name.removesuffix("Storage")
        if (module, name) in _MADE:
            return _nothing
        raise ValueError(f"names {module}.{name}")

    def persistent_load(self, pid: Any) -> None:  # noqa: ANN401 (whatever the file holds)
        _, storage, key, _, items = pid
        if not (isinstance(storage, str) and isinstance(key, str) and isinstance(items, int)):
            raise ValueError("an array that is none")  # noqa: TRY004 (what is nested may be without end to print)
        held = self._sizes.get(f"data/{key}")
        if held != items * _SIZES[storage]:
            raise ValueError(f"array {key!r}: {items:,} items, {held} bytes")

    def _set_items(self: Any) -> None:
        items = self.pop_mark()
        self._fill(items)

    def _set_item(self: Any) -> None:
        value, key = self.stack.pop(), self.stack.pop()
        self._fill([key, value])

    def _fill(self: Any, items: list[Any]) -> None:
        if not all(isinstance(key, str | int) for key in items[::2]):  # what is nested may be without end to hash
            raise ValueError("a key that is neither a text nor a number")
        self.stack[-1].update(zip(items[::2], items[1::2], strict=True))

    dispatch: ClassVar[dict[int, Any]] = {
        **pickle._Unpickler.dispatch,
        pickle.SETITEM[0]: _set_item,
        pickle.SETITEMS[0]: _set_items,
    }
    for each in (pickle.BYTEARRAY8, pickle.DICT, pickle.EMPTY_SET, pickle.ADDITEMS, pickle.FROZENSET):
        del dispatch[each[0]]  # takes memory for a size that is only declared, or hashes whatever it is given


def _ordered() -> OrderedDict[Any, Any]:
    return OrderedDict()


def _nothing(*_: Any) -> None:  # noqa: ANN401 (the arguments that make a tensor or the like)
    return None


def page_sizes(content: bytes | mmap.mmap, start: int, length: int) -> Iterator[tuple[int, int]]:
    """Bytes, once decompressed, and values of each page of a column in a Parquet file, as the page declares them.

    start, length: of the column's pages in the file, in bytes. The file's footer says the same of whole columns, but
    it is by the pages that memory is taken.

    Raises ValueError if a page's header is none, or there are more than `MAX_ENTRIES` pages.
    """
    end = start + length
    if not 0 <= start <= end <= len(content):
        raise ValueError("a column outside of the file")
    for _ in range(MAX_ENTRIES):
        if start >= end:
            return
        try:
            fields, start = _thrift(content, start)
            size, packed = fields[2], fields[3]
            values = sum(fields[kind].get(1, 0) for kind in (5, 7, 8) if kind in fields)
        except (IndexError, KeyError, AttributeError, TypeError) as error:
            raise ValueError("a page without a header") from error
        if min(size, packed, values) < 0:
            raise ValueError("a page of negative size")
        yield size, values
        start += packed
    raise ValueError(f"more than {MAX_ENTRIES:,} pages in a column")


def _thrift(content: bytes | mmap.mmap, at: int, depth: int = 0) -> tuple[dict[int, Any], int]:
    """The fields of a structure in Thrift's compact protocol, by number, and the place after it.

    Integers and structures only: texts, which statistics have, are passed over, and lists no page's header has.
    """
    fields: dict[int, Any] = {}
    number = 0
    while code := content[at]:
        at += 1
        if code >> 4:
            number += code >> 4
        else:
            number, at = _zigzag(content, at)
        kind = code & 15
        if kind in {4, 5, 6}:
            fields[number], at = _zigzag(content, at)
        elif kind == 8:
            size, at = _varint(content, at)
            at += size
        elif kind == 12 and depth < 3:
            fields[number], at = _thrift(content, at, depth + 1)
        elif kind == 3:
            at += 1
        elif kind not in {1, 2}:  # booleans have no more bytes
            raise ValueError("a page's header that is none")
    return fields, at + 1


def _varint(content: bytes | mmap.mmap, at: int) -> tuple[int, int]:
    value = shift = 0
    while shift < 64:
        byte = content[at]
        value, shift, at = value | (byte & 127) << shift, shift + 7, at + 1
        if byte < 128:
            return value, at
    raise ValueError("a number without an end")


def _zigzag(content: bytes | mmap.mmap, at: int) -> tuple[int, int]:
    value, at = _varint(content, at)
    return value >> 1 ^ -(value & 1), at
