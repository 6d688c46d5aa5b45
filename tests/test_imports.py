"""Users' own modules: found in the working directory, and refused in one line."""

import sys
from pathlib import Path

import pytest

from coop.common.errors import JoinError, UsageError
from coop.common.imports import check_allowed, import_object


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The working directory, on no search path."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    return tmp_path


def test_an_object_comes_from_the_working_directory(folder: Path) -> None:
    (folder / "imported_here.py").write_text("class Nets:\n    make = 7\n")
    assert import_object("imported_here:Nets.make", "network.kind") == 7


@pytest.mark.parametrize(
    ("path", "text"),
    [
        ("imported_bad", "network.kind = 'imported_bad': must be module:name"),
        ("imported_bad:", "network.kind = 'imported_bad:': must be module:name"),
        ("imported_missing:make", "network.kind: cannot import 'imported_missing': ModuleNotFoundError: "
                                  "No module named 'imported_missing'"),
        ("imported_bad:make", "network.kind: cannot import 'imported_bad': ValueError: two lines"),
        ("json:make", "network.kind = 'json:make': module 'json' has no 'make'"),
    ],
)  # fmt: skip
def test_what_cannot_be_imported_is_refused_in_one_line(folder: Path, path: str, text: str) -> None:
    (folder / "imported_bad.py").write_text("raise ValueError('two\\nlines')\n")
    with pytest.raises(UsageError) as refused:
        import_object(path, "network.kind")
    assert str(refused.value) == text


def test_only_allowed_modules_are_imported_for_others() -> None:
    check_allowed("my_nets.duel:make", ["other", "my_nets"], "network.kind")
    check_allowed("my_nets.duel", ["my_nets.duel"], "network.kind")
    for allowed in ([], ["my_net"], ["my_nets.duel.deep"]):
        with pytest.raises(JoinError, match=r"network.kind = 'my_nets.duel:make'.*--allow-import my_nets$"):
            check_allowed("my_nets.duel:make", allowed, "network.kind")
