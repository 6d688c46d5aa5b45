"""The documentation's examples run as they stand, in the order of the page."""

import re
import shlex
import subprocess
import sys
import sysconfig
from pathlib import Path

import pytest

import coop

pytestmark = pytest.mark.timeout(300)  # whole runs, also on a busy machine

DOCS = Path(__file__).parents[1] / "docs"
BLOCK = re.compile(r"^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
MAX_LINES = 30


def run_page(page: str, folder: Path) -> int:
    """Save the blocks that name a file, execute the other ones; return how many there were."""
    shared: dict[str, object] = {}
    blocks = [(kind, text) for kind, text in BLOCK.findall((DOCS / page).read_text(encoding="utf-8")) if kind != "toml"]
    for kind, text in blocks:
        if file := re.match(r"# (\w+\.py)\n", text):
            (folder / file[1]).write_text(text, encoding="utf-8")
        elif kind == "python":
            exec(compile(text, page, "exec"), shared)
        else:
            for line in text.replace("\\\n", "").splitlines():
                name, *flags = shlex.split(line)
                command = [Path(sysconfig.get_path("scripts"), name), *flags]
                subprocess.run(command, check=True, capture_output=True, cwd=folder, timeout=100)
    return len(blocks)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    for name in [name for name in sys.modules if name.startswith("my_")]:  # other tests have modules of these names
        monkeypatch.delitem(sys.modules, name)
    return tmp_path


def test_the_python_api(folder: Path) -> None:
    assert run_page("python.md", folder) == 4
    summaries = [coop.load(path).summary for path in (folder / "runs" / "a", *(folder / "runs" / "sizes").glob("*-*"))]
    assert [summary and summary["exit"] for summary in summaries] == ["complete"] * 5


def test_extending(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run_page("extending.md", folder) == 8
    assert capsys.readouterr().out == "complete\ncomplete\n"
    for name in ("room", "residual", "cautious", "most-drawn"):
        summary = coop.load(folder / "runs" / name).summary
        assert summary is not None
        assert (summary["exit"], summary["env_steps"]) == ("complete", 500)
    for module in ("my_envs", "my_nets", "my_methods", "my_policies"):
        lines = [line for line in (folder / f"{module}.py").read_text().splitlines() if line.strip()]
        assert len(lines) < MAX_LINES
        sys.modules.pop(module, None)
