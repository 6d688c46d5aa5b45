"""Algorithm 1 exactly: act, store, sample, update, toggle, in one process with the roles' own objects."""

from __future__ import annotations

import math
from pathlib import Path

import msgpack
import numpy as np

from actors.policy import Policy
from actors.segments import EpisodeTracker, SegmentAssembler
from common.envs.make import make_vector_env
from common.envs.protocol import Steps
from common.errors import UsageError
from common.messaging.experience import Drawn, EpisodeRecord
from common.process.randomness import generator_state, set_generator_state
from common.settings import schedules
from common.settings.config import RunConfig
from common.types import EpisodeEnd
from learner.agent import Agent
from learner.records.curve import draw_learning_curve
from learner.records.epochs import load_learner, save_epoch
from learner.records.run_directory import RunDirectory
from learner.records.summary import Summary, summarise
from learner.records.telemetry import Telemetry
from replay.core import make_table

METRICS_EVERY = 200  # updates


class Lockstep:
    """One run of Algorithm 1 with one emulator; deterministic to the bit for a seed.

    step: environment steps done. telemetry: returns of the last 100 episodes.
    """

    def __init__(self, config: RunConfig) -> None:
        if config.actor.envs != 1:
            raise UsageError(f"actor.envs = {config.actor.envs}: lockstep runs play one emulator")
        env_seed, policy_seed = np.random.SeedSequence([config.seed, 3, 0]).spawn(2)
        self.config = config
        self.step = 0
        self.env = make_vector_env(config.env, 1, int(env_seed.generate_state(1)[0]))
        self.agent = Agent(config, self.env.spec)
        self.telemetry = Telemetry()
        self._policy_rng = np.random.default_rng(policy_seed)
        first, second = self.agent.networks
        self._policy = Policy((first, second), self.env.spec, self._policy_rng)
        self._table = make_table(config, self.env.spec)
        self._episodes = EpisodeTracker(1)
        self._segments = SegmentAssembler(
            self.env.spec, 1, 0, 1, n_step=config.replay.n_step, gamma=config.learner.gamma
        )
        self._actions: list[int] = []
        self._obs = self.env.reset()
        self._segments.begin(self._obs)

    def play(self, directory: RunDirectory) -> None:
        """One pass through Algorithm 1's inner loop."""
        config, agent = self.config, self.agent
        epsilon = schedules.epsilon(config.actor, self.step)
        self._policy.acting = agent.acting
        actions = self._policy.act(self._obs, epsilon)
        steps = self.env.step(actions)
        self._actions.append(int(actions[0]))
        for segment in self._segments.add(actions, steps, agent.updates, {}):
            self._table.insert(segment)
        self._obs = steps.obs
        self.step += 1
        for _ in range(self._due()):
            self._update(directory, epsilon)
        self._book(steps, epsilon, directory)
        if config.learner.swap_by == "plays" and self.step % config.learner.swap_every == 0:
            agent.swap()
        if config.learner.reset_role_at_episode and steps.episode_over[0] and agent.acting:
            agent.swap()

    def _due(self) -> int:
        """Updates that the replay ratio asks for after this step."""
        replay = self.config.replay
        since = self.step - replay.start
        return 0 if since <= 0 else math.floor(replay.ratio * since) - math.floor(replay.ratio * (since - 1))

    def _update(self, directory: RunDirectory, epsilon: float) -> None:
        agent, table = self.agent, self._table
        batch = table.sample(self.config.learner.batch_size)
        result = agent.update(batch)
        if self.config.replay.prioritized:
            table.update_priorities(batch.ids, np.abs(result.td_errors))
        self.telemetry.add(agent, batch, result)
        if agent.updates % METRICS_EVERY == 0:
            drawn = Drawn(0, self.step, len(table), table.evicted, table.evicted_unsampled, 0, ())
            directory.metrics(self.telemetry.row(agent, drawn, epsilon))

    def _book(self, steps: Steps, epsilon: float, directory: RunDirectory) -> None:
        for episode in self._episodes.add(steps):
            q1_mean, q2_mean = self._policy.mean_values(steps.next_obs[0])
            version = self.agent.updates
            end = EpisodeEnd(0, episode.episode_return, episode.length, epsilon, q1_mean, q2_mean, version)
            number = self.telemetry.episode(episode.episode_return)
            directory.episode(number, EpisodeRecord(self.step, 0, 0, end), version, self.agent.exploration_rate())

    def save(self, directory: RunDirectory) -> None:
        """Save an epoch from which `restore` goes on to the bit."""
        state = {
            "agent": self.agent.state(),
            "telemetry": self.telemetry.state(),
            "step": self.step,
            "policy": generator_state(self._policy_rng),
            "sizes": directory.sizes(),
        }

        def snapshot(folder: str) -> None:
            path = directory.path / folder / "replay"
            path.mkdir(exist_ok=True)
            meta, arrays = self._table.state()
            (path / "state.msgpack").write_bytes(msgpack.packb({"table": meta}))
            for name, array in {**arrays, "played": np.array(self._actions, np.int32)}.items():
                np.save(path / f"{name}.npy", array)

        save_epoch(directory.path, self.agent.updates, state, snapshot)

    def restore(self, epoch: Path) -> dict[str, int]:
        """Go on where `save` was called; the sizes that the run's files had.

        The emulator comes back by playing the same actions again: exact for every deterministic environment.
        """
        state = load_learner(epoch)
        arrays = {path.stem: np.load(path) for path in (epoch / "replay").glob("*.npy")}
        played = arrays.pop("played")
        self._actions = []
        for action in played:
            actions = np.array([action], np.int32)
            steps = self.env.step(actions)
            self._segments.add(actions, steps, 0, {})
            self._episodes.add(steps)
            self._obs = steps.obs
        self._actions = played.tolist()
        meta = msgpack.unpackb((epoch / "replay" / "state.msgpack").read_bytes(), strict_map_key=False)["table"]
        self._table.load_state(meta, arrays)
        self.agent.load_state(state["agent"])
        set_generator_state(self._policy_rng, state["policy"])
        self.telemetry.load_state(state["telemetry"])
        self.step = state["step"]
        sizes: dict[str, int] = state["sizes"]
        return sizes


def finish(run: Lockstep, directory: RunDirectory, started: float, outcome: str) -> Summary:
    """Write what a run leaves at its end."""
    run.save(directory)
    summary = summarise(run.agent, run.telemetry, started, outcome, run.step)
    directory.summary(summary)
    draw_learning_curve(directory.path, f"{summary.title}, lockstep")
    return summary
