"""What environments give is checked wherever they are played; what is beside a training never ends it."""

import copy
import json
import os
import pickle
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from commands import run_command
from gymnasium.spaces import Box, Discrete

import coop
from coop.common.bounds import LONGEST_EPISODE
from coop.common.envs.gymnasium_env import GymnasiumEnv
from coop.common.envs.make import check_filmed, env_spec, make_filmed_env, make_vector_env
from coop.common.envs.protocol import VectorEnv
from coop.common.errors import BadMessage, CoopError, RunError, UsageError
from coop.common.messaging.messages.insert import check_values
from coop.common.process import output
from coop.common.settings.environment import EnvSettings
from coop.common.settings.resuming import check_resumed, settings_digest
from coop.common.settings.tables import identity, load_tables, resolve
from coop.common.types import Array, EnvSpec
from coop.evaluation.film import Film, short_gif

ODD = "test/Odd-v0"
SHORT = {"total_steps": 60, "replay": {"capacity": 50, "learning_starts": 20}, "network": {"hidden": [8]}}
VECTOR = np.zeros(3, np.float32)


class Wordless(Exception):
    """Says nothing of itself."""

    def __str__(self) -> str:
        raise AttributeError("no args")


NO_FLAGS = {"ends nan": float("nan"), "ends half": np.array(0.5)}


class Odd(gymnasium.Env[Any, Any]):
    """Right in all but what it is asked to do wrong, from step 3 on, or in the reset after step 5."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": None}  # noqa: RUF012 (as gymnasium has it)

    def __init__(
        self,
        wrong: str = "",
        dtype: str = "float32",
        shape: tuple[int, ...] = (3,),
        most: float = 255,
        render_mode: Any = None,
    ) -> None:
        self.observation_space = Box(0, most, tuple(shape), np.dtype(dtype).type)
        self.action_space = Discrete(2)
        self.wrong, self.right = wrong, np.zeros(tuple(shape), dtype)
        self.render_mode = render_mode
        if wrong.startswith("metadata "):
            self.metadata = {"metadata list": [1], "metadata text": "x"}.get(wrong, {"render_modes": 5})  # type: ignore
        if wrong == "fps":
            self.metadata = {**self.metadata, "render_fps": 0}
        self.t, self.resets = 0, 0
        self.actions: set[type] = set()

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        self.t, self.resets = 0, self.resets + 1
        late = self.resets > 1 and self.wrong.startswith("reset ")
        if late and self.wrong == "reset raises":
            raise ConnectionError("the simulator\nis gone")
        return (np.zeros(7, np.float32) if late else self.right), {}

    def step(self, action: Any) -> Any:
        self.t += 1
        assert isinstance(action, np.int64)
        given: list[Any] = [self.right, 1.0, self.t >= 5, False, {}]
        wrong = self.wrong if self.t >= 3 else ""
        observations = {
            "shape": np.zeros(1), "nan": np.full(3, np.nan), "large": np.full(3, 2e6), "ragged": [[1], [1, 2]],
            "scaled": self.right + 0.5, "wide": np.full(self.right.shape, 256, np.uint16), "words": np.array(["a"] * 3),
            "masked": np.ma.masked_equal([0, 1, 2], 1),
        }  # fmt: skip
        rewards = {"reward [1]": np.ones(1), "reward list": [1.0], "reward None": None, "reward text": "1.0",
                   "reward nan": float("nan"), "reward inf": np.float32("inf"), "reward large": 1.1e6,
                   "reward masked": np.ma.masked}  # fmt: skip
        if wrong == "step raises":
            raise ValueError("no such move")
        if wrong == "step raises in its words too":
            raise Wordless
        if wrong == "step exits":
            sys.exit(0)
        if wrong == "four":
            return self.right, 1.0, False, {}
        if wrong == "ends":
            given[2] = np.array([True, False])
        if wrong in NO_FLAGS:
            given[2] = NO_FLAGS[wrong]
        given[0] = observations.get(wrong, self.right)
        given[1] = rewards.get(wrong, 1.0)
        if self.wrong == "endless":
            given[2] = False
        return tuple(given)

    def render(self) -> Any:
        others = {"grey": np.zeros((20, 30), np.uint8), "no picture": None, "a picture of text": np.full((3, 3), "x")}
        return others.get(self.wrong, np.zeros((20, 30, 3), np.uint8))

    def close(self) -> None:
        if self.wrong == "close raises":
            raise OSError("already closed")


class Old(Odd):
    """As gym's environments were before version 0.26."""

    def reset(self) -> Any:  # type: ignore[override]
        return VECTOR


class Bare(gymnasium.Env[Any, Any]):
    """Has no spaces."""


gymnasium.register(ODD, entry_point=Odd)
gymnasium.register("test/Old-v0", entry_point=Old)
gymnasium.register("test/Bare-v0", entry_point=Bare)


def odd(wrong: str, **kwargs: Any) -> EnvSettings:
    return EnvSettings(id=ODD, kwargs={"wrong": wrong, **kwargs})


def inner(env: VectorEnv) -> Any:
    """The environment of the first emulator."""
    assert isinstance(env, GymnasiumEnv)
    return env._envs[0]._env.unwrapped


def stepped(env: VectorEnv, times: int) -> None:
    for _ in range(times):
        env.step(np.zeros(env.num_envs, np.int32))


AT_3 = "at step 3 gives"
WRONG: list[tuple[str, dict[str, Any], type[CoopError], str]] = [
    ("shape", {}, UsageError, rf"{AT_3} observations float64\[1\]; its observation space says float32\[3\]"),
    ("nan", {}, UsageError, rf"{AT_3} observations with values from nan to nan; allowed: finite"),
    ("large", {}, UsageError, rf"{AT_3} observations with values from 2e\+06 to 2e\+06; .* 1,000,000"),
    ("ragged", {}, UsageError, rf"{AT_3} the observation \[\[1\], \[1, 2\]\]"),
    ("masked", {}, UsageError, rf"{AT_3} the observation with masked entries; allowed: an array without any"),
    ("reward masked", {}, UsageError, rf"{AT_3} reward float64\[\]; allowed: a single number"),
    ("words", {}, UsageError, rf"{AT_3} observations <U1\[3\]"),
    ("scaled", {"dtype": "uint8"}, UsageError, rf"{AT_3} observations float64\[3\]; its .* says uint8\[3\]"),
    ("wide", {"dtype": "uint8"}, UsageError, rf"{AT_3} observations with values to 256; its .* says uint8"),
    ("reward [1]", {}, UsageError, rf"{AT_3} reward float64\[1\]; allowed: a single number"),
    ("reward list", {}, UsageError, rf"{AT_3} reward \[1\.0\]"),
    ("reward None", {}, UsageError, rf"{AT_3} reward None"),
    ("reward text", {}, UsageError, rf"{AT_3} reward '1\.0'"),
    ("reward nan", {}, UsageError, rf"{AT_3} the reward nan; allowed: finite"),
    ("reward inf", {}, UsageError, rf"{AT_3} the reward inf"),
    ("reward large", {}, UsageError, rf"{AT_3} the reward 1\.1e\+06; allowed: .* to 1,000,000"),
    ("ends", {}, UsageError, rf"{AT_3} terminated bool\[2\]; allowed: a single bool"),
    ("ends nan", {}, UsageError, rf"{AT_3} terminated nan; allowed: a single bool"),
    ("ends half", {}, UsageError, rf"{AT_3} terminated float64\[\]; allowed: a single bool"),
    ("four", {}, UsageError, rf"{AT_3} 4 values; gymnasium's step gives \(observation, reward,"),
    ("step raises", {}, RunError, r"at step 3 raised ValueError: no such move \(test_environment_promises.py:\d+\)$"),
    ("step raises in its words too", {}, RunError, r"at step 3 raised Wordless \(test_environment_promises.py:\d+\)$"),
    ("step exits", {}, RunError, r"at step 3 raised SystemExit: 0"),
    ("reset raises", {}, RunError, r"at the reset after step 5 raised ConnectionError: the simulator is gone"),
    ("reset gives", {}, UsageError, r"at the reset after step 5 gives observations float32\[7\]"),
]


@pytest.mark.parametrize(("wrong", "kwargs", "kind", "words"), WRONG)
def test_a_step_or_reset_that_is_not_as_promised_is_named(
    wrong: str, kwargs: dict[str, Any], kind: type[CoopError], words: str
) -> None:
    env = make_vector_env(odd(wrong, **kwargs), 1, 0)
    env.reset()
    with pytest.raises(kind, match=f"^env.id: '{ODD}' {words}") as failed:
        stepped(env, 6)
    assert "\n" not in str(failed.value)
    env.close()


def test_one_of_several_emulators_is_named() -> None:
    env = make_vector_env(odd("nan"), 3, 0)
    env.reset()
    inner(env).wrong = ""
    with pytest.raises(UsageError, match="at step 3 of emulator 1 gives"):
        stepped(env, 3)


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        (EnvSettings(id="test/Bare-v0"), "has no observation_space and action_space"),
        (odd("", shape=[0]), "there are no values in it"),
        (odd("", shape=[4, 0, 3]), "there are no values in it"),
        (EnvSettings(id="ALE/Breakout-v9"), "unknown environment .*ALE's ids have version 5: ALE/Breakout-v5"),
        (EnvSettings(id="ALE/Pong-v4"), "ALE/Pong-v5"),
        (
            odd("", dtype="uint8", shape=[3, 20, 24]),
            r"'test/Odd-v0' has observations \[3, 20, 24\], pictures with .*\[20, 24, 3\], as .*TransformObservation",
        ),
        (EnvSettings(id="BreakoutNoFrameskip-v4"), "ALE's game is 'breakout' here"),
        (EnvSettings(id="SpaceInvaders-v0"), "ALE's game is 'space_invaders' here"),
    ],
)
def test_what_can_not_be_played_is_refused_before_it_is(settings: EnvSettings, words: str) -> None:
    with pytest.raises(UsageError, match=words) as refused:
        env_spec(settings)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("limit", [7.5, "7", -1, 0, True, float("inf")])
def test_a_registered_limit_that_is_none_is_refused(limit: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    def registered(limit: Any) -> None:
        spec = gymnasium.envs.registration.EnvSpec("test/Limited-v0", entry_point=Odd, max_episode_steps=limit)
        monkeypatch.setitem(gymnasium.registry, spec.id, spec)

    settings = EnvSettings(id="test/Limited-v0", kwargs={"wrong": "endless"})
    registered(limit)
    words = f"^env.id: .* is registered with max_episode_steps = {limit!r}; allowed: whole numbers from 1 on"
    with pytest.raises(UsageError, match=words):
        env_spec(settings)
    for right in (7, 7.0, np.int64(7)):
        registered(right)
        env = make_vector_env(settings, 1, 0)
        env.reset()
        assert [env.step(np.zeros(1, np.int32)).episode_over[0] for _ in range(7)] == [False] * 6 + [True]
        env.close()


def test_the_interface_of_old_environments_is_named() -> None:
    env = make_vector_env(EnvSettings(id="test/Old-v0"), 1, 0)
    with pytest.raises(
        UsageError, match=r"at the first reset raised TypeError: .*'seed'; gymnasium's reset takes seed"
    ):
        env.reset()


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        (odd("", dtype="uint8", shape=[4, 4], most=1), "uint8 observations of only 0 and 1"),
        (EnvSettings(id="ALE/Breakout-v5"), "sticky actions"),
    ],
)
def test_what_is_probably_meant_otherwise_is_warned_of_once(
    settings: EnvSettings, words: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(output, "_warned", set())
    env_spec(settings)
    env_spec(settings)
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("warning: env.id: ")
    assert words in line
    env_spec(
        replace(settings, repeat_action_probability=0.25)
        if settings.atari
        else odd("", dtype="bool", shape=[9, 9], most=1)
    )
    assert not capsys.readouterr().err


def test_uint8_that_holds_truth_values_is_noticed_from_the_observations(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(output, "_warned", set())
    env = make_vector_env(odd("", dtype="uint8"), 1, 0)
    inner(env).right[1] = 1
    env.reset()
    stepped(env, 60)
    assert not capsys.readouterr().err
    stepped(env, 60)
    assert capsys.readouterr().err.count("of only 0 and 1") == 1


def test_what_is_right_passes_in_other_types_of_numbers() -> None:
    env = make_vector_env(odd(""), 1, 0)
    env.reset()
    for reward in (2, np.float64(2), np.int32(2), np.array(2.0), True):
        inner(env).step = lambda action, reward=reward: ([0, 1, 2], reward, np.bool_(False), 0, {})
        steps = env.step(np.zeros(1, np.int32))
        assert (steps.raw_rewards[0], steps.obs[0].tolist()) == (float(reward), [0, 1, 2])


def test_rewards_have_one_bound_in_every_kind_of_run() -> None:
    """An n-step transition carries the sum of rewards each of which is within the bound."""
    arrays: dict[str, Array] = {
        "frames": np.zeros((2, 3), np.float32),
        "obs_index": np.zeros((1, 1), np.int32),
        "next_index": np.ones((1, 1), np.int32),
        "actions": np.zeros(1, np.int32),
        "rewards": np.array([2.9e6], np.float32),
        "terminated": np.zeros(1, bool),
        "param_version": np.zeros(1, np.int64),
        "span": np.array([3], np.uint8),
    }
    spec = EnvSpec("x", (3,), "float32", 1, 2)
    check_values(spec, arrays)
    with pytest.raises(BadMessage, match=r"arrays\.rewards"):
        check_values(spec, {**arrays, "span": np.array([2], np.uint8)})


def test_a_run_in_python_fails_as_documented_and_says_so_in_its_summary(tmp_path: Path) -> None:
    run = coop.train(run_dir=tmp_path / "a", env={"id": ODD, "kwargs": {"wrong": "reward None"}}, **SHORT)
    with pytest.raises(coop.RunError, match="at step 3 gives reward None"):
        run.wait()


def test_evaluation_and_films_go_through_the_same_check() -> None:
    with pytest.raises(UsageError, match="at step 3 gives the reward nan"):
        coop.evaluate(lambda obs: 0, env={"id": ODD, "kwargs": {"wrong": "reward nan"}})
    with pytest.raises(UsageError, match="at step 3 gives observations float64"):
        short_gif(Film(lambda obs: 0, odd("shape"), 0))


def test_an_episode_without_end_is_cut_and_the_setting_named(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(output, "_warned", set())
    result = coop.evaluate(lambda obs: [0, 0], 2, {"id": ODD, "kwargs": {"wrong": "endless"}}, at_once=2)
    assert result.returns == [LONGEST_EPISODE] * 2
    assert capsys.readouterr().err.count("env.max_episode_steps") == 1
    assert coop.evaluate(
        lambda obs: 0, 1, {"id": ODD, "kwargs": {"wrong": "endless"}, "max_episode_steps": 7}
    ).returns == [7]
    assert not capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"episodes": 0}, "episodes = 0: must be a whole number from 1"),
        ({"episodes": 2.5}, "episodes = 2.5"),
        ({"episodes": True}, "episodes = True"),
        ({"episodes": 2**40}, "episodes = 1099511627776: must be a whole number from 1 to"),
        ({"seed": -1}, "seed = -1: must be a whole number from 0"),
        ({"seed": "1"}, "seed = '1'"),
        ({"at_once": 0}, "at_once = 0"),
        ({"epsilon": 1.5}, r"epsilon = 1\.5: must be from 0 to 1"),
        ({"epsilon": float("nan")}, "epsilon = nan"),
        ({"epsilon": True}, "epsilon = True: must be from 0 to 1"),
        ({"env": None}, "env: a policy that no run has trained needs one"),
        ({"env": 7}, "env = 7: must be an id, or a table"),
        ({"policy": "greedy"}, "policy: str is no function"),
        ({"policy": lambda obs: 2}, r"policy: gives 2 .*allowed: an int from 0 to 1"),
        ({"policy": lambda obs: -1}, "policy: gives -1 "),
        ({"policy": lambda obs: 0.7}, r"policy: gives 0\.7"),
        ({"policy": lambda obs: None}, "policy: gives None"),
        ({"policy": lambda obs: [0, 1]}, r"policy: gives int64\[2\] for 1 of"),
    ],
)
def test_the_arguments_of_an_evaluation_are_checked(arguments: dict[str, Any], words: str) -> None:
    given: dict[str, Any] = {"policy": lambda obs: 0, "env": "CartPole-v0", "episodes": 1, **arguments}
    with pytest.raises(UsageError, match=words):
        coop.evaluate(**given)


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> coop.SavedRun:
    """A short run on pictures."""
    path = tmp_path_factory.mktemp("runs") / "catch"
    settings: Any = {**SHORT, "network": {"kind": "mlp", "hidden": [8]}, "actor": {"num_envs": 1}}
    coop.train("catch", run_dir=path, env={"stack": 1}, **settings).wait()
    return coop.load(path)


def test_policies_pickle_and_copy(trained: coop.SavedRun) -> None:
    policy = trained.policy()
    obs = np.random.default_rng(0).integers(0, 256, (5, 84, 84), np.uint8)
    for other in (pickle.loads(pickle.dumps(policy)), copy.deepcopy(policy)):  # noqa: S301 (its own)
        np.testing.assert_array_equal(other.q_values(obs), policy.q_values(obs))
        other.networks[0].flat.zero_()
        assert not np.array_equal(other.q_values(obs), policy.q_values(obs)), "its functions have other parameters"


def test_policies_refuse_what_they_would_cast(trained: coop.SavedRun) -> None:
    policy, picture = trained.policy(), np.full((84, 84), 9, np.uint8)
    np.testing.assert_array_equal(policy.q_values(picture.tolist()), policy.q_values(picture))
    for given in (picture / 255, picture + np.int64(250), -picture.astype(np.int64)):
        with pytest.raises(UsageError, match=r"observation of dtype (float64|int64): coop/Catch-v0 has uint8"):
            policy.q_values(given)


def test_a_run_may_move_to_another_machine_s_device(tmp_path: Path) -> None:
    here = resolve(load_tables("cartpole", None))
    there = replace(here, learner=replace(here.learner, device="cuda", threads=8, mirror="off"))
    assert identity(here) == identity(there)
    assert settings_digest(here) == settings_digest(replace(there, total_steps=10**6)), "its checkpoints are the run's"
    assert settings_digest(here) != settings_digest(replace(here, learner=replace(here.learner, gamma=0.5)))
    check_resumed(here, there, tmp_path / "config.toml")
    with pytest.raises(UsageError, match=r"learner\.gamma"):
        check_resumed(here, replace(there, learner=replace(there.learner, gamma=0.5)), tmp_path / "config.toml")


@pytest.mark.parametrize("method", ["coop", "stream-q"])
def test_an_environment_that_has_changed_since_a_run_is_not_played_by_its_networks(
    method: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def registered(**changed: Any) -> None:
        kwargs = {"dtype": "uint8", "shape": (3,), **changed}
        spec = gymnasium.envs.registration.EnvSpec("test/Changing-v0", entry_point=Odd, kwargs=kwargs)
        monkeypatch.setitem(gymnasium.registry, spec.id, spec)

    registered()
    settings = {name: value for name, value in SHORT.items() if name != "replay" or method == "coop"}
    coop.train(method=method, run_dir=tmp_path, env={"id": "test/Changing-v0"}, **settings).wait()
    run = coop.load(tmp_path)
    assert run.policy().spec.frame_dtype == "uint8"
    for changed, words in (
        ({"dtype": "float32"}, "frame_dtype is float32, and was uint8"),
        ({"shape": (5,)}, r"frame_shape is .5,?., and was .3,?."),
    ):
        registered(**changed)
        for refused in (run.policy, lambda: coop.train(run_dir=tmp_path, resume=True, total_steps=80)):
            with pytest.raises(UsageError, match=f"^env.id: 'test/Changing-v0' has changed since .*: {words}$"):
                refused()
    registered()
    coop.train(run_dir=tmp_path, resume=True, total_steps=80).wait()


@pytest.mark.parametrize("wrong", ["grey", "fps", ""])
def test_films_of_any_speed_and_of_grey_pictures(wrong: str) -> None:
    gif = short_gif(Film(lambda obs: 0, odd(wrong), 0))
    assert gif.startswith(b"GIF89a")


@pytest.mark.parametrize("wrong", ["metadata list", "metadata text", "metadata five"])
def test_metadata_that_are_none_have_no_pictures(wrong: str) -> None:
    with pytest.raises(UsageError, match=r"^video_every: env.id: .* has no pictures to film: its metadata"):
        check_filmed(odd(wrong))
    assert make_filmed_env(odd(wrong, dtype="uint8", shape=(20, 30)), 0).pictures_per_s == 10


def test_a_film_of_no_picture_is_refused_and_one_that_stands_still_is_not_too_long() -> None:
    for wrong, found in (("no picture", "object"), ("a picture of text", r"<U1\[3, 3\]")):
        env = make_filmed_env(odd(wrong), 0)
        env.reset()
        with pytest.raises(UsageError, match=f"can't be filmed: it renders {found}"):
            env.picture()
    still = Film(lambda obs: 0, replace(odd("endless"), max_episode_steps=800), 0)
    still.pictures_per_s = 0.5  # 1,600 s of the same picture: a GIF's longest is 655
    assert short_gif(still).startswith(b"GIF89a")


def test_what_is_beside_a_training_does_not_end_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Evaluations, films, the learning curve and the closing of environments may all fail."""

    class Later(Odd):
        made = 0

        def __init__(self, render_mode: Any = None) -> None:
            super().__init__(render_mode=render_mode)
            Later.made += 1
            self.number = Later.made

        def step(self, action: Any) -> Any:
            if self.number > 3:  # of the check, of the film's, of the training; the others evaluate and film
                raise RuntimeError("one licence only")
            return super().step(action)

        def close(self) -> None:
            raise OSError("already closed")

    gymnasium.register("test/Later-v0", entry_point=Later)
    monkeypatch.setenv("MPLCONFIGDIR", str(tmp_path))
    monkeypatch.setattr("coop.records.run_directory.draw_learning_curve", lambda *_: 1 / 0)
    run = coop.train(run_dir=tmp_path / "a", env={"id": "test/Later-v0"}, eval_every=20, video_every=30, **SHORT)
    summary = run.wait()
    assert summary is not None
    assert summary["exit"] == "complete"
    out, err = capsys.readouterr()
    assert "no evaluation after 20 steps: env.id: 'test/Later-v0' at step 1 of emulator 0 raised RuntimeError" in out
    assert "no video after 30 steps" in out
    assert "no learning curve: ZeroDivisionError" in out
    assert "raised OSError: already closed" in err


def test_a_command_tells_of_a_wrong_environment_in_one_line_and_of_threads_that_stay(tmp_path: Path) -> None:
    (tmp_path / "promises.py").write_text(
        "import sys, threading, time\n"
        f"sys.path.append({str(Path(__file__).parent)!r})\n"
        "import gymnasium\nfrom test_environment_promises import Odd\n"
        "class Threaded(Odd):\n"
        "    def __init__(self, **kwargs):\n"
        "        super().__init__(**kwargs)\n"
        "        threading.Thread(target=time.sleep, args=(300,), name='viewer').start()\n"
        "gymnasium.register('Odd-v0', entry_point=Odd)\n"
        "gymnasium.register('Threaded-v0', entry_point=Threaded)\n"
    )
    flags = ["--total-steps=60", "--replay.capacity=50", "--replay.learning-starts=20", "--network.hidden=8"]
    began = time.monotonic()
    done = run_command("coop-lockstep", *flags, "--env.id=promises:Threaded-v0", "--run-dir=a", cwd=tmp_path)
    assert done.returncode == 0
    assert "the thread 'viewer' has not ended" in done.stderr
    assert json.loads((tmp_path / "a" / "summary.json").read_text())["exit"] == "complete"
    assert time.monotonic() - began < 100
    wrong = "--env.kwargs={wrong = 'four'}"
    done = run_command("coop-lockstep", *flags, "--env.id=promises:Odd-v0", wrong, "--run-dir=b", cwd=tmp_path)
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()
    assert line.startswith("coop-lockstep: error: env.id: 'promises:Odd-v0' at step 3 gives 4 values")


def test_paths_and_files_as_users_write_them(tmp_path: Path) -> None:
    (tmp_path / "marked.toml").write_bytes("\ufeffseed = 7\n".encode())
    assert resolve(load_tables(None, tmp_path / "marked.toml")).seed == 7
    for command, flag in (
        ("coop-lockstep", "--run-dir"),
        ("coop-replay", "--run-dir"),
        ("coop-watch", "--zenoh-config"),
    ):
        done = run_command(command, flag, "", cwd=tmp_path)
        assert done.returncode == 2
        assert done.stderr == f"{command}: error: {flag}: an empty value; allowed: PATH, or None\n"
    flags = ["--total-steps=60", "--replay.capacity=50", "--replay.learning-starts=20", "--network.hidden=8"]
    home = {**os.environ, "HOME": str(tmp_path / "home")}
    run_command("coop-lockstep", *flags, "--run-dir=~/x", cwd=tmp_path, environment=home, check=True)
    run_command("coop-lockstep", "--resume", "--total-steps=70", "--run-dir", "~/x", environment=home, check=True)
    assert json.loads((tmp_path / "home" / "x" / "summary.json").read_text())["env_steps"] == 70


@pytest.mark.skipif(os.geteuid() != 0, reason="a network without loopback needs root")
def test_a_machine_without_loopback_is_told_at_once(tmp_path: Path) -> None:
    command = [str(Path(sys.executable).parent / "coop-local"), "--run-dir", "a"]
    done = subprocess.run(
        ["unshare", "-n", *command], check=False, cwd=tmp_path, capture_output=True, text=True, timeout=100
    )
    assert done.returncode == 1
    assert "loopback interface can't be used" in done.stderr.splitlines()[-1]
    assert not (tmp_path / "a").exists()
