"""What an actor does in a turn: actions, episode ends, and what chose them; real emulators, no socket."""

from functools import partial
from typing import Any

import gymnasium
import numpy as np
import pytest
from gates import mask_of
from gymnasium.envs.classic_control import CartPoleEnv

from coop.actors.player import Player, Turn
from coop.actors.policy import EpsilonGreedy
from coop.common.envs.make import make_vector_env
from coop.common.envs.protocol import VectorEnv
from coop.common.networks.network import FlatNetwork, build_network
from coop.common.settings import schedules
from coop.common.settings.config import ActorSettings
from coop.common.settings.environment import EnvSettings


class Generous(CartPoleEnv):
    """CartPole with rewards of 3, which clipping changes."""

    def step(self, action: int) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        obs, reward, *rest = super().step(action)
        return obs, 3 * reward, *rest


gymnasium.register("Generous-v0", entry_point=Generous, max_episode_steps=200)


def make_player(
    num_envs: int = 3, epsilon: float = 0.5, settings: EnvSettings | None = None
) -> tuple[Player, VectorEnv, EpsilonGreedy]:
    env = make_vector_env(settings or EnvSettings(id="CartPole-v0"), num_envs, seed=1)
    first, second = (FlatNetwork(build_network("mlp", env.spec, (8,), seed=seed)) for seed in (0, 1))
    policy = EpsilonGreedy((first, second), env.spec, np.random.default_rng(0))
    return Player(env, policy, lambda _: epsilon), env, policy


def play(player: Player, turns: int) -> list[Turn]:
    player.begin()
    played = []
    for turn in range(turns):
        player.send(0, turn)
        played.append(player.recv())
    return played


@pytest.mark.parametrize(
    "settings",
    [EnvSettings(id="CartPole-v0"), EnvSettings(id="Generous-v0", clip_rewards=True)],
    ids=lambda one: one.id,
)
def test_episodes_sum_the_unclipped_rewards_of_their_stream(settings: EnvSettings) -> None:
    player, env, _ = make_player(settings=settings)
    turns = play(player, 300)
    env.close()
    begun = [0] * 3
    ended = 0
    for number, turn in enumerate(turns):
        assert sorted(turn.ended) == np.flatnonzero(turn.steps.episode_over).tolist()
        for stream, end in turn.ended.items():
            rewards = [turns[k].steps.raw_rewards[stream] for k in range(begun[stream], number + 1)]
            assert (end.episode_return, end.length) == (sum(rewards), len(rewards))
            assert end.param_version == turn.version == number
            assert end.step_in_segment == 0  # until it is in a segment
            begun[stream] = number + 1
            ended += 1
    assert ended > 10
    assert player.steps == 900


def test_an_end_tells_the_values_of_the_last_observation_by_both_networks() -> None:
    player, env, policy = make_player(num_envs=1)
    turns = play(player, 60)
    env.close()
    ends = [(turn, turn.ended[0]) for turn in turns if turn.ended]
    assert ends
    for turn, end in ends:
        last = turn.steps.next_obs[0]  # not obs, which is the next episode's first
        assert (end.q1_mean, end.q2_mean) == policy.mean_values(last)
    assert end.q1_mean != end.q2_mean


def test_masks_choose_actions_and_what_an_end_tells() -> None:
    """Episodes are cut behind two steps, where the last observation allows two of four actions; others are errors."""
    player, env, policy = make_player(settings=EnvSettings(id="gates:Gates-v0", max_episode_steps=2))
    turns = play(player, 8)
    env.close()
    ends = [(turn.steps.next_obs[stream], end) for turn in turns for stream, end in turn.ended.items()]
    assert len(ends) == 12
    for last, end in ends:
        assert (end.q1_mean, end.q2_mean) == policy.mean_values(last, mask_of(last))
        assert end.q1_mean != policy.mean_values(last)[0]


def test_epsilon_follows_the_steps_of_the_whole_run() -> None:
    settings = ActorSettings(epsilon_start=1.0, epsilon_final=0.0, epsilon_decay="linear", epsilon_steps=1000)
    _, env, policy = make_player(num_envs=1)
    player = Player(env, policy, partial(schedules.epsilon, settings))
    player.begin()
    recorded = {}
    for env_step in range(0, 1000, 4):  # three others play as well
        player.send(env_step, 0)
        for end in player.recv().ended.values():
            recorded[env_step] = end.epsilon
    env.close()
    assert len(recorded) > 5
    for env_step, epsilon in recorded.items():
        assert epsilon == pytest.approx(1 - env_step / 1000)


def test_the_same_actions_bring_emulators_back_to_where_they_were() -> None:
    player, env, _ = make_player(num_envs=1)
    turns = play(player, 80)
    env.close()
    again, env, _ = make_player(num_envs=1)
    again.begin()
    for turn in turns:
        replayed = again.replay(turn.actions)
        np.testing.assert_array_equal(replayed.steps.next_obs, turn.steps.next_obs)
        assert [end.length for end in replayed.ended.values()] == [end.length for end in turn.ended.values()]
        assert {(end.epsilon, end.param_version) for end in replayed.ended.values()} <= {(0.0, 0)}
    env.close()


def test_networks_that_diverged_give_ends_that_a_segment_may_hold() -> None:
    player, env, policy = make_player(num_envs=1)
    for network in policy.networks:
        network.load(np.full(network.flat.numel(), np.nan, np.float32))
    turns = play(player, 60)
    env.close()
    ends = [end for turn in turns for end in turn.ended.values()]
    assert ends
    assert np.isfinite([(end.q1_mean, end.q2_mean) for end in ends]).all()
