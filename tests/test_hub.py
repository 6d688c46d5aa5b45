"""Model repositories, and how runs, buffers and films are shown in notebooks."""

from __future__ import annotations

import base64
import io
import re
from pathlib import Path

import pytest
import yaml
from PIL import Image
from test_buffer import SMALL, saved

import coop
from coop.common.errors import UsageError
from coop.common.settings.tables import load_tables, resolve
from coop.evaluation import export_cli
from coop.evaluation.export import export
from coop.evaluation.hub import EPISODES, FILMS, export_hub, iqm
from coop.evaluation.saved import SavedRun

EMBEDDED = re.compile(r'src="data:image/(\w+);base64,([^"]+)"')


def test_a_model_repository(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    run, out = tmp_path / "run", tmp_path / "hub"
    saved(run, env={"id": "coop/Catch-v0"}, replay={**SMALL, "ratio": 2})
    monkeypatch.setattr("sys.argv", ["coop-export", str(run), "--hub", str(out)])
    export_cli.main()
    told = capsys.readouterr().out
    assert "hf upload USER/coop-coop-coop-Catch-v0" in told
    _, header, page = (out / "README.md").read_text().split("---\n", 2)
    card = yaml.safe_load(header)
    own, config = card["coop"], coop.load(run).config
    assert (own["environment"], own["method"], own["capacity"], own["ratio"]) == ("coop/Catch-v0", "coop", 40, 2)
    assert own["command"] == "coop-lockstep --config config.toml"
    assert re.search(r"commit [0-9a-f]{40}$", own["version"])
    result = coop.evaluate(coop.load(run).policy(), episodes=EPISODES)
    assert own["iqm"] == pytest.approx(iqm(result.returns))
    (model,) = card["model-index"]
    mean, middle = model["results"][0]["metrics"]
    assert (mean["type"], mean["value"]) == ("mean_reward", f"{result.mean:.2f} +/- {result.sd:.2f}")
    assert middle["value"] == pytest.approx(own["iqm"])
    assert model["results"][0]["dataset"]["name"] == "coop/Catch-v0"
    assert "# coop on coop/Catch-v0" in page
    assert resolve(load_tables(None, out / "config.toml")) == config
    names = {path.name for path in out.iterdir()}
    assert {"README.md", "config.toml", "card.json", "network-1.safetensors", "network-2.safetensors"} <= names
    films = names & {*FILMS}
    assert len(films) == (0 if "no film:" in told else 1)
    export_hub(run, out)
    assert {path.name for path in out.iterdir()} == names
    (out / "notes.txt").write_text("mine")
    with pytest.raises(UsageError, match=r"^--hub .*: has other files, such as notes.txt"):
        export_hub(run, out)
    (out / "notes.txt").unlink()
    with pytest.raises(UsageError, match=r"^--out .*: has other files, such as README.md"):
        export(run, out)


def test_the_interquartile_mean() -> None:
    assert iqm([5.0]) == 5
    assert iqm([0.0, 1.0, 2.0, 100.0]) == 1.5
    assert iqm([100.0, 0.0, 1.0, 2.0, 3.0, 4.0]) == pytest.approx((0.5 * 1 + 2 + 3 + 0.5 * 4) / 3)


def pictures(shown: str) -> list[Image.Image]:
    return [Image.open(io.BytesIO(base64.b64decode(content))) for _, content in EMBEDDED.findall(shown)]


def test_what_a_notebook_shows(tmp_path: Path) -> None:
    run = coop.train("catch", "dqn", total_steps=300, run_dir=tmp_path / "<a>", replay=SMALL, log="none")
    run.wait()
    loaded = coop.load(run.directory)
    assert run._repr_html_() == loaded._repr_html_()
    assert "&lt;a&gt;" in loaded._repr_html_()
    assert "<a>" not in loaded._repr_html_()
    assert "complete" in loaded._repr_html_()
    (curve,) = pictures(loaded._repr_html_())
    assert curve.size == (960, 540)
    assert "observations: uint8 [40, " in loaded.buffer()._repr_html_()
    clip = loaded.film()
    (film,) = pictures(clip._repr_html_())
    assert film.n_frames >= clip.steps > 1  # type: ignore[attr-defined]
    clip.save(tmp_path / "film.gif")
    assert (tmp_path / "film.gif").read_bytes() == clip.gif
    assert clip.over
    with pytest.raises(coop.RunError, match=r"film.gif: No such file or directory$"):
        clip.save(tmp_path / "nowhere" / "film.gif")
    begun = SavedRun(run.directory)
    (run.directory / "summary.json").unlink()
    assert "goes on, or was killed" in begun._repr_html_()
