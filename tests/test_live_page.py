"""The live page: what it says and draws in a browser, what a server of it refuses, and that it hears of a run's end."""

import json
import re
import shutil
import subprocess
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from commands import run_command
from msgspec.structs import replace
from test_screen import EVENTS, STATUS

from coop.common.errors import UsageError
from coop.common.messaging.messages.status import Member, Ratio
from coop.common.process.ports import http_address
from coop.monitor.curves import Thinned
from coop.monitor.facts import facts
from coop.monitor.live_page import COLUMNS, LivePage

CHROMIUM = shutil.which("chromium") or shutil.which("google-chrome")
STRANGER = Member("<b>actor</b>", "actor", "\x1b[2J", 1, "waiting", 0.0, "<script>document.title = 'x'</script>")


@pytest.fixture
def page() -> Iterator[LivePage]:
    served = LivePage("demo", "0")
    yield served
    served.close()


def page_json(page: LivePage) -> dict[str, Any]:
    with urllib.request.urlopen(f"{page.url}page.json", timeout=20) as answer:
        return json.loads(answer.read())  # type: ignore[no-any-return]


def in_browser(page: LivePage, folder: Path, milliseconds: int) -> str:
    """The page's document after some seconds of the browser's clock."""
    assert CHROMIUM is not None
    flags = ["--headless=new", "--no-sandbox", "--disable-gpu", f"--user-data-dir={folder}", "--window-size=1300,1000"]
    command = [CHROMIUM, *flags, f"--virtual-time-budget={milliseconds}", "--dump-dom", page.url]
    return subprocess.run(command, capture_output=True, text=True, timeout=100, check=True).stdout


@pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium: apt-get install chromium")
def test_a_browser_follows_the_run(page: LivePage, tmp_path: Path) -> None:
    """The status changes whenever the browser has asked: one that asks only once would show none of the changes."""
    members = [*STATUS.members, STRANGER]
    status = replace(STATUS, members=members, env_steps=100)
    answered, ended = page.state, threading.Event()

    def next_status() -> dict[str, Any]:
        nonlocal status
        now = answered()
        status = replace(status, env_steps=status.env_steps + 50)
        page.show(status, EVENTS[:3], 7.0 if status.env_steps > 200 else 0.0, "")
        ended.set()
        return now

    page.show(status, EVENTS[:3], 0.0, "")
    page.state = next_status  # type: ignore[method-assign]
    document = in_browser(page, tmp_path, 4500)
    assert ended.is_set()
    assert status.env_steps >= 250, "it asked more than twice"
    assert "<title>demo</title>" in document
    assert "the learner has been silent for 7 s" in document
    rows = dict(re.findall(r"<dt>([^<]+)</dt><dd[^>]*>([^<]*)</dd>", document))
    expected = facts(replace(status, env_steps=status.env_steps - 50))
    assert rows == {label: text.replace("&", "&amp;") for label, text in expected.items()}
    cells = [re.findall(r"<td>([^<]*)</td>", row) for row in re.findall(r"<tr.*?</tr>", document)]
    assert cells[0] == ["actor 2", "node2 (pid 44)", "lost", "does not answer"]
    assert cells[-1][:2] == ["&lt;b&gt;actor&lt;/b&gt;", "?[2J (pid 1)"]
    assert re.findall(r"<li>([^<]*)</li>", document) == EVENTS[2::-1], "the newest first"
    drawn = dict(re.findall(r'<svg [^>]*aria-label="([^"]+)".*?<path class="s0" d="([^"]+)"', document))
    assert len(drawn["Mean return of the last 100 episodes, over episodes"].split("L")) == len(STATUS.return_history)
    assert len(drawn["Speed"].split("L")) == (status.env_steps - 50 - 100) / 50 + 1
    assert document.count('class="bound" d=') == 4, "the target, the band and the bound of |Q|"


def test_what_the_page_is_told(page: LivePage) -> None:
    assert page_json(page) == {"run": "demo", "notice": "waiting for the learner", "ended": False, "events": []}
    page.show(STATUS, EVENTS, 0.0, "")
    page.show(STATUS, EVENTS, 1.0, "")
    now = page_json(page)
    assert dict(now["facts"]) == facts(STATUS)
    assert (now["settings"], now["times"]) == ("CartPole-v1, coop, seed 0", "1:02:05 so far, about 0:01:01 left")
    assert (now["notice"], now["connected"]) == ("", "1 replay service, 2 actors")
    assert now["progress"] == pytest.approx(0.6248)
    assert now["columns"] == list(COLUMNS)
    (point,) = now["points"]
    assert {name: value for name, value in zip(COLUMNS, point, strict=True) if value is not None} == {
        "env_steps": 31_240, "env_steps_per_s": 1204.0, "updates_per_s": 1198.2, "ratio_measured": 0.998,
        "ratio_target": 1.0, "ratio_ahead": 12.0, "ratio_least": -64.0, "ratio_most": 80.0, "td_error": 0.1,
        "loss": 0.02, "q_abs_mean": 42.13, "q_bound": 100.0, "q_gap": 0.31, "sample_age_mean": 251.0,
        "sample_age_p95": 478.0, "weight_lag_mean": 203.0,
    }  # fmt: skip
    titles = {chart["title"]: chart["lines"] for chart in now["charts"]}
    assert titles["Speed"] == [["env_steps_per_s", "steps/s", "s0"], ["updates_per_s", "updates/s", "s1"]]
    assert titles["Mean |Q| against its bound"][1] == ["q_bound", "bound", "bound"]
    page.show(replace(STATUS, ratio=None, measured=None), EVENTS, 0.0, "")
    page.show(replace(STATUS, ratio=Ratio(1.0, None, -500.0, -64.0, 80.0), measured=None), EVENTS, 0.0, "")
    known = [{name: value for name, value in zip(COLUMNS, point, strict=True) if value is not None}
             for point in page_json(page)["points"][1:]]  # fmt: skip
    fewer = {"env_steps": 31_240, "env_steps_per_s": 1204.0, "updates_per_s": 1198.2}
    band = {"ratio_target": 1.0, "ratio_least": -64.0, "ratio_most": 80.0}
    assert known == [fewer, fewer | band], "before the first update, steps ahead are out of the band"


def test_the_end_of_the_run_reaches_a_browser_that_follows_it() -> None:
    page = LivePage("demo", "0")
    page.show(STATUS, EVENTS, 0.0, "")
    assert not page_json(page)["ended"]
    page.show(STATUS, EVENTS, 0.0, "complete")
    closing = threading.Thread(target=page.close)
    closing.start()
    assert closing.is_alive()
    assert page_json(page)["notice"] == "the run has ended: complete"
    closing.join(20)
    with pytest.raises(urllib.error.URLError):
        page_json(page)
    alone = LivePage("demo", "0")
    alone.show(STATUS, EVENTS, 0.0, "complete")
    began = time.monotonic()
    alone.close()
    assert time.monotonic() - began < 2, "nobody follows it"


def test_curves_keep_evenly_spaced_points() -> None:
    curves: Thinned[list[float | None]] = Thinned(400)
    for step in range(1000):
        curves.add([step, None])
    assert curves.points == [[step, None] for step in range(0, 1000, 4)]
    curves.add([500, 1.0])
    assert curves.points == [[500, 1.0]], "the run was resumed from a checkpoint"


def test_only_the_page_is_served_and_it_loads_nothing(page: LivePage) -> None:
    with urllib.request.urlopen(page.url, timeout=20) as answer:
        html = answer.read().decode()
        assert "default-src 'none'" in answer.headers["Content-Security-Policy"]
    assert not re.findall(r"(?:src|href)=\"(?!data:)|https?://(?!www\.w3\.org)|@import|url\(", html)
    for path in ("page.html", "../pyproject.toml", "page.json?x"):
        with pytest.raises(urllib.error.HTTPError, match="404"):
            urllib.request.urlopen(page.url + path, timeout=20)


@pytest.mark.parametrize(
    ("text", "address"),
    [
        ("8080", ("127.0.0.1", 8080)),
        ("0.0.0.0:8080", ("0.0.0.0", 8080)),
        ("head:0", ("head", 0)),
        ("[::1]:8080", ("::1", 8080)),
    ],
)
def test_addresses(text: str, address: tuple[str, int]) -> None:
    assert http_address("--web", text) == address


@pytest.mark.parametrize("text", ["", "x", "70000", ":80", "a:b", "-1", "::1:80", "80 "])
def test_what_is_no_address(text: str) -> None:
    with pytest.raises(UsageError, match=r"--web .*PORT or HOST:PORT"):
        http_address("--web", text)


def test_a_page_that_cannot_be_served_is_refused_before_anything_starts(page: LivePage, tmp_path: Path) -> None:
    port = page.url.rsplit(":", 1)[1].strip("/")
    for flags in (("coop-watch",), ("coop-local", "--run-dir", tmp_path / "run")):
        done = run_command(*flags, "--web", port)
        assert (done.returncode, done.stderr) == (2, f"{flags[0]}: error: --web {port}: Address already in use\n")
    assert not (tmp_path / "run").exists()
    done = run_command("coop-watch", "--once", "--web", "0")
    assert (done.returncode, done.stderr) == (2, "coop-watch: error: --web: shows a live run; leave out --once\n")
