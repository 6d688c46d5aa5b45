"""Environments say exactly how steps end, repeat for a seed, and refuse in words what does not fit."""

import subprocess
import sys
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

from coop.common.envs import catch
from coop.common.envs.catch import Catch
from coop.common.envs.make import env_spec, make_vector_env
from coop.common.envs.protocol import Steps
from coop.common.errors import UsageError
from coop.common.settings.environment import EnvSettings
from coop.common.settings.tables import load_tables, resolve
from coop.common.types import Array, EnvSpec


def played(config: EnvSettings, num_envs: int, actions: Any, seed: int = 0) -> tuple[Array, list[Steps]]:
    env = make_vector_env(config, num_envs, seed)
    first = env.reset()
    steps = [env.step(np.asarray(row, np.int32)) for row in actions]
    env.close()
    return first, steps


def random_actions(num_actions: int, steps: int, num_envs: int) -> Array:
    return np.random.default_rng(1).integers(0, num_actions, (steps, num_envs))


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({"id": "CartPole-v0"}, EnvSpec("CartPole-v0", (4,), "float32", 1, 2)),
        ({"id": "CartPole-v0", "stack": 3}, EnvSpec("CartPole-v0", (4,), "float32", 3, 2)),
        ({"id": "coop/Catch-v0", "stack": 4}, EnvSpec("coop/Catch-v0", (84, 84), "uint8", 4, 3)),
        ({"id": "coop/Catch-v0"}, EnvSpec("coop/Catch-v0", (84, 84), "uint8", 1, 3)),
        ({"id": "breakout", "stack": 4}, EnvSpec("breakout", (84, 84), "uint8", 4, 4)),
        ({"id": "space-invaders", "stack": 4}, EnvSpec("space-invaders", (84, 84), "uint8", 4, 6)),
        ({"id": "ALE/SpaceInvaders-v5", "stack": 2}, EnvSpec("ALE/SpaceInvaders-v5", (84, 84), "uint8", 2, 6)),
        ({"id": "pong", "full_action_space": True}, EnvSpec("pong", (84, 84), "uint8", 1, 18)),
    ],
)
def test_specification_fits_what_the_emulators_return(options: dict[str, Any], expected: EnvSpec) -> None:
    config = EnvSettings(**options)
    assert env_spec(config) == expected
    env = make_vector_env(config, 2, 0)
    assert (env.spec, env.num_envs) == (expected, 2)
    obs = env.reset()
    step = env.step(np.zeros(2, np.int32))
    env.close()
    for array in (obs, step.obs, step.next_obs):
        assert (array.shape, array.dtype) == ((2, *expected.obs_shape), expected.frame_dtype)
    dtypes = (step.rewards.dtype, step.raw_rewards.dtype, step.terminated.dtype, step.restarted.dtype)
    assert dtypes == (np.float32, np.float64, np.bool_, np.bool_)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"id": "brekout"}, ["unknown game 'brekout'", "breakout"]),
        ({"id": "ALE/Pongg-v5"}, ["unknown game 'Pongg'", "pong"]),
        ({"id": "CartPol-v1"}, ["unknown environment 'CartPol-v1'", "CartPole-v1"]),
        ({"id": "Pendulum-v1"}, ["action space Box", "allowed is Discrete"]),
        ({"id": "Blackjack-v1"}, ["observation space Tuple", "allowed is a Box of one dimension, or of pictures"]),
    ],
)
def test_what_does_not_fit_is_refused_in_words(options: dict[str, Any], words: list[str]) -> None:
    for make in (env_spec, lambda config: make_vector_env(config, 1, 0)):
        with pytest.raises(UsageError) as refusal:
            make(EnvSettings(**options))
        assert all(word in str(refusal.value) for word in words), str(refusal.value)


def test_no_emulators_are_refused() -> None:
    with pytest.raises(UsageError, match="envs: 0"):
        make_vector_env(EnvSettings(), 0, 0)


def test_missing_rom_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ALE_ROMS_DIR", str(tmp_path))
    with pytest.raises(UsageError, match=r"ROM of 'pong'.*pong\.bin"):
        env_spec(EnvSettings(id="pong"))


@pytest.mark.parametrize("env_id", ["CartPole-v0", "coop/Catch-v0", "space_invaders"])
def test_a_seed_repeats_and_emulators_differ(env_id: str) -> None:
    config = EnvSettings(id=env_id, max_episode_steps=15)
    actions = random_actions(2, 40, 4)
    first, steps = played(config, 4, actions, seed=3)
    again, repeated = played(config, 4, actions, seed=3)
    other, _ = played(config, 4, [], seed=4)
    np.testing.assert_array_equal(first, again)
    for one, two in zip(steps, repeated, strict=True):
        np.testing.assert_array_equal(one.next_obs, two.next_obs)
        np.testing.assert_array_equal(one.obs, two.obs)
        np.testing.assert_array_equal(one.raw_rewards, two.raw_rewards)
    assert not np.array_equal(first, other)
    assert any(not np.array_equal(step.obs[0], obs) for step in steps for obs in step.obs[1:])


def test_nothing_is_printed_or_warned() -> None:
    code = (
        "import numpy as np; from coop.common.envs.make import make_vector_env as make\n"
        "from coop.common.settings.environment import EnvSettings as S\n"
        "for name in ('CartPole-v0', 'coop/Catch-v0', 'pong'):\n"
        "    env = make(S(id=name), 1, 0); env.reset(); env.step(np.zeros(1, np.int32)); env.close()"
    )
    out = subprocess.run([sys.executable, "-W", "error", "-c", code], capture_output=True, text=True, check=True)
    assert (out.stdout, out.stderr) == ("", "")


def test_settings_alone_import_no_emulator() -> None:
    code = "import sys, coop.common.envs.make; print({'gymnasium', 'ale_py', 'torch'} & set(sys.modules))"
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert out.stdout.strip() == "set()"


def test_cartpole_follows_gymnasium_through_ends_and_the_200_step_cap() -> None:
    """Against gymnasium's own wrapped environment, balanced by a hand-made rule that reaches the cap."""
    with pytest.warns(DeprecationWarning, match="out of date"):
        reference = gymnasium.make("CartPole-v0")
    env = make_vector_env(EnvSettings(id="CartPole-v0"), 1, 5)
    obs = env.reset()
    expected, _ = reference.reset(seed=int(np.random.SeedSequence(5).generate_state(1)[0] & 0x7FFFFFFF))
    lengths, kinds, length = [], [], 0
    for step in range(900):
        np.testing.assert_array_equal(obs[0], expected)
        careful = step < 600
        action = int(obs[0, 2] + 0.5 * obs[0, 3] + 0.05 * obs[0, 1] > 0) if careful else step % 7 // 4
        took = env.step(np.array([action], np.int32))
        led, reward, terminated, truncated, _ = reference.step(action)
        length += 1
        np.testing.assert_array_equal(took.next_obs[0], led)
        assert (took.rewards[0], took.raw_rewards[0]) == (reward, reward)
        assert (took.terminated[0], took.restarted[0]) == (terminated, terminated or truncated)
        assert took.episode_over[0] == took.restarted[0]
        if terminated or truncated:
            kinds.append(truncated)
            lengths.append(length)
            length = 0
            led, _ = reference.reset()
        else:
            assert took.obs is took.next_obs
        obs, expected = took.obs, led
    assert (200, True) in zip(lengths, kinds, strict=True)
    assert False in kinds


def test_steps_given_out_stay_as_they_were() -> None:
    for env_id in ("CartPole-v0", "coop/Catch-v0", "pong"):
        env = make_vector_env(EnvSettings(id=env_id, max_episode_steps=4), 2, 0)
        env.reset()
        held = [env.step(np.zeros(2, np.int32)) for _ in range(6)]
        copies = [(step.obs.copy(), step.next_obs.copy(), step.restarted.copy()) for step in held]
        for _ in range(6):
            env.step(np.ones(2, np.int32))
        env.close()
        for step, (obs, next_obs, restarted) in zip(held, copies, strict=True):
            np.testing.assert_array_equal(step.obs, obs)
            np.testing.assert_array_equal(step.next_obs, next_obs)
            np.testing.assert_array_equal(step.restarted, restarted)
        assert [bool(step.restarted[0]) for step in held] == [False, False, False, True, False, False]


def test_atari_lost_lives_end_learning_not_the_game() -> None:
    actions = random_actions(4, 1000, 1)
    plain_first, plain = played(EnvSettings(id="breakout"), 1, actions)
    first, episodic = played(EnvSettings(id="breakout", episodic_life=True), 1, actions)
    np.testing.assert_array_equal(plain_first, first)
    lost, games = 0, 0
    for one, two in zip(plain, episodic, strict=True):
        np.testing.assert_array_equal(one.next_obs, two.next_obs)
        np.testing.assert_array_equal(one.restarted, two.restarted)
        np.testing.assert_array_equal(one.restarted, one.episode_over)
        np.testing.assert_array_equal(one.terminated, one.restarted)
        assert two.terminated[two.restarted].all()
        lost += int(two.terminated.sum())
        games += int(two.restarted.sum())
    assert games >= 2
    assert 5 * games <= lost < 5 * (games + 2), "a game of Breakout has five lives"


def test_atari_truncation_is_no_end_and_counts_steps() -> None:
    config = EnvSettings(id="breakout", stack=4, max_episode_steps=6, episodic_life=True)
    first, steps = played(config, 3, np.zeros((13, 3)))
    assert [step.restarted.tolist() for step in steps] == [[n % 6 == 5] * 3 for n in range(13)]
    assert not any(step.terminated.any() for step in steps)
    assert not first[:, :3].any()
    before = first
    for step in steps:
        np.testing.assert_array_equal(step.next_obs[:, :-1], before[:, 1:])
        if step.restarted[0]:
            assert step.obs is not step.next_obs
            assert not step.obs[:, :3].any()
            assert step.obs[:, 3].any()
        before = step.obs


@pytest.mark.parametrize(("env_id", "limit"), [("CartPole-v0", 4), ("coop/Catch-v0", 3), ("breakout", 5)])
def test_a_time_limit_is_terminal_where_asked(env_id: str, limit: int) -> None:
    config = EnvSettings(id=env_id, max_episode_steps=limit, time_limit_terminal=True)
    _, steps = played(config, 2, np.ones((3 * limit, 2)))
    ends = [[n % limit == limit - 1] * 2 for n in range(3 * limit)]
    assert [step.restarted.tolist() for step in steps] == ends
    assert [step.terminated.tolist() for step in steps] == ends
    assert [step.episode_over.tolist() for step in steps] == ends


def test_atari_rewards_are_clipped_for_learning_only() -> None:
    actions = random_actions(6, 300, 1)
    _, steps = played(EnvSettings(id="space_invaders", clip_rewards=True), 1, actions)
    raw = np.array([step.raw_rewards for step in steps])
    assert raw.max() >= 5
    np.testing.assert_array_equal([step.rewards for step in steps], np.clip(raw, -1, 1))
    _, steps = played(EnvSettings(id="space_invaders"), 1, actions)
    np.testing.assert_array_equal([step.rewards for step in steps], raw)


def test_atari_starts_draw_noops_and_frame_skip_counts() -> None:
    starts, _ = played(EnvSettings(id="space_invaders", noop_max=30), 8, [])
    assert len(np.unique(starts.reshape(8, -1), axis=0)) > 1
    starts, _ = played(EnvSettings(id="space_invaders", noop_max=0), 2, [])
    assert len(np.unique(starts.reshape(2, -1), axis=0)) == 1
    _, fast = played(EnvSettings(id="pong", noop_max=0, frame_skip=4), 1, np.zeros((10, 1)))
    _, slow = played(EnvSettings(id="pong", noop_max=0, frame_skip=2), 1, np.zeros((20, 1)))
    np.testing.assert_array_equal(fast[-1].obs[0], slow[-1].obs[0])


def test_atari_action_out_of_range_is_refused() -> None:
    env = make_vector_env(EnvSettings(id="pong"), 1, 0)
    env.reset()
    for action in (-1, 6):
        with pytest.raises(ValueError, match=r"allowed are 0\.\.5"):
            env.step(np.array([action], np.int32))
    env.close()


def test_catch_rewards_once_and_can_be_caught_always() -> None:
    env = make_vector_env(EnvSettings(id="coop/Catch-v0", stack=4), 4, 0)
    obs, returns, rewarded = env.reset(), np.zeros(4), 0
    for step in range(60):
        seen = obs[:, -1, :: catch.CELL, :: catch.CELL]
        ball = seen.argmax(axis=2)[np.arange(4), seen.max(axis=2).argmax(axis=1)]
        paddle = np.where(seen[:, -1] == 128, 1, 0).argmax(axis=1)
        took = env.step((np.sign(ball - paddle) + 1).astype(np.int32))
        returns += took.raw_rewards
        rewarded += np.count_nonzero(took.raw_rewards)
        assert took.terminated.all() == took.restarted.all() == (step % 6 == 5)
        obs = took.obs
    assert rewarded == 4 * 10
    assert (returns == 10 * catch.MAX_RETURN).all()
    columns = {int(np.flatnonzero(row[-1, 0])[0]) for row in obs}
    assert len(columns) > 1


def test_catch_stays_solved_under_the_preset_s_last_epsilon() -> None:
    """A perfect player that acts at random now and then: every 100 episodes in a row return 0.9 or more."""
    config = resolve(load_tables("catch", None))
    env, rng = Catch(), np.random.default_rng(1)
    env.reset(seed=1)
    returns = []
    for _ in range(4000):
        env.reset()
        over = False
        while not over:
            greedy = 1 + int(np.sign(env._column - env._paddle))
            explores = rng.random() < config.actor.epsilon_final
            _, reward, over, _, _ = env.step(int(rng.integers(3)) if explores else greedy)
        returns.append(reward)
    assert np.convolve(returns, np.full(100, 0.01), "valid").min() > 0.9 - 1e-9


def test_catch_standing_still_is_paid_as_documented() -> None:
    _, steps = played(EnvSettings(id="coop/Catch-v0"), 64, np.ones((6 * 30, 64)))
    returns = sum(step.raw_rewards for step in steps) / 30
    assert abs(returns.mean() + 5 / 7) < 0.1
