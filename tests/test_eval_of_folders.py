"""`coop-eval` on folders: every network, greedily and with random actions, and videos of their play."""

import io
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from PIL import Image

from coop.common.envs.catch import Catch
from coop.common.envs.make import check_filmed, make_filmed_env, make_vector_env
from coop.common.envs.pictures import grayscale, make_resizer
from coop.common.errors import UsageError
from coop.common.settings.config import NetworkSettings
from coop.common.settings.environment import EnvSettings
from coop.evaluation import cli as evaluation_cli
from coop.evaluation.evaluate import Evaluation, evaluate_checkpoint, film_checkpoint
from coop.evaluation.film import Film, short_gif, write_video
from coop.lockstep.lockstep import Lockstep
from coop.records.run_directory import RunDirectory
from coop.records.run_options import base_config


def run_with(path: Path, acting: int, action: int) -> None:
    """A run directory whose network `acting` always prefers `action`, and whose other one the other action."""
    run = Lockstep(base_config(["--method", "coop"]))
    with RunDirectory(path, run.config) as directory:
        for _ in range(40):
            for effects in run.play():
                directory.record(effects.episodes, effects.metrics)
        run.agent.acting = acting
        for number, network in enumerate(run.agent.networks):
            flat = torch.zeros_like(network.flat)
            flat[-2 + (action if number == acting else 1 - action)] = 1.0  # the last two are the output's biases
            network.load(flat)
        run.save(directory)
    run.env.close()


@pytest.mark.parametrize(("acting", "action"), [(0, 1), (1, 0)])
def test_each_network_plays_its_best_action(acting: int, action: int, tmp_path: Path) -> None:
    run_with(tmp_path / "run", acting, action)
    first, second, both = evaluate_checkpoint(tmp_path / "run", 30, 5)
    assert [one.network for one in (first, second, both)] == [1, 2, "mean"]
    assert [one.acts for one in (first, second, both)] == [acting == 0, acting == 1, False]
    # CartPole falls after 8 to 11 steps of the same push.
    for one in (first, second):
        assert len(one.returns) == 30
        assert {8.0, 9.0, 10.0} <= set(one.returns) <= {8.0, 9.0, 10.0, 11.0}
    assert first.returns != second.returns, "from the same starts, to the other side"
    # Both actions have the same mean value, and the first of equals is the best: the left one.
    left = second if (acting == 0) == (action == 1) else first
    assert both.returns == left.returns
    assert next(evaluate_checkpoint(tmp_path / "run", 30, 5)) == first
    assert next(evaluate_checkpoint(tmp_path / "run", 30, 6)) != first
    (random,) = evaluate_checkpoint(tmp_path / "run", 200, 5, networks=(1,), epsilons=(1.0,))
    assert 15 < random.mean < 30, "random play"


def test_a_method_with_one_network_plays_that_one(tmp_path: Path) -> None:
    run = Lockstep(base_config(["--method", "dqn"]))
    with RunDirectory(tmp_path, run.config) as directory:
        run.save(directory)
    run.env.close()
    assert [one.network for one in evaluate_checkpoint(tmp_path, 1, 0)] == [1]


def test_the_interval_of_a_mean() -> None:
    assert Evaluation([3.0] * 5).interval == (3.0, 3.0)
    low, high = Evaluation([0.0, 1.0] * 50).interval
    assert (low, high) == (pytest.approx(0.4, abs=0.02), pytest.approx(0.6, abs=0.02)), "0.5 -+ 1.96 sd / sqrt(100)"


def printed_by(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], *flags: object
) -> tuple[object, str]:
    """Exit status and output of coop-eval."""
    monkeypatch.setattr("sys.argv", ["coop-eval", *map(str, flags)])
    status: object = 0
    try:
        evaluation_cli.main()
    except SystemExit as end:
        status = end.code
    printed = capsys.readouterr()
    assert not (printed.out and printed.err)
    return status, printed.out + printed.err


def test_a_table_of_several_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for name, acting in (("a", 0), ("longer", 1)):
        run_with(tmp_path / name, acting, 0)
    runs = (tmp_path / "a", tmp_path / "longer")
    status, text = printed_by(monkeypatch, capsys, *runs, "--episodes", 4, "--video", tmp_path / "x.gif")
    assert (status, text) == (2, f"coop-eval: error: --video {tmp_path}/x.gif: of one run; there are 2\n")
    status, text = printed_by(monkeypatch, capsys, *runs, "--episodes", 4, "--envs", 3)
    head, *lines = text.splitlines()
    assert (status, len(lines)) == (0, 2 * 3 * 2)
    words = head.replace("95% interval", "interval").split()
    assert words == ["run", "checkpoint", "network", "epsilon", "episodes", "mean", "interval", "sd", "least", "most"]
    row = r"\S+/(\w+) +0  (1 acts|1|2 acts|2|mean) +(0|0\.05) +4 +(\d+\.\d\d) +(\d+\.\d\d) to (\d+\.\d\d) .*"
    found = [re.fullmatch(row, line) for line in lines]
    assert all(found)
    shown = [match.groups()[:3] for match in found if match]
    networks = {"a": ("1 acts", "2", "mean"), "longer": ("1", "2 acts", "mean")}
    assert shown == [(run, name, epsilon) for run in networks for name in networks[run] for epsilon in ("0", "0.05")]
    assert all(float(match[5]) <= float(match[4]) <= float(match[6]) for match in found if match)
    assert len({len(line) for line in (head, *lines)}) == 1, "columns stand below each other"
    assert (tmp_path / "a" / "evaluations.csv").read_text().count("\n") == 1


def test_what_it_refuses(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    run_with(tmp_path / "run", 0, 0)
    run = tmp_path / "run"
    (run / "checkpoints" / "0" / "DONE").unlink()
    for flags, words in (
        ((run,), "has no complete checkpoint"),
        ((tmp_path,), "holds no run"),
        ((run, "--episodes", "0"), "--episodes 0: must be at least 1"),
        ((run, "--seed", "-1"), "--seed -1: must be at least 0"),
        ((run, "--envs", "0"), "--envs 0: must be at least 1"),
        ((run, "--epsilon", "0.1", "1.5"), "--epsilon 1.5: must be from 0 to 1"),
        ((run, "--epsilon", "nan"), "--epsilon nan: must be from 0 to 1"),
        ((run, "--networks", "3"), "--networks 3: unknown"),
        ((run, "--every", "5"), "--every: for a run that goes on, --run or --connect"),
        ((run, "--run", "demo"), "not both"),
        ((), "coop-eval RUN_DIR, or coop-eval --run NAME --connect ENDPOINT"),
        (("--run", "demo", "--every", "nan"), "--every nan: must be at least 0"),
        (("--run", "demo", "--every-steps", "0"), "--every-steps 0: must be at least 1"),
        (("--run", "demo", "--every", "5", "--every-steps", "5"), "--every and --every-steps: give one of them"),
        (("--run", "demo", "--epsilon", "0", "0.1"), "one value for a run that goes on"),
        (("--run", "demo", "--seed", "1"), "--seed: for the folder of a run"),
        ((run, "--video", tmp_path / "x.avi"), "must end in .mp4 or .gif"),
        ((run, "--video", tmp_path / "y" / "x.gif"), f"there is no folder {tmp_path}/y"),
    ):
        status, text = printed_by(monkeypatch, capsys, *flags)
        assert status == 2, flags
        assert words in text
        assert text.count("\n") == 1


PICTURES = {
    "MinAtar/Breakout-v1": (240, 240, 3),
    "coop/Catch-v0": (252, 252, 3),
    "pong": (420, 320, 3),
}


@pytest.mark.parametrize("name", PICTURES)
def test_pictures_of_an_episode(name: str) -> None:
    if name.startswith("MinAtar"):
        pytest.importorskip("minatar")
    settings = EnvSettings(id=name, stack=4 if name == "pong" else 1, max_episode_steps=40)
    film = Film(lambda obs: np.array([1]), settings, 0)
    pictures = list(film)
    assert len(pictures) == film.steps
    assert film.over
    assert {picture.shape for picture in pictures} == {PICTURES[name]}
    assert all(picture.dtype == np.uint8 for picture in pictures)
    assert len({picture.tobytes() for picture in pictures}) > 3, "something moves"


class Dear(Catch):
    """Catch with five times the reward."""

    def step(self, action: int | np.int64) -> tuple[NDArray[np.uint8], float, bool, bool, dict[str, Any]]:
        obs, reward, *others = super().step(action)
        return obs, 5 * reward, *others  # type: ignore[return-value]


def test_the_return_of_a_filmed_episode_is_unclipped() -> None:
    gymnasium.register("tests/Dear-v0", entry_point=Dear)
    film = Film(lambda obs: np.array([1]), EnvSettings(id="tests/Dear-v0", clip_rewards=True), 0)
    assert [len(list(film)), abs(film.episode_return)] == [6, 5.0]
    del gymnasium.registry["tests/Dear-v0"]


def test_a_filmed_atari_game_is_the_one_that_is_played() -> None:
    """In shades of grey and reduced to 84 x 84, the pictures are what the network sees."""
    settings = EnvSettings(id="pong", stack=4, repeat_action_probability=0.25)
    env, plain = make_filmed_env(settings, 3), make_vector_env(settings, 1, 3)
    rng, resize = np.random.default_rng(0), make_resizer((210, 160), (84, 84))
    assert np.array_equal(env.reset(), plain.reset())
    for _ in range(60):
        action = rng.integers(env.spec.num_actions, size=1).astype(np.int32)
        steps, same = env.step(action), plain.step(action)
        assert np.array_equal(steps.obs, same.obs)
        assert np.abs(resize(grayscale(env.picture())) - steps.obs[0, -1]).mean() < 1.5
    env.close()
    plain.close()


def test_an_environment_without_pictures() -> None:
    with pytest.raises(UsageError, match=r"video_every: env\.id: 'corridor:test/Corridor-v0' has no pictures to film"):
        check_filmed(EnvSettings(id="corridor:test/Corridor-v0"))
    with pytest.raises(UsageError, match="has no pictures to film"):
        make_filmed_env(EnvSettings(id="corridor:test/Corridor-v0"), 0)


def test_a_gif_of_a_run_s_network(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    config = base_config(["--preset", "catch"])
    run = Lockstep(replace(config, actor=replace(config.actor, num_envs=1), network=NetworkSettings()))
    run.agent.acting = 1
    with RunDirectory(tmp_path / "run", run.config) as directory:
        run.save(directory)
    run.env.close()
    video = tmp_path / "x.gif"
    shown = film_checkpoint(tmp_path / "run", video, 0, (1, 2, "mean"))
    assert shown.startswith(f"{video}: network 2,"), "the one that acts"
    status, text = printed_by(
        monkeypatch, capsys, tmp_path / "run", "--episodes", 1, "--networks", 1, "--epsilon", 0, "--video", video
    )
    assert status == 0
    assert re.match(rf"{video}: network 1, return -?1 in 6 steps\nrun ", text)
    with Image.open(video) as gif:
        assert (gif.n_frames, gif.size, gif.info["duration"]) == (6, (252, 252), 100)
    greedy = video.read_bytes()
    status, text = printed_by(
        monkeypatch, capsys, tmp_path / "run", "--episodes", 1, "--networks", 1, "--epsilon", 1, "--video", video
    )
    assert status == 0
    assert text.startswith(f"{video}: network 1, epsilon 1, return ")
    assert video.read_bytes() != greedy, "from the same start"


def test_a_gif_for_tensorboard_is_cut(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("coop.evaluation.film.LONGEST", 4)
    content = short_gif(Film(lambda obs: np.array([0]), EnvSettings(id="coop/Catch-v0"), 0))
    with Image.open(io.BytesIO(content)) as gif:
        assert gif.n_frames == 4
    monkeypatch.setattr("coop.evaluation.film.MAX_VIDEO", len(content) - 1)
    content = short_gif(Film(lambda obs: np.array([0]), EnvSettings(id="coop/Catch-v0"), 0))
    with Image.open(io.BytesIO(content)) as gif:
        assert gif.n_frames == 2, "half of what would be too large to send"


class Endless(gymnasium.Env[Any, Any]):
    """Pictures that move for ever."""

    closed = False

    def __init__(self) -> None:
        self.observation_space = gymnasium.spaces.Box(0, 255, (20, 20), np.uint8)
        self.action_space = gymnasium.spaces.Discrete(2)
        self._count = 0

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[NDArray[np.uint8], dict[str, Any]]:
        super().reset(seed=seed)
        return self._seen(), {}

    def step(self, action: Any) -> tuple[NDArray[np.uint8], float, bool, bool, dict[str, Any]]:
        return self._seen(), 1.0, False, False, {}

    def _seen(self) -> NDArray[np.uint8]:
        self._count += 1
        return np.full((20, 20), 9 * self._count % 256, np.uint8)

    def close(self) -> None:
        Endless.closed = True


@pytest.mark.parametrize(
    ("bound", "value", "suffix", "pictures"),
    [("MOST", 12, ".mp4", 12), ("MOST", 12, ".gif", 12), ("LONGEST_GIF", 8, ".gif", 8), ("LONGEST_S", 0.7, ".mp4", 7),
     ("LONGEST_S", 0.7, ".gif", 7)],
)  # fmt: skip
def test_a_film_of_an_endless_episode_ends(
    bound: str, value: float, suffix: str, pictures: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ffmpeg = pytest.importorskip("imageio_ffmpeg") if suffix == ".mp4" else None
    monkeypatch.setattr(f"coop.evaluation.film.{bound}", value)
    spec = gymnasium.envs.registration.EnvSpec("tests/Endless-v0", entry_point=Endless)
    monkeypatch.setitem(gymnasium.registry, "tests/Endless-v0", spec)
    film, video = Film(lambda obs: np.array([0]), EnvSettings(id="tests/Endless-v0"), 0), tmp_path / f"x{suffix}"
    Endless.closed = False
    write_video(film, video)
    if ffmpeg is None:
        with Image.open(video) as gif:
            written = gif.n_frames
    else:
        written, _ = ffmpeg.count_frames_and_secs(video)
    assert (written, film.steps, film.over, Endless.closed) == (pictures, pictures, False, True)


@pytest.mark.parametrize("name", ["coop/Catch-v0", "CartPole-v0"])
def test_an_mp4(name: str, tmp_path: Path) -> None:
    ffmpeg = pytest.importorskip("imageio_ffmpeg")
    if name == "CartPole-v0":
        pytest.importorskip("pygame")
    film, video = Film(lambda obs: np.array([0]), EnvSettings(id=name), 0), tmp_path / "x.mp4"
    write_video(film, video)
    frames, seconds = ffmpeg.count_frames_and_secs(video)
    assert frames == film.steps
    assert seconds == pytest.approx(frames / film.pictures_per_s, abs=0.05)
    reader = ffmpeg.read_frames(video)
    about, first = next(reader), next(reader)
    reader.close()
    assert (about["codec"], about["size"]) == ("h264", (600, 400) if name == "CartPole-v0" else (252, 252))
    assert 0.001 < np.mean(np.frombuffer(first, np.uint8) > 128) < 0.999
