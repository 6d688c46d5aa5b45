"""Gymnasium's vector environments give the same transitions as single ones, in each of the autoreset modes."""

from contextlib import closing
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from gates import mask_of
from gymnasium.spaces import Box, Discrete
from gymnasium.vector import AutoresetMode, SyncVectorEnv, VectorEnv

import coop
from coop.common.envs.make import env_spec, make_vector_env
from coop.common.envs.protocol import Steps
from coop.common.errors import RunError, UsageError
from coop.common.networks.masks import random_actions
from coop.common.settings.environment import EnvSettings
from coop.common.settings.tables import resolve

MODES = list(AutoresetMode)


class Drift(gymnasium.Env[Any, Any]):
    """Chance decides all but the last action, which is shown; episodes end in both ways."""

    def __init__(self) -> None:
        self.observation_space = Box(-9, 9, (3,), np.float32)
        self.action_space = Discrete(3, start=1)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        return self._seen(0), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        terminated, truncated = (self.np_random.random(2) < 0.1).tolist()
        return self._seen(action), float(self.np_random.normal()), terminated, truncated, {}

    def _seen(self, action: Any) -> Any:
        return np.array([*self.np_random.random(2), action], np.float32)


class Own(VectorEnv[Any, Any, Any]):
    """A vector environment that is none of gymnasium's, and takes a reset mask only where its mode needs one.

    limit: of the episodes. lacks: what its steps leave out.
    """

    def __init__(self, num_envs: int, mode: AutoresetMode, max_episode_steps: Any = None, lacks: str = "") -> None:
        def make() -> gymnasium.Env[Any, Any]:
            env = Drift()
            return env if max_episode_steps is None else gymnasium.wrappers.TimeLimit(env, max_episode_steps)

        self._inner = SyncVectorEnv([make] * num_envs, autoreset_mode=mode)
        self._mode, self._lacks = mode, lacks
        self.num_envs, self.metadata = num_envs, {"autoreset_mode": mode}
        self.single_observation_space, self.single_action_space = Drift().observation_space, Drift().action_space
        if lacks == "mode":
            self.metadata = {}

    def reset(self, *, seed: Any = None, options: Any = None) -> Any:
        assert self._mode == AutoresetMode.DISABLED or not options
        if self._lacks == "seeds" and isinstance(seed, list):
            raise TypeError("one seed is needed")
        begun = self._inner.reset(seed=seed, options=options)
        return begun[0] if self._lacks == "reset's info" else begun

    def step(self, actions: Any) -> Any:
        *others, infos = self._inner.step(actions)
        if self._lacks == "step's info":
            return tuple(others)
        infos.pop(self._lacks, None)
        wrong = {
            "a reward for all": (1, 1.0),
            "rewards of one": (1, np.ones(1)),
            "observations of one": (0, others[0][:1]),
        }
        if self._lacks in wrong:
            at, value = wrong[self._lacks]
            others[at] = value
        return *others, None if self._lacks == "info" else infos


gymnasium.register("test/Drift-v0", entry_point=Drift)
for number, each in enumerate(MODES):
    gymnasium.register(f"test/Own-v{number}", vector_entry_point=Own, kwargs={"mode": each})


def played(settings: EnvSettings, envs: int = 3, steps: int = 60) -> list[Steps]:
    """The first observations, as those of a step, and what follows random actions."""
    env, rng = make_vector_env(settings, envs, 4), np.random.default_rng(2)
    assert env.spec == env_spec(settings)
    obs = env.reset()
    none = np.zeros(0)
    found = [Steps(obs, obs, none, none, none, none, none, env.mask, env.mask)]  # type: ignore[arg-type]
    for _ in range(steps):
        actions = random_actions(rng, envs, env.spec.num_actions, env.mask)
        found.append(env.step(actions))
    again = env.reset()
    np.testing.assert_array_equal(again, obs, "from the same seeds")
    env.close()
    return found


def assert_same(found: list[Steps], expected: list[Steps], ends: int) -> None:
    """Equal to the bit, with at least so many ends of each kind."""
    for one, other in zip(found, expected, strict=True):
        for name in Steps.__slots__:
            np.testing.assert_array_equal(getattr(one, name), getattr(other, name), name)
    over = sum(int(steps.episode_over.sum()) for steps in expected[1:])
    terminated = sum(int(steps.terminated.sum()) for steps in expected[1:])
    assert terminated >= ends
    assert over - terminated >= ends


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize(("stack", "limit"), [(1, 0), (2, 0), (1, 6)])
@pytest.mark.parametrize("envs", [1, 3])
def test_gymnasium_s_vector_environments(mode: AutoresetMode, stack: int, limit: int, envs: int) -> None:
    plain = EnvSettings(id="test/Drift-v0", stack=stack, max_episode_steps=limit)
    kwargs = {"vector_kwargs": {"autoreset_mode": mode.value}}
    vector = EnvSettings(
        id="test/Drift-v0", stack=stack, max_episode_steps=limit, kwargs=kwargs, vectorization_mode="sync"
    )
    assert_same(played(vector, envs), played(plain, envs), ends=1)


@pytest.mark.parametrize("number", range(len(MODES)))
@pytest.mark.parametrize("limit", [0, 6])
@pytest.mark.parametrize("envs", [1, 3])
def test_vector_environments_of_one_s_own(number: int, limit: int, envs: int) -> None:
    """Found without a setting, as there is no other entry point."""
    found = played(EnvSettings(id=f"test/Own-v{number}", max_episode_steps=limit), envs)
    assert_same(found, played(EnvSettings(id="test/Drift-v0", max_episode_steps=limit), envs), ends=1)


def test_processes_of_gymnasium_s() -> None:
    found = played(EnvSettings(id="gates:Gates-v0", vectorization_mode="async"), 2, 20)
    assert_same(found, played(EnvSettings(id="gates:Gates-v0"), 2, 20), ends=0)


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("env_id", ["gates:Gates-v0", "gates:GatesByMethod-v0"])
def test_action_masks_of_vector_environments(mode: AutoresetMode, env_id: str) -> None:
    kwargs = {"vector_kwargs": {"autoreset_mode": mode.value}}
    vector = EnvSettings(id=env_id, kwargs=kwargs, vectorization_mode="sync", max_episode_steps=4)
    if "Method" in env_id and mode == AutoresetMode.SAME_STEP:
        with pytest.raises(UsageError, match="has action masks by a method; mode SAME_STEP"):
            played(vector)
        return
    found = played(vector)
    assert_same(found, played(EnvSettings(id=env_id, max_episode_steps=4)), ends=1)
    np.testing.assert_array_equal(found[1].mask, mask_of(found[0].obs))


def test_a_run_is_the_same_to_the_byte(tmp_path: Path) -> None:
    config: dict[str, Any] = {
        "total_steps": 120, "replay": {"capacity": 50, "learning_starts": 20}, "network": {"hidden": [8]},
    }  # fmt: skip
    for name, mode in (("a", None), ("b", "sync")):
        env = {"id": "test/Drift-v0", "vectorization_mode": mode}
        coop.train(run_dir=tmp_path / name, method="dqn", env=env, **config).wait()
    one, other = ((tmp_path / name / "episodes.csv").read_bytes() for name in "ab")
    assert one == other
    assert one.count(b"\n") > 9


def test_what_does_not_fit_is_refused_in_a_line() -> None:
    with pytest.raises(UsageError, match=r"env\.vectorization_mode = 'sync': not for 'breakout'"):
        resolve({"env": {"id": "breakout", "vectorization_mode": "sync"}})
    with pytest.raises(UsageError, match=r"env\.vectorization_mode"):
        resolve({"env": {"vectorization_mode": "fast"}})
    same = MODES.index(AutoresetMode.SAME_STEP)
    with pytest.raises(RunError, match=r'raised LookupError: info\["final_obs"\], which mode SAME_STEP gives'):
        played(EnvSettings(id=f"test/Own-v{same}", kwargs={"lacks": "final_obs"}))
    with (
        pytest.warns(UserWarning, match="missing AutoresetMode"),
        pytest.raises(UsageError, match=r'has metadata\["autoreset_mode"\] = None; allowed: one of gymnasium.vector'),
    ):
        env_spec(EnvSettings(id="test/Own-v0", kwargs={"lacks": "mode"}))


@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
def test_one_that_takes_one_seed_for_all(mode: AutoresetMode) -> None:
    played(EnvSettings(id=f"test/Own-v{MODES.index(mode)}", kwargs={"lacks": "seeds"}), steps=5)


@pytest.mark.parametrize(
    ("lacks", "words"),
    [
        (
            "a reward for all",
            "at step 1 of emulator 0 raised LookupError: rewards of each of 3 emulators; it gives float",
        ),
        ("rewards of one", "at step 1 of emulator 0 raised LookupError: rewards of each of 3 emulators; it gives 1"),
        ("observations of one", "raised LookupError: observations of each of 3 emulators; it gives 1"),
        ("info", r'raised LookupError: info\["final_obs"\], which mode SAME_STEP gives'),
    ],
)
def test_values_that_are_not_one_for_each_emulator_are_named(lacks: str, words: str) -> None:
    same = MODES.index(AutoresetMode.SAME_STEP)
    with pytest.raises(RunError, match=words):
        played(EnvSettings(id=f"test/Own-v{same}", kwargs={"lacks": lacks}))


@pytest.mark.parametrize(
    ("lacks", "words"),
    [
        ("reset's info", r"at the first reset of emulator 0 gives float32\[3, 3\]; gymnasium's reset"),
        ("step's info", "at step 1 of emulator 0 gives 4 values; gymnasium's step"),
    ],
)
def test_answers_that_are_none_of_gymnasium_s_are_named(lacks: str, words: str) -> None:
    with pytest.raises(UsageError, match=words):
        played(EnvSettings(id="test/Own-v1", kwargs={"lacks": lacks}))


def test_an_episode_is_cut_only_where_one_emulator_can_be_restarted_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("coop.common.envs.gymnasium_env.LONGEST_EPISODE", 3)
    env = make_vector_env(EnvSettings(id=f"test/Own-v{MODES.index(AutoresetMode.SAME_STEP)}"), 2, 4, bounded=True)
    with closing(env):
        env.reset()
        for _ in range(2):
            env.step(np.zeros(2, np.int32))
        with pytest.raises(RunError, match="no limit of episodes but its own, as SAME_STEP restarts no emulator alone"):
            env.step(np.zeros(2, np.int32))
